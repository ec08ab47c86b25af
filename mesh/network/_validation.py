"""Validation of a market's messages: every one is checked here before anything else sees it.

`MarketRules` say what the messages of a market must fit, and know what the chain was asked about them. They verify one
message at a time, for the bridge to IPFS; a `MessageValidator` verifies many of one kind and drops copies, for
subscriptions.

Checks run from cheap to expensive, so that invalid input costs little: the JSON decodes, its content fits its key, the
message is new, its deadline lies ahead. The signature is verified last.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Container, Mapping
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Protocol, TypeVar

import msgspec

from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.flood import BoundedDict, forget_oldest
from mesh.errors import AiraError, InvalidMessage
from schemas import (
    ZERO_ADDRESS,
    SignedMessage,
    Verified,
    decode,
    message_hash,
    names_in,
    resolve_names,
    verify_message,
)
from schemas.keys import market_key
from schemas.messages import parse_cids_ahead
from schemas.signing import SignedDigest, recover_keys, signed_digest, verify_recovered

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator

    from mesh.base.clock import Clock

    Resolver = Callable[[str], Awaitable[str]]


M = TypeVar("M", bound=SignedMessage)

AMBIGUOUS_NONCE: Final = "00" * 12
"""No nonce of generation 3 may start like this: the contracts would read it as a generation-5 order."""


class ResolverLimits(NamedTuple):
    """How long the addresses of ENS names are used."""

    kept: float = 60.0
    """Seconds for which the address of a name is."""
    failure_kept: float = 10.0
    """Seconds for which a name that could not be resolved is not asked about again."""
    names: int = 4096
    """Names that are remembered; the oldest are forgotten first."""


RESOLVER_LIMITS: Final = ResolverLimits()


class Unresolved(NamedTuple, Generic[M]):
    """A message about which the chain has to be asked first: it contains ENS names, without which it can't be hashed
    and verified, or is verified and names a validator that is not known yet."""

    message: M
    key: str
    fingerprint: int
    signer: str = ""
    """The signer of a verified message."""

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


class MarketRules:
    """What the messages of the market `lighthouse` (ENS name) must fit. Thread-safe, except `verified`.

    `address`, once it is known, must be the orders' lighthouse. `head` returns the latest block number, or 0 if it
    isn't known (then no deadline is checked); `resolver` resolves ENS names; `validators` knows which validators orders
    may name (None: any); messages of `blocked` signers are rejected.
    """

    def __init__(
        self,
        lighthouse: str,
        *,
        address: str | None = None,
        head: Callable[[], int] = lambda: 0,
        resolver: Resolver | None = None,
        validators: ValidatorCheck | None = None,
        blocked: Container[str] = frozenset(),
    ) -> None:
        self.lighthouse: Final = lighthouse.lower()
        self.address = address
        self.head: Final = head
        self._names = None if resolver is None else NameCache(resolver)
        self._validators = validators
        self.blocked: Final = blocked

    async def verified(self, message: M, key: str | None = None) -> Verified[M]:
        """A decoded message, verified: received on `key`, or elsewhere. Asks the chain what is not known.

        Raises `InvalidMessage`; its `reason` is `name`, `key`, `nonce`, `deadline`, `lighthouse`, `validator`,
        `blocked`, or one of `schemas.verify_message`.
        """
        question = "name"
        try:
            if names := names_in(message):
                addresses = self.known_addresses(names)
                if addresses is None and self._names is not None:
                    addresses = await self._names.addresses(names)
                message = resolve_names(message, addresses or {})
            is_complete = self.check(message, key)
            verified = verify_message(message)
            if verified.signer in self.blocked:
                raise InvalidMessage("blocked", f"{verified.signer} is blocked")
            order: Any = message
            if not is_complete and self._validators is not None:
                question = "validator"
                if not await self._validators.is_safe(order.validator):
                    raise _unsafe(order.validator)
        except InvalidMessage:
            raise
        except AiraError as error:
            log.debug("what a message names can't be looked up on the chain: %s", error)
            raise InvalidMessage(question, str(error)) from error
        return verified

    def known_addresses(self, names: frozenset[str]) -> dict[str, str] | None:
        """The addresses of ENS names; None if the chain has to be asked. Raises `InvalidMessage` (`name`)."""
        if self._names is None:
            raise InvalidMessage("name", f"no chain to resolve {', '.join(sorted(names))}")
        return self._names.known(names)

    def check(self, message: SignedMessage, key: str | None) -> bool:
        """Whether nothing has to be asked about its validator. Raises `InvalidMessage` for what can't be used."""
        if key is not None and key != message_key(self.lighthouse, message):
            raise InvalidMessage("key", f"the message does not belong on {key}")
        if not message.is_of_lighthouse:
            return True
        order: Any = message
        if order.is_order and order.sender is None and str(order.nonce).startswith(AMBIGUOUS_NONCE):
            raise InvalidMessage("nonce", "the contracts would take it for the sender of a generation-5 order")
        if (head := self.head()) and order.deadline <= head:
            raise InvalidMessage("deadline", f"block {order.deadline} has passed")
        if self.address is not None and order.lighthouse != self.address:
            raise InvalidMessage("lighthouse", f"made for {order.lighthouse}, not for this market")
        if self._validators is None or not order.is_order or order.validator == ZERO_ADDRESS:
            return True
        is_safe = self._validators.known(order.validator)
        if is_safe is False:
            raise _unsafe(order.validator)
        return is_safe is not None


class NameCache:
    """Addresses of ENS names by `resolver`, which is asked about a name once in a while. `known` is thread-safe."""

    def __init__(self, resolver: Resolver, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self._resolver = resolver
        self._clock = clock
        self._answers: BoundedDict[str, tuple[float, str]] = BoundedDict(RESOLVER_LIMITS.names)

    def known(self, names: Iterable[str]) -> dict[str, str] | None:
        """The addresses of these names, without asking; None if one has to be asked.

        Raises `InvalidMessage` (`name`) if one could not be resolved a moment ago.
        """
        now, found = self._clock.monotonic(), {}
        for name in names:
            until, address = self._answers.get(name, (0.0, ""))
            if until <= now:
                return None
            if not address:
                raise InvalidMessage("name", f"{name} could not be resolved a moment ago")
            found[name] = address
        return found

    async def addresses(self, names: Iterable[str]) -> dict[str, str]:
        """The addresses of these names. Raises `AiraError`."""
        return {name: await self._address(name) for name in names}

    async def _address(self, name: str) -> str:
        if (known := self.known((name,))) is not None:
            return known[name]
        address, kept = "", RESOLVER_LIMITS.failure_kept
        try:
            address, kept = await self._resolver(name), RESOLVER_LIMITS.kept
        finally:
            self._answers[name] = self._clock.monotonic() + kept, address
        return address


log = logging.getLogger(__name__)

DEDUPLICATION_LIMIT: Final = 32_768
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


def _unsafe(validator: str) -> InvalidMessage:
    return InvalidMessage("validator", f"{validator} is not known to be one: it may be a lighthouse")


class _Candidate(msgspec.Struct, Generic[M], frozen=True, gc=False):
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
    """Verifies the messages of one kind by the `rules` of their market, and counts those that it rejects.

    Thread-safe, except `complete`.

    A message is a duplicate if its hash and signature equal those of one of the last accepted messages
    (`deduplication_limit` at most, half of that at least) that were not forgotten since, or of one that is checked
    with it; equal generation-3 terms from two signers are two messages. A copy of an accepted message with the same
    bytes is recognized before it is decoded. Consumers hold a message until the chain has confirmed its effect, or
    `forget` it, and then the sender's next copy gets through.
    """

    def __init__(
        self,
        message_type: type[M],
        rules: MarketRules,
        *,
        deduplication_limit: int = DEDUPLICATION_LIMIT,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self.message_type: type[M] = message_type
        self._rules = rules
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

    def without_copies(self, received: Iterable[tuple[str, bytes]]) -> list[tuple[str, bytes] | None]:
        """Keys and payloads; None instead of one whose bytes an accepted message had: a duplicate, which is counted."""
        if self._forgetting:
            self._forget_due()
        seen = self._seen
        new = [None if hash(each[1]) in seen else each for each in received]
        if copies := sum([each is None for each in new]):
            self._count_duplicates(copies)
        return new

    def check_all(self, received: Iterable[tuple[str, bytes]]) -> Iterator[list[Verified[M] | Unresolved[M]]]:
        """The verified or `Unresolved` messages of keys and payloads, some every few milliseconds; others are counted.

        Each step is taken for all before the next one: a step is faster while its code stays in the CPU's caches.
        """
        received = list(received)
        parse_cids_ahead((payload for _, payload in received), self.message_type)
        decoded, unresolved = self._decode_all(received)
        if unresolved:
            yield [*unresolved]
        candidates = self._hash_all(decoded)
        for start in range(0, len(candidates), SLICE):
            yield self._verify_all(candidates[start : start + SLICE])

    def _decode_all(self, received: list[tuple[str, bytes]]) -> tuple[list[tuple[M, str, int]], list[Unresolved[M]]]:
        """The messages in payloads, with addresses for names, their keys and fingerprints; and those to ask about."""
        seen, expected = self._seen, self.message_type
        decoded, unresolved = list[tuple[M, str, int]](), list[Unresolved[M]]()
        for key, payload in received:
            if (fingerprint := hash(payload)) in seen:
                self._count_duplicates(1)
                continue
            try:
                message = decode(payload, expected)
                if not isinstance(message, expected):
                    raise InvalidMessage("kind", f"a {type(message).__name__} on a key of {expected.__name__}")
                # A name has a dot, which JSON may write with a backslash.
                if (_DOT in payload or _BACKSLASH in payload) and (names := names_in(message)):
                    if (addresses := self._rules.known_addresses(names)) is None:
                        unresolved.append(Unresolved(message, key, fingerprint))
                        continue
                    message = resolve_names(message, addresses)
            except InvalidMessage as error:
                self.reject(error.reason)
            else:
                decoded.append((message, key, fingerprint))
        return decoded, unresolved

    def _hash_all(self, decoded: list[tuple[M, str, int]]) -> list[_Candidate[M]]:
        """Those that fit their keys and their market and are no copies: hashed, and ready for their recovery."""
        seen, check, new = self._seen, self._rules.check, dict[int, _Candidate[M]]()
        for message, key, fingerprint in decoded:
            try:
                is_complete, digest = check(message, key), message_hash(message)
                identity = hash((digest, message.signature))
                if identity in seen or identity in new:
                    self._count_duplicates(1)
                    continue
                signed = signed_digest(digest, message.signature, is_typed_data=message.is_typed_data)
            except InvalidMessage as error:
                self.reject(error.reason)
            else:
                new[identity] = _Candidate(message, key, fingerprint, digest, identity, is_complete, signed)
        return list(new.values())

    def _verify_all(self, candidates: list[_Candidate[M]]) -> list[Verified[M] | Unresolved[M]]:
        """Verify signatures."""
        keys = recover_keys([each.signed for each in candidates])
        with self._lock:
            pairs = zip(candidates, keys, strict=True)
            verified = [found for each, key in pairs if (found := self._verify(each, key)) is not None]
            forget_oldest(self._seen, self._remembered)
        return verified

    def _verify(self, candidate: _Candidate[M], key: bytes) -> Verified[M] | Unresolved[M] | None:
        """A message whose key was recovered, unless one like it was accepted meanwhile. Call it with the lock."""
        if candidate.identity in self._seen:
            self._duplicate += 1
            return None
        try:
            verified = verify_recovered(candidate.message, candidate.hash, key)
        except InvalidMessage as error:
            self._invalid[error.reason] += 1
            return None
        if verified.signer in self._rules.blocked:
            self._invalid["blocked"] += 1
            return None
        if not candidate.is_complete:
            return Unresolved(candidate.message, candidate.key, candidate.fingerprint, verified.signer)
        self._accept(candidate.identity, candidate.fingerprint)
        return verified

    def _accept(self, identity: int, fingerprint: int) -> None:
        self._seen[identity], self._seen[fingerprint] = fingerprint, identity
        self._accepted += 1

    async def complete(self, unresolved: Unresolved[M]) -> Verified[M] | None:
        """Ask the chain about a message; the verified message, or None, which is counted under its reason."""
        try:
            verified = await self._rules.verified(unresolved.message, unresolved.key)
        except InvalidMessage as error:
            self.reject(error.reason)
            return None
        identity = hash((verified.hash, verified.message.signature))
        with self._lock:
            if identity in self._seen:  # accepted meanwhile
                self._duplicate += 1
                return None
            self._accept(identity, unresolved.fingerprint)
        return verified

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

    def _count_duplicates(self, number: int) -> None:
        with self._lock:
            self._duplicate += number
