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
from mesh.network.lookups import M, MarketRules, NameCache, Unresolved
from schemas import SignedMessage, Verified, decode, message_hash, names_in, resolve_names
from schemas.keys import market_key
from schemas.signing import SignedDigest, recover_keys, signed_digest, verify_recovered
from schemas.wire import parse_cids_ahead

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from mesh.blocklist import BlockedSigners
    from mesh.clock import Clock
    from mesh.network.lookups import Resolver, ValidatorCheck

log = logging.getLogger(__name__)

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
    """Verifies the messages of one kind, and counts those that it rejects.

    `lighthouse` is the market's name in keys; `address`, if given, must be the orders' lighthouse. `head` returns the
    latest block number, or 0 if it isn't known (then no deadline is checked); `resolver` resolves ENS names;
    `validators` knows which validators orders may name (None: any); messages of `blocked` signers are rejected.
    Thread-safe, except `complete`.

    A message is a duplicate if its hash and signature equal those of one of the last accepted messages
    (`deduplication_limit` at most, half of that at least) that were not forgotten since, or of one that is checked
    with it; equal generation-3 terms from two signers are two messages. A copy of an accepted message with the same
    bytes is recognized before it is decoded. Consumers hold a message until the chain has confirmed its effect, or
    `forget` it, and then the sender's next copy gets through.
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
        self._rules = MarketRules(address, head, validators)
        self._names = None if resolver is None else NameCache(resolver)
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
        parse_cids_ahead((payload for _, payload in received), self.kind)
        decoded, unresolved = self._decode_all(received)
        if unresolved:
            yield [*unresolved]
        candidates = self._hash_all(decoded)
        for start in range(0, len(candidates), SLICE):
            yield self._verify_all(candidates[start : start + SLICE])

    def _decode_all(self, received: list[tuple[str, bytes]]) -> tuple[list[tuple[M, str, int]], list[Unresolved[M]]]:
        """The messages in payloads, with addresses for names, their keys and fingerprints; and those to ask about."""
        seen, kind, decoded, unresolved = self._seen, self.kind, list[tuple[M, str, int]](), list[Unresolved[M]]()
        for key, payload in received:
            if (fingerprint := hash(payload)) in seen:
                self._count_duplicates(1)
                continue
            try:
                message = decode(payload, kind)
                if not isinstance(message, kind):
                    raise InvalidMessage("kind", f"a {type(message).__name__} on a key of {kind.__name__}")
                # A name has a dot, which JSON may write with a backslash.
                if (_DOT in payload or _BACKSLASH in payload) and (names := names_in(message)):
                    if self._names is None:
                        raise InvalidMessage("name", f"no chain to resolve {', '.join(sorted(names))}")
                    if (addresses := self._names.known(names)) is None:
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
                if key != message_key(self._lighthouse, message):
                    raise InvalidMessage("key", f"the message does not belong on {key}")
                is_complete, digest = check(message), message_hash(message)
                identity = hash((digest, message.signature))
                if identity in seen or identity in new:
                    self._count_duplicates(1)
                    continue
                signed = signed_digest(digest, message.signature)
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
        identity, seen = candidate.identity, self._seen
        if identity in seen:
            self._duplicate += 1
            return None
        try:
            verified = verify_recovered(candidate.message, candidate.hash, key)
        except InvalidMessage as error:
            self._invalid[error.reason] += 1
            return None
        if verified.signer in self._blocked:
            self._invalid["blocked"] += 1
            return None
        if not candidate.is_complete:
            return Unresolved(candidate.message, candidate.key, candidate.fingerprint, verified.signer)
        seen[identity], seen[candidate.fingerprint] = candidate.fingerprint, identity
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
                candidates = self._hash_all([(message, unresolved.key, unresolved.fingerprint)])
                outcome = next(iter(self._verify_all(candidates)), None)
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
        if not names:
            await self._rules.ask(message)
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

    def _count_duplicates(self, number: int) -> None:
        with self._lock:
            self._duplicate += number
