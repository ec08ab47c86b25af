"""Validation of the channel's messages: every sample is checked here before anything else sees it.

Checks run from cheap to expensive, so that invalid input costs little: the JSON decodes, its content fits its key, the
message is new, its deadline lies ahead. The signature is verified last.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, Generic

import msgspec

from mesh.clock import SYSTEM_CLOCK
from mesh.errors import AiraError, InvalidMessage
from mesh.flood import forget_oldest
from mesh.network.lookups import M, NameCache, Unresolved
from schemas import (
    ZERO_ADDRESS,
    Demand,
    Offer,
    Result,
    SignedMessage,
    Verified,
    Withdrawal,
    decode,
    message_hash,
    names_in,
    resolve_names,
)
from schemas.keys import market_key
from schemas.signing import SignedDigest, recover_keys, signed_digest, verify_recovered
from schemas.wire import parse_cids_ahead

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from mesh.blocklist import BlockedSigners
    from mesh.clock import Clock
    from mesh.network.lookups import Resolver, ValidatorCheck

log = logging.getLogger(__name__)

AMBIGUOUS_NONCE: Final = "00" * 12
"""No nonce of generation 3 may start like this: the contracts would read it as a generation-5 order."""
DEDUPLICATION_LIMIT: Final = 65_536
"""Accepted messages that a validator remembers, to drop duplicates."""
SLICE: Final = 128
"""Signatures verified at a time: some seven milliseconds."""
_DOT, _BACKSLASH = b".\\"


def message_key(lighthouse: str, message: SignedMessage) -> str:
    """The key of `message` on the channel of `lighthouse` (ENS name, lower case)."""
    # Constructing a message validates its fields, so this does not.
    return market_key(lighthouse, message.kind, message.key_model)


class ValidationStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Counts of one subscription's messages: `invalid` by reason; `dropped` before validation."""

    received: int
    accepted: int
    invalid: Mapping[str, int]
    duplicate: int
    dropped: int


class _Prepared(msgspec.Struct, Generic[M], frozen=True, gc=False):
    """A message whose signature is not checked yet. `identity` is the same for copies, `fingerprint` for equal bytes.

    `is_complete`: the chain need not be asked about it.
    """

    message: M
    key: str
    fingerprint: int
    hash: bytes
    identity: int
    is_complete: bool
    signed: SignedDigest


class MessageValidator(Generic[M]):
    """Verifies the messages of one kind, and counts those that it rejects.

    `lighthouse` is the market's name in keys; `address`, if given, must be the orders' lighthouse. `head` returns the
    latest block number, or 0 if it isn't known (then no deadline is checked); `resolver` resolves ENS names;
    `validators` knows which validators orders may name (None: any); messages of `blocked` signers are rejected.
    Thread-safe, except `complete`.

    A message is a duplicate if its hash and signature equal those of one of the last accepted messages
    (`deduplication_limit` at most, half of that at least) that were not forgotten since; equal generation-3 terms from
    two signers are two messages. A copy with the same bytes is recognized before it is decoded. Consumers hold a
    message until the chain has confirmed its effect, or `forget` it, and then the sender's next copy gets through.
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
        blocked: BlockedSigners = frozenset(),
        deduplication_limit: int = DEDUPLICATION_LIMIT,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self.kind: type[M] = kind
        self._lighthouse = lighthouse
        self._address = address
        self._head = head
        self._names = None if resolver is None else NameCache(resolver)
        self._validators = validators
        self._blocked = blocked
        self._lock = threading.Lock()
        self._clock = clock
        self._seen: dict[int, int] = {}
        """Of the accepted messages, each by the other: what makes a message one, and the hash of its bytes."""
        self._remembered = 2 * deduplication_limit
        self._forgetting: deque[tuple[float, int]] = deque(maxlen=deduplication_limit)
        """When messages will be forgotten, and what makes them one."""
        self._invalid: Counter[str] = Counter()
        self._duplicate = 0
        self._accepted = 0

    def is_copy(self, payload: bytes) -> bool:
        """Whether an accepted message had the same bytes: a duplicate, which is counted, and need not be checked."""
        if self._forgetting:
            self._forget_due()
        if hash(payload) not in self._seen:
            return False
        self._count_duplicate()
        return True

    def check_all(self, received: Iterable[tuple[str, bytes]]) -> Iterator[list[Verified[M] | Unresolved[M]]]:
        """The verified or `Unresolved` messages of keys and payloads, some every few milliseconds; others are counted.

        All are decoded before signatures are verified: each is twice as fast while its code stays in the CPU's caches.
        """
        received = list(received)
        parse_cids_ahead((payload for _, payload in received), self.kind)
        prepared = [each for key, payload in received if (each := self._prepare(key, payload)) is not None]
        for start in range(0, len(prepared), SLICE):
            yield self._verify_all(prepared[start : start + SLICE])

    def _prepare(self, key: str, payload: bytes) -> _Prepared[M] | Unresolved[M] | None:
        """Everything but the signature."""
        fingerprint = hash(payload)
        if fingerprint in self._seen:
            self._count_duplicate()
            return None
        try:
            message = decode(payload, self.kind)
            if not isinstance(message, self.kind):
                raise InvalidMessage("kind", f"a {type(message).__name__} on a key of {self.kind.__name__}")
            # A name has a dot, which JSON may write with a backslash.
            if (_DOT in payload or _BACKSLASH in payload) and (names := names_in(message)):
                if self._names is None:
                    raise InvalidMessage("name", f"no chain to resolve {', '.join(sorted(names))}")
                if (addresses := self._names.known(names)) is None:
                    return Unresolved(message, key, fingerprint)
                message = resolve_names(message, addresses)
            return self._hashed(message, key, fingerprint)
        except InvalidMessage as error:
            self.reject(error.reason)
            return None

    def _verify_all(self, prepared: list[_Prepared[M] | Unresolved[M]]) -> list[Verified[M] | Unresolved[M]]:
        """Verify signatures: that of each message once, even if copies of it come together."""
        seen = self._seen
        signed = {
            each.identity: each.signed for each in prepared if type(each) is _Prepared and each.identity not in seen
        }
        keys = dict(zip(signed, recover_keys(signed.values()), strict=True))
        with self._lock:
            verified = [found for each in prepared if (found := self._verify(each, keys)) is not None]
            forget_oldest(seen, self._remembered)
        return verified

    def _verify(
        self, prepared: _Prepared[M] | Unresolved[M], keys: Mapping[int, bytes]
    ) -> Verified[M] | Unresolved[M] | None:
        """A message whose key was recovered, unless one like it was accepted before. Call it with the lock."""
        if isinstance(prepared, Unresolved):
            return prepared
        identity, seen = prepared.identity, self._seen
        if (key := keys.get(identity)) is None or identity in seen:
            self._duplicate += 1
            return None
        try:
            verified = verify_recovered(prepared.message, prepared.hash, key)
        except InvalidMessage as error:
            self._invalid[error.reason] += 1
            return None
        if verified.signer in self._blocked:
            self._invalid["blocked"] += 1
            return None
        if not prepared.is_complete:
            return Unresolved(prepared.message, prepared.key, prepared.fingerprint, verified.signer)
        seen[identity], seen[prepared.fingerprint] = prepared.fingerprint, identity
        self._accepted += 1
        return verified

    async def complete(self, unresolved: Unresolved[M]) -> Verified[M] | None:
        """Ask the chain about a message; the verified message, or None, which is counted under its reason."""
        outcome: Verified[M] | Unresolved[M] | None = unresolved
        try:
            while isinstance(outcome, Unresolved):
                unresolved = outcome
                addresses = await self._answers(unresolved.message)
                message = resolve_names(unresolved.message, addresses)
                prepared = self._hashed(message, unresolved.key, unresolved.fingerprint)
                outcome = next(iter(self._verify_all([prepared])), None)
        except InvalidMessage as error:
            self.reject(error.reason)
            return None
        except AiraError as error:
            log.debug("what a message names can't be looked up on the chain: %s", error)
            self.reject(unresolved.question)
            return None
        return outcome

    async def _answers(self, message: SignedMessage) -> dict[str, str]:
        """The addresses of a message's names; if it has none, its validator is known afterwards. Raises `AiraError`."""
        names = names_in(message)
        if not names and self._validators is not None and isinstance(message, Demand | Offer):
            await self._validators.is_safe(message.validator)
        return {} if self._names is None else await self._names.addresses(names)

    def reject(self, reason: str) -> None:
        """Count a rejected message under `reason`."""
        with self._lock:
            self._invalid[reason] += 1

    def forget(self, verified: Verified[M], *, after: float = 0.0) -> None:
        """Accept an accepted message once more when it is sent again: its consumer no longer holds it.

        With `after`, copies remain duplicates for that many seconds.
        """
        identity = hash((verified.hash, verified.message.signature))
        with self._lock:
            if after:
                self._forgetting.append((self._clock.monotonic() + after, identity))
            else:
                self._forget(identity)

    def _forget_due(self) -> None:
        with self._lock:
            while self._forgetting and self._forgetting[0][0] <= self._clock.monotonic():
                self._forget(self._forgetting.popleft()[1])

    def _forget(self, identity: int) -> None:
        self._seen.pop(self._seen.pop(identity, identity), 0)

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

    def _hashed(self, message: M, key: str, fingerprint: int) -> _Prepared[M]:
        """A message without names, checked and hashed."""
        if key != message_key(self._lighthouse, message):
            raise InvalidMessage("key", f"the message does not belong on {key}")
        digest = message_hash(message)
        identity, is_complete = hash((digest, message.signature)), self._check_order(message)
        signed = signed_digest(digest, message.signature)
        return _Prepared(message, key, fingerprint, digest, identity, is_complete, signed)

    def _check_order(self, order: SignedMessage) -> bool:
        """Raise `InvalidMessage` for an order that can't be used; False if the chain has to be asked, too."""
        if isinstance(order, Result):
            return True
        if isinstance(order, (Demand, Offer)) and order.sender is None and str(order.nonce).startswith(AMBIGUOUS_NONCE):
            raise InvalidMessage("nonce", "the contracts would take it for the sender of a generation-5 order")
        if (head := self._head()) and order.deadline <= head:
            raise InvalidMessage("deadline", f"block {order.deadline} has passed")
        if self._address is not None and order.lighthouse != self._address:
            raise InvalidMessage("lighthouse", f"made for {order.lighthouse}, not for this market")
        if self._validators is None or isinstance(order, Withdrawal) or order.validator == ZERO_ADDRESS:
            return True
        is_safe = self._validators.known(order.validator)
        if is_safe is False:
            raise InvalidMessage("validator", f"{order.validator} is a lighthouse, or could become one")
        return is_safe is not None

    def _count_duplicate(self) -> None:
        with self._lock:
            self._duplicate += 1
