"""The door of the channel: what a sample must hold before anything else sees it.

Checks go from cheap to dear, so that rubbish costs little: the JSON decodes, the message is new, the key says what the
message says (so it is concrete, too), the deadline is ahead; only then the signature is recovered, once.
"""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeVar

import msgspec

from mesh.errors import InvalidMessage
from mesh.network.addressing import key_of, verified_key
from schemas import Result, SignedMessage, Verified, decode, message_hash, names_in, resolve_names
from schemas.signing import verify_hashed

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh

M = TypeVar("M", bound=SignedMessage)

AMBIGUOUS_NONCE: Final = "00" * 12
"""How no nonce of generation 3 may begin."""
REMEMBERED: Final = 65_536
"""Messages of which the door remembers that they passed."""


class Unresolved(NamedTuple, Generic[M]):
    """A message that names an address by ENS: it can't be hashed before the names are looked up."""

    message: M
    key: str


class Statistics(msgspec.Struct, frozen=True, kw_only=True):
    """What came through one door so far. `invalid` counts by reason; `dropped` fell out unseen, oldest first."""

    received: int
    accepted: int
    invalid: Mapping[str, int]
    duplicate: int
    dropped: int


class MessageValidator(Generic[M]):
    """Lets the verified messages of one kind pass, and counts the others.

    `lighthouse` is the market's name in keys; `address`, where it is known, must be the orders' lighthouse. `head`
    tells the number of the latest block, or 0 when it isn't known (then no deadline is checked). A message is the same
    as one that passed when key and signature are: two signers of equal generation-3 terms are two messages. Safe to
    use from several threads.
    """

    def __init__(self, kind: type[M], *, lighthouse: str, address: str | None, head: Callable[[], int]) -> None:
        self.kind: type[M] = kind
        self._lighthouse = lighthouse
        self._address = address
        self._head = head
        self._lock = threading.Lock()
        self._passed: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._invalid: Counter[str] = Counter()
        self._duplicate = 0
        self._accepted = 0

    def __call__(self, sample: zenoh.Sample) -> Verified[M] | Unresolved[M] | None:
        """What a Zenoh sample holds, if it may pass."""
        return self.check(str(sample.key_expr), sample.payload.to_bytes())

    def check(self, key: str, payload: bytes) -> Verified[M] | Unresolved[M] | None:
        """The message of `payload`, verified; or unresolved; or None, counted under its reason."""
        try:
            message = decode(payload)
            if not isinstance(message, self.kind):
                raise InvalidMessage("kind", f"a {type(message).__name__} on a key of {self.kind.__name__}")
            if (key, message.signature) in self._passed:
                self._count_duplicate()
                return None
            return Unresolved(message, key) if names_in(message) else self._verified(message, key)
        except InvalidMessage as error:
            self.refuse(error.reason)
            return None

    def resolved(self, unresolved: Unresolved[M], addresses: Mapping[str, str]) -> Verified[M] | None:
        """The message with its names replaced by `addresses` (name → address), checked like any other."""
        try:
            return self._verified(resolve_names(unresolved.message, addresses), unresolved.key)
        except InvalidMessage as error:
            self.refuse(error.reason)
            return None

    def refuse(self, reason: str) -> None:
        """Count a message that does not pass."""
        with self._lock:
            self._invalid[reason] += 1

    def forget(self, verified: Verified[M]) -> None:
        """Let a message that has passed pass once more, when it is sent again."""
        with self._lock:
            self._passed.pop((verified_key(self._lighthouse, verified), verified.message.signature), None)

    def statistics(self, *, received: int, dropped: int) -> Statistics:
        """What passed through this door, given what came to it and what was lost before."""
        with self._lock:
            return Statistics(
                received=received,
                accepted=self._accepted,
                invalid=dict(self._invalid),
                duplicate=self._duplicate,
                dropped=dropped,
            )

    def _verified(self, message: M, key: str) -> Verified[M] | None:
        digest = message_hash(message)
        if key != key_of(self._lighthouse, message, digest):
            raise InvalidMessage("key", f"the message does not belong on {key}")
        self._check_order(message)
        verified = verify_hashed(message, digest)
        return verified if self._passes_first(message, key) else None

    def _check_order(self, order: SignedMessage) -> None:
        if isinstance(order, Result):
            return
        if order.generation == 3 and str(order.nonce).startswith(AMBIGUOUS_NONCE):
            raise InvalidMessage("nonce", "the contracts would take it for the sender of a generation-5 order")
        if order.deadline <= self._head():
            raise InvalidMessage("deadline", f"block {order.deadline} has passed")
        if self._address is not None and order.lighthouse != self._address:
            raise InvalidMessage("lighthouse", f"made for {order.lighthouse}, not for this market")

    def _count_duplicate(self) -> None:
        with self._lock:
            self._duplicate += 1

    def _passes_first(self, message: M, key: str) -> bool:
        """Remember that the message passes, and forget the oldest; False if it passed meanwhile on another thread."""
        with self._lock:
            if (key, message.signature) in self._passed:
                self._duplicate += 1
                return False
            if len(self._passed) >= REMEMBERED:
                self._passed.popitem(last=False)
            self._passed[key, message.signature] = None
            self._accepted += 1
        return True
