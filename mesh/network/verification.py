"""The door of the channel: what a sample must hold before anything else sees it.

Checks go from cheap to dear, so that rubbish costs little: the key is concrete, the JSON decodes, the key says what
the message says, the deadline is ahead, the message is new; only then the signature is recovered, once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeVar

import msgspec

from mesh.errors import InvalidMessage
from schemas import Result, SignedMessage, Verified, decode, message_hash, names_in, resolve_names
from schemas.signing import verify_hashed

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh

M = TypeVar("M", bound=SignedMessage)

REMEMBERED: Final = 65_536
"""Messages of which the door remembers that they passed."""


class Unresolved(NamedTuple, Generic[M]):
    """A message that names an address by ENS: it can't be hashed before the names are looked up."""

    message: M
    key: str


class Statistics(msgspec.Struct, frozen=True, kw_only=True):
    """What came through one door so far. `invalid` counts by reason; `dropped` fell out unseen, oldest first."""

    received: int
    invalid: Mapping[str, int]
    duplicate: int
    dropped: int


class Door(Generic[M]):
    """Lets the verified messages of one kind pass, and counts the others.

    `lighthouse` is the market's name in keys; `address`, where it is known, must be the orders' lighthouse. `head`
    tells the number of the latest block, or 0 when it isn't known (then no deadline is checked). Not thread-safe:
    one thread calls `check` (the pump's).
    """

    def __init__(self, kind: type[M], *, lighthouse: str, address: str | None, head: Callable[[], int]) -> None:
        self._kind: type[M] = kind
        self._prefix = f"aira/{lighthouse}/{kind.__name__.lower()}/"
        self._address = address
        self._head = head
        self._passed: dict[tuple[bytes, str], None] = {}
        self.invalid: Counter[str] = Counter()
        self.duplicate = 0

    def __call__(self, sample: zenoh.Sample) -> Verified[M] | Unresolved[M] | None:
        """What a Zenoh sample holds, if it may pass."""
        return self.check(str(sample.key_expr), sample.payload.to_bytes())

    def check(self, key: str, payload: bytes) -> Verified[M] | Unresolved[M] | None:
        """The message of `payload`, verified; or unresolved; or None, counted under its reason."""
        try:
            message = decode(payload)
            if not isinstance(message, self._kind):
                raise InvalidMessage("kind", f"a {type(message).__name__} on a key of {self._kind.__name__}")
            if names_in(message):
                return Unresolved(message, key)
            return self._verified(message, key)
        except InvalidMessage as error:
            self.invalid[error.reason] += 1
            return None

    def resolved(self, unresolved: Unresolved[M], addresses: Mapping[str, str]) -> Verified[M] | None:
        """The message with its names replaced by `addresses` (name → address), checked like any other."""
        try:
            return self._verified(resolve_names(unresolved.message, addresses), unresolved.key)
        except InvalidMessage as error:
            self.invalid[error.reason] += 1
            return None

    def _verified(self, message: M, key: str) -> Verified[M] | None:
        digest = message_hash(message)
        chunk = message.liability.lower() if isinstance(message, Result) else message.model
        if key != f"{self._prefix}{chunk}/{digest.hex()}":
            raise InvalidMessage("key", f"the message does not belong on {key}")
        self._check_order(message)
        if (digest, message.signature) in self._passed:
            self.duplicate += 1
            return None
        verified = verify_hashed(message, digest)
        self._remember((digest, message.signature))
        return verified

    def _check_order(self, order: SignedMessage) -> None:
        if isinstance(order, Result):
            return
        if order.deadline <= self._head():
            raise InvalidMessage("deadline", f"block {order.deadline} has passed")
        if self._address is not None and order.lighthouse != self._address:
            raise InvalidMessage("lighthouse", f"made for {order.lighthouse}, not for this market")

    def _remember(self, identity: tuple[bytes, str]) -> None:
        """Keep the identity; the oldest is forgotten. Two signers of equal generation-3 terms are two messages."""
        if len(self._passed) >= REMEMBERED:
            del self._passed[next(iter(self._passed))]
        self._passed[identity] = None
