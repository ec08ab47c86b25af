"""Validation of the channel's messages: every sample is checked here before anything else sees it.

Checks run from cheap to expensive, so that invalid input costs little: the JSON decodes, its key is the one that its
content requires (which rules out wildcards), the message is new, its deadline lies ahead. The signature is verified
last, and once; only an order whose validator the chain has to be asked about is verified again after that.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, OrderedDict
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, Protocol, TypeVar

import msgspec

from mesh.errors import AiraError, InvalidMessage
from schemas import (
    ZERO_ADDRESS,
    Demand,
    Offer,
    Result,
    SignedMessage,
    Verified,
    decode,
    message_hash,
    names_in,
    resolve_names,
)
from schemas.keys import market_key
from schemas.signing import verify_hashed

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    import zenoh

    Resolver = Callable[[str], Awaitable[str]]

log = logging.getLogger(__name__)

M = TypeVar("M", bound=SignedMessage)

AMBIGUOUS_NONCE: Final = "00" * 12
"""No nonce of generation 3 may start like this: the contracts would read it as a generation-5 order."""
DEDUPLICATION_LIMIT: Final = 65_536
"""Accepted messages that a validator remembers, to drop duplicates."""


def message_key(lighthouse: str, message: SignedMessage) -> str:
    """The key of `message` on the channel of `lighthouse` (ENS name, lower case)."""
    # Constructing a message validates its fields, so this does not.
    return market_key(lighthouse, message.kind, message.key_model)


class Unresolved(NamedTuple, Generic[M]):
    """A message about which the chain has to be asked first: it contains ENS names, without which it can't be hashed
    and verified, or is verified and names a validator that is not known yet."""

    message: M
    key: str

    @property
    def question(self) -> str:
        """What has to be asked, `name` or `validator`: the reason of its rejection if that fails."""
        return "name" if names_in(self.message) else "validator"


class ValidatorCheck(Protocol):
    """Which validators (EIP-55 addresses) orders may name: `chain.validators`."""

    def known(self, validator: str) -> bool | None:
        """Whether orders may name it; None if that has to be asked."""

    async def is_safe(self, validator: str) -> bool:
        """The same, asked. Raises `ChainError`."""


class ValidationStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Counts of one subscription's messages: `invalid` by reason; `dropped` before validation, the oldest first."""

    received: int
    accepted: int
    invalid: Mapping[str, int]
    duplicate: int
    dropped: int


class MessageValidator(Generic[M]):
    """Verifies the messages of one kind, and counts those that it rejects.

    `lighthouse` is the market's name in keys; `address`, if given, must be the orders' lighthouse. `head` returns the
    latest block number, or 0 when it isn't known (then no deadline is checked); `resolver` resolves ENS names;
    `validators` knows which validators orders may name (None: any). Thread-safe, except `complete`.

    A message is a duplicate when hash and signature equal those of one of the last `deduplication_limit` accepted
    messages that were not forgotten since; equal generation-3 terms from two signers are two messages. The rule for
    consumers: hold a message until the chain has confirmed its effect, or `forget` it. Senders repeat a message until
    they see its effect, so the copy that arrives next takes the place of the one that had none.
    """

    def __init__(
        self,
        kind: type[M],
        *,
        lighthouse: str,
        address: str | None,
        head: Callable[[], int],
        resolver: Resolver | None = None,
        validators: ValidatorCheck | None = None,
        deduplication_limit: int = DEDUPLICATION_LIMIT,
    ) -> None:
        self.kind: type[M] = kind
        self._lighthouse = lighthouse
        self._address = address
        self._head = head
        self._resolver = resolver
        self._validators = validators
        self._deduplication_limit = deduplication_limit
        self._lock = threading.Lock()
        self._seen: OrderedDict[tuple[bytes, str], None] = OrderedDict()
        self._named: OrderedDict[SignedMessage, tuple[bytes, str]] = OrderedDict()
        """Accepted messages with ENS names, which can't be hashed before these are resolved."""
        self._invalid: Counter[str] = Counter()
        self._duplicate = 0
        self._accepted = 0

    def __call__(self, sample: zenoh.Sample) -> Verified[M] | Unresolved[M] | None:
        """The message in a Zenoh sample; see `check`."""
        return self.check(str(sample.key_expr), sample.payload.to_bytes())

    def check(self, key: str, payload: bytes) -> Verified[M] | Unresolved[M] | None:
        """The verified message in `payload`; an `Unresolved` one; or None, which is counted under its reason."""
        try:
            message = decode(payload)
            if not isinstance(message, self.kind):
                raise InvalidMessage("kind", f"a {type(message).__name__} on a key of {self.kind.__name__}")
            if not (names := names_in(message)):
                return self._verified(message, key)
            if self._named.get(message) in self._seen:
                self._count_duplicate()
                return None
            if self._resolver is None:
                raise InvalidMessage("name", f"no chain to resolve {', '.join(sorted(names))}")
            return Unresolved(message, key)
        except InvalidMessage as error:
            self.reject(error.reason)
            return None

    async def complete(self, unresolved: Unresolved[M]) -> Verified[M] | None:
        """Ask the chain about a message; the verified message, or None, which is counted under its reason."""
        outcome: Verified[M] | Unresolved[M] | None = unresolved
        asked = unresolved.message
        try:
            while isinstance(outcome, Unresolved):
                unresolved = outcome
                addresses = await self._answers(unresolved.message)
                outcome = self._verified(resolve_names(unresolved.message, addresses), unresolved.key)
        except InvalidMessage as error:
            self.reject(error.reason)
            return None
        except AiraError as error:
            log.debug("what a message names can't be looked up on the chain: %s", error)
            self.reject(unresolved.question)
            return None
        if outcome is not None and names_in(asked):
            self._named[asked] = outcome.hash, outcome.message.signature
            if len(self._named) > self._deduplication_limit:
                self._named.popitem(last=False)
        return outcome

    async def _answers(self, message: SignedMessage) -> dict[str, str]:
        """The addresses of a message's names; if it has none, its validator is known afterwards. Raises `AiraError`."""
        names = names_in(message)
        if not names and self._validators is not None and isinstance(message, Demand | Offer):
            await self._validators.is_safe(message.validator)
        return {name: await self._resolver(name) for name in names if self._resolver is not None}

    def reject(self, reason: str) -> None:
        """Count a rejected message under `reason`."""
        with self._lock:
            self._invalid[reason] += 1

    def forget(self, verified: Verified[M]) -> None:
        """Accept an accepted message once more when it is sent again: its consumer no longer holds it."""
        with self._lock:
            self._seen.pop((verified.hash, verified.message.signature), None)

    def statistics(self, *, received: int, dropped: int) -> ValidationStatistics:
        """The counts so far, with what a subscription `received` and `dropped` before validation."""
        with self._lock:
            return ValidationStatistics(
                received=received,
                accepted=self._accepted,
                invalid=dict(self._invalid),
                duplicate=self._duplicate,
                dropped=dropped,
            )

    def _verified(self, message: M, key: str) -> Verified[M] | Unresolved[M] | None:
        if key != message_key(self._lighthouse, message):
            raise InvalidMessage("key", f"the message does not belong on {key}")
        digest = message_hash(message)
        if (digest, message.signature) in self._seen:
            self._count_duplicate()
            return None
        is_complete = self._check_order(message)
        verified = verify_hashed(message, digest)
        if not is_complete:
            return Unresolved(message, key)
        return verified if self._accept_new(verified) else None

    def _check_order(self, order: SignedMessage) -> bool:
        """Raise `InvalidMessage` for an order that can't be used; False if the chain has to be asked, too."""
        if isinstance(order, Result):
            return True
        if isinstance(order, Demand | Offer) and order.generation == 3 and str(order.nonce).startswith(AMBIGUOUS_NONCE):
            raise InvalidMessage("nonce", "the contracts would take it for the sender of a generation-5 order")
        if order.deadline <= self._head():
            raise InvalidMessage("deadline", f"block {order.deadline} has passed")
        if self._address is not None and order.lighthouse != self._address:
            raise InvalidMessage("lighthouse", f"made for {order.lighthouse}, not for this market")
        if self._validators is None or not isinstance(order, Demand | Offer) or order.validator == ZERO_ADDRESS:
            return True
        is_safe = self._validators.known(order.validator)
        if is_safe is False:
            raise InvalidMessage("validator", f"{order.validator} is a lighthouse, or could become one")
        return is_safe is not None

    def _count_duplicate(self) -> None:
        with self._lock:
            self._duplicate += 1

    def _accept_new(self, verified: Verified[M]) -> bool:
        """Record an accepted message, forgetting the oldest; False if another thread accepted the same one first."""
        identity = verified.hash, verified.message.signature
        with self._lock:
            if identity in self._seen:
                self._duplicate += 1
                return False
            if len(self._seen) >= self._deduplication_limit:
                self._seen.popitem(last=False)
            self._seen[identity] = None
            self._accepted += 1
        return True
