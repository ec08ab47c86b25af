"""The record of an order, and the book of those that are open, matched first come, first served. Pure: no I/O.

A demand and an offer match when model, objective, token, cost, lighthouse, validator and generation are equal. A book
serves one lighthouse, and has a queue of orders for each set of the other terms. Adding, matching and removing take
the same time at a thousand open orders and at a million; an order takes little more memory than its text.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeVar

from mesh.base.flood import KnownSenders
from mesh.settings.groups import OPEN_ORDERS_LIMIT
from schemas import Demand, Verified, address_bytes
from schemas.messages import equal_terms
from schemas.signing import Refusal

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Iterator, Mapping

    from mesh.base.retry import Backoff
    from schemas import Offer

    Order = Demand | Offer


RETRIED: Final = (Refusal.FULL, Refusal.REPLACED, Refusal.UNDECIDED)
"""The refusals of orders that the provider may take later."""


K = TypeVar("K", bound="Hashable")
T = TypeVar("T")


class Queues(Generic[K, T]):
    """A first-in-first-out queue for each key, with removal from the middle in constant time.

    A queue is a ring: each item has the one before and the one behind it in its slots `before_NAME` and `after_NAME`,
    and behind the last one is the first. So an item takes no further memory, and an empty queue none. Outside a queue
    an item has no neighbours, not even itself: a cycle would keep it until the next garbage collection.
    """

    def __init__(self, name: str) -> None:
        self._first: dict[K, T] = {}
        self._before, self._after = f"before_{name}", f"after_{name}"

    def first(self, key: K) -> T | None:
        """The item that has waited longest at `key`."""
        return self._first.get(key)

    def last(self, key: K) -> T | None:
        """The item that came to `key` last."""
        first = self._first.get(key)
        return None if first is None else getattr(first, self._before)

    def items(self, key: K) -> Iterator[T]:
        """The items at `key`, the one that has waited longest first; they must not change meanwhile."""
        first = item = self._first.get(key)
        while item is not None:
            yield item
            item = getattr(item, self._after)
            item = None if item is first else item

    def append(self, key: K, item: T) -> None:
        """Append an item, which is in none of these queues, to the one at `key`."""
        first = self._first.setdefault(key, item)
        last = item if first is item else getattr(first, self._before)
        setattr(item, self._before, last)
        setattr(item, self._after, first)
        setattr(last, self._after, item)
        setattr(first, self._before, item)

    def remove(self, key: K, item: T) -> None:
        """Remove an item from the queue at `key`, which it must be in."""
        before, after = getattr(item, self._before), getattr(item, self._after)
        if after is item:
            del self._first[key]
        else:
            setattr(before, self._after, after)
            setattr(after, self._before, before)
            if self._first[key] is item:
                self._first[key] = after
        delattr(item, self._before)
        delattr(item, self._after)


class OrderStage(StrEnum):
    """Where an order or a result is at a provider. `TRANSITIONS` says what may follow what."""

    RECEIVED = "received"
    """It waits to be looked at: an order until its maker's funds were asked for, a result for those of other jurors."""
    UNFUNDED = "unfunded"
    """In the book, but not matched: its maker can't pay."""
    OPEN = "open"
    """In the book, until another order matches it."""
    MATCHED = "matched"
    """It waits for its transaction: for the funds, the turn, and a place among those under way."""
    SENDING = "sending"
    """A transaction with it was sent, or may have been."""
    MINED = "mined"
    """An event that used it was read; its sender waits until that is confirmed."""
    CONFIRMED = "confirmed"
    """An event that used it was read, and nothing waits for it. Forgotten once no reorganisation can revert that."""
    WITHDRAWN = "withdrawn"
    """Its maker has withdrawn it."""
    REPLACED = "replaced"
    """Its maker has signed it again, or another version of it has become a contract."""
    EXPIRED = "expired"
    """Its deadline, or its time in the book, has passed."""
    REFUSED = "refused"
    """By the book (which is full), by the contracts, or because its maker is blocked or does not cover the gas."""


ENDS: Final = frozenset({OrderStage.WITHDRAWN, OrderStage.REPLACED, OrderStage.EXPIRED, OrderStage.REFUSED})
"""The states in which a provider has forgotten an order; a copy of it is received as a new one."""
BOOK: Final = frozenset({OrderStage.UNFUNDED, OrderStage.OPEN})
"""The states of orders in the book."""
TRANSITIONS: Final[Mapping[OrderStage, frozenset[OrderStage]]] = {
    OrderStage.RECEIVED: BOOK | ENDS | {OrderStage.MATCHED, OrderStage.CONFIRMED},
    OrderStage.UNFUNDED: ENDS | {OrderStage.RECEIVED, OrderStage.CONFIRMED},
    OrderStage.OPEN: ENDS | {OrderStage.MATCHED, OrderStage.CONFIRMED},
    OrderStage.MATCHED: ENDS | {OrderStage.SENDING, OrderStage.MINED, OrderStage.RECEIVED},
    OrderStage.SENDING: ENDS | {OrderStage.MINED, OrderStage.RECEIVED},
    OrderStage.MINED: frozenset({OrderStage.CONFIRMED, OrderStage.SENDING}),
    OrderStage.CONFIRMED: frozenset({OrderStage.RECEIVED}),
    **dict.fromkeys(ENDS, frozenset()),
}
"""What may follow each state. Back to `RECEIVED` means that it is looked at again as if it had just arrived."""


@dataclass(slots=True)
class Look:
    """When the maker of an unfunded order is asked after again (on the event loop's clock), and how often it was."""

    at: float
    backoff: Backoff


class OrderRecord:
    """The one record of an order or a result at a provider: its state, and what each state needs.

    In the book it has a `block` at which it leaves, a `share`, places in four queues, and a `look` if its maker can't
    pay; under settlement a `liability`, and the `block` of the event that used it (0 before). It keeps the parts of the
    message's `Verified` only, which are smaller.
    """

    __slots__ = (
        *("after_age", "after_due", "after_signer", "after_terms"),
        *("before_age", "before_due", "before_signer", "before_terms"),
        *("block", "identity", "liability", "look", "message", "share", "signer", "state"),
    )

    share: _Share
    look: Look

    def __init__(self, verified: Verified[Any]) -> None:
        self.message = verified.message
        self.signer = verified.signer
        self.identity = order_id(verified)
        self.state = OrderStage.RECEIVED
        self.liability = ""
        self.block = 0

    @property
    def verified(self) -> Verified[Any]:
        """The message as it arrived."""
        return Verified(self.message, self.identity[:32], self.signer)

    def move(self, state: OrderStage) -> None:
        assert state in TRANSITIONS[self.state], f"an order that is {self.state} can't become {state}"
        self.state = state


class _Share:
    """A part of a book's orders: who has how many, and which leaves the full book."""

    def __init__(self) -> None:
        self._signers: Queues[str, OrderRecord] = Queues("signer")
        self._ages: Queues[None, OrderRecord] = Queues("age")
        self._numbers: Counter[str] = Counter()
        """How many orders each signer has."""
        self._heaviest = ""
        """The signer that had the most orders when it added one."""
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def of(self, signer: str) -> Iterator[OrderRecord]:
        """A signer's orders, oldest first."""
        return self._signers.items(signer)

    def add(self, record: OrderRecord) -> None:
        record.share = self
        self._signers.append(record.signer, record)
        self._ages.append(None, record)
        self._size += 1
        self._numbers[record.signer] += 1
        if self._numbers[record.signer] >= self._numbers.get(self._heaviest, 0):
            self._heaviest = record.signer

    def remove(self, record: OrderRecord) -> None:
        self._signers.remove(record.signer, record)
        self._ages.remove(None, record)
        self._size -= 1
        self._numbers[record.signer] -= 1
        if not self._numbers[record.signer]:
            del self._numbers[record.signer]

    def victim(self, signer: str, *, or_oldest: bool) -> OrderRecord | None:
        """The order that leaves for one of `signer`: the newest of the signer with the most, if that is more than one.

        Else the oldest order, if that may leave. None if nobody has more than this signer.
        """
        most = self._numbers.get(self._heaviest, 0)
        if self._numbers.get(signer, 0) >= max(most, 1):
            return None
        if most > 1:
            return self._signers.last(self._heaviest)
        return self._ages.first(None) if or_oldest else None


UNLIMITED: Final = 2**256


class Match(NamedTuple):
    """A demand and an offer with equal terms, which have left the book."""

    demand: Verified[Demand]
    offer: Verified[Offer]


@dataclass(frozen=True, slots=True)
class Added:
    """The order is in the book and waits for its counterpart. Others may have been evicted for it."""

    order: Verified[Order]
    evicted: tuple[Verified[Order], ...] = ()


def order_id(order: Verified[Any]) -> bytes:
    """The identity of an order or result: hash and signer, as several people may sign the same."""
    return order.hash + address_bytes(order.signer)


class OrderBook:
    """The open orders of the lighthouse at `lighthouse` (EIP-55 address), `limit` of them at most.

    An order stays for `deadline_limit` blocks at most, even if its deadline is later. A full book makes room: first
    those orders leave that are not matched, or that pay nothing and whose signer is not `known`. Of these the signer
    with the most loses its newest; if none has more than one, the oldest leaves. If all others pay or are of known
    signers, only a signer with more orders than the new one's loses its newest.

    `records` may have others, in other states than those of the book; an order that leaves the book leaves them, too.
    Not thread-safe. Methods are O(1) in the number of open orders, unless they say otherwise.
    """

    def __init__(
        self,
        lighthouse: str,
        *,
        limit: int = OPEN_ORDERS_LIMIT,
        deadline_limit: int = UNLIMITED,
        records: dict[bytes, OrderRecord] | None = None,
    ) -> None:
        self._lighthouse = lighthouse
        self._limit = limit
        self._deadline_limit = deadline_limit
        self._head = 0
        self._records: dict[bytes, OrderRecord] = {} if records is None else records
        self.unfunded = 0
        """How many orders are set aside."""
        self.known: Final = KnownSenders()
        """The accounts that a liability was created for: their orders leave last."""
        self._first, self._last = _Share(), _Share()
        """The orders that leave a full book first, and the others."""
        self._demands: Queues[int, OrderRecord] = Queues("terms")
        self._offers: Queues[int, OrderRecord] = Queues("terms")
        """By the hash of their terms, which takes less memory than these: nobody can foresee it, and orders whose terms
        happen to have the same wait for each other."""
        self._due: Queues[int, OrderRecord] = Queues("due")
        """The orders that leave in each block."""

    def __len__(self) -> int:
        return len(self._first) + len(self._last)

    def __contains__(self, identity: bytes) -> bool:
        return self._get(identity) is not None

    @property
    def head(self) -> int:
        """The latest block that `expire` was called with."""
        return self._head

    def add(self, order: Verified[Order]) -> Match | Added | Refusal:
        """Add a verified order. Returns a `Match` with the oldest counterpart, `Added`, or the reason of a refusal."""
        message = order.message
        if (refusal := self._refusal(order)) is not None:
            return refusal
        waiting = self._offers if isinstance(message, Demand) else self._demands
        terms = equal_terms(message)
        counterpart = waiting.first(hash(terms))
        if counterpart is not None and equal_terms(counterpart.message) == terms:
            self._leave(counterpart, OrderStage.MATCHED)
            other: Verified[Any] = counterpart.verified
            return Match(order, other) if isinstance(message, Demand) else Match(other, order)  # type: ignore[arg-type]
        evicted = self._make_room(order)
        if evicted is None:
            return Refusal.FULL
        self._enter(order, OrderStage.OPEN)
        return Added(order, evicted)

    def set_aside(self, order: Verified[Order]) -> bool:
        """Add an order that is not matched until it is removed and added; False if the book refuses it."""
        if self._refusal(order) is not None or len(self) >= self._limit:
            return False
        self._enter(order, OrderStage.UNFUNDED)
        return True

    def remove(self, identity: bytes, state: OrderStage = OrderStage.WITHDRAWN) -> Verified[Order] | None:
        """Remove and return the order with this identity, which enters `state`; None if it is not in the book."""
        record = self._get(identity)
        if record is None:
            return None
        self._leave(record, state)
        return record.verified

    def stays(self, identity: bytes) -> bool:
        """Whether the order with this identity is in the book, and leaves it last when it is full."""
        record = self._get(identity)
        return record is not None and record.share is self._last

    def expire(self, head: int) -> list[Verified[Order]]:
        """Remove and return every order whose deadline, or time in the book, is not after block `head`.

        O(blocks passed + orders expired). A lower `head` than before (after a reorganisation) changes nothing.
        """
        before, self._head = self._head, max(self._head, head)
        reached: Iterable[int] = range(before + 1, head + 1)
        if head - before > len(self):
            reached = sorted({record.block for record in self._open() if record.block <= head})
        expired: list[Verified[Order]] = []
        for block in reached:
            while (record := self._due.first(block)) is not None:
                self._leave(record, OrderStage.EXPIRED)
                expired.append(record.verified)
        return expired

    def orders(self) -> Iterator[Verified[Order]]:
        """The open orders, oldest first. O(orders); the book must not change during the iteration."""
        return (record.verified for record in self._open())

    def messages(self) -> list[Order]:
        """The same without their signers, which takes no memory but for the list."""
        return [record.message for record in self._open()]

    def of(self, signer: str) -> list[Verified[Order]]:
        """The open orders of a signer. O(those orders)."""
        return [record.verified for share in (self._first, self._last) for record in share.of(signer)]

    def _get(self, identity: bytes) -> OrderRecord | None:
        record = self._records.get(identity)
        return record if record is not None and record.state in BOOK else None

    def _open(self) -> Iterator[OrderRecord]:
        return (record for record in self._records.values() if record.state in BOOK)

    def _refusal(self, order: Verified[Order]) -> Refusal | None:
        message = order.message
        if message.lighthouse != self._lighthouse:
            return Refusal.LIGHTHOUSE
        expired = message.deadline <= self._head
        return Refusal.EXPIRED if expired else Refusal.DUPLICATE if order_id(order) in self._records else None

    def _enter(self, order: Verified[Order], state: OrderStage) -> None:
        message, record = order.message, OrderRecord(order)
        self._records[record.identity] = record
        record.move(state)
        record.block = min(message.deadline, self._head + self._deadline_limit)
        self._due.append(record.block, record)
        if state is OrderStage.OPEN:
            self._side(message).append(hash(equal_terms(message)), record)
            self._share_of(order).add(record)
        else:
            self.unfunded += 1
            self._first.add(record)

    def _leave(self, record: OrderRecord, state: OrderStage) -> None:
        record.share.remove(record)
        self._due.remove(record.block, record)
        if record.state is OrderStage.UNFUNDED:
            self.unfunded -= 1
        else:
            self._side(record.message).remove(hash(equal_terms(record.message)), record)
        del self._records[record.identity]
        record.move(state)

    def _share_of(self, order: Verified[Order]) -> _Share:
        """That of an order which is matched. A flood of orders that cost their maker something is expensive."""
        message = order.message
        cost = message.cost + message.validator_fee if isinstance(message, Demand) else message.lighthouse_fee
        return self._last if cost or order.signer in self.known else self._first

    def _make_room(self, order: Verified[Order]) -> tuple[Verified[Order], ...] | None:
        """Evict an order if the book is full, and return it; None if the new one has no better right to a place."""
        if len(self) < self._limit:
            return ()
        share, own = self._first if self._first else self._last, self._share_of(order)
        if own is not share and own is self._first:
            return None
        victim = share.victim(order.signer if own is share else "", or_oldest=share is self._first)
        if victim is None:
            return None
        self._leave(victim, OrderStage.REFUSED)
        return (victim.verified,)

    def _side(self, message: Order) -> Queues[int, OrderRecord]:
        return self._demands if isinstance(message, Demand) else self._offers
