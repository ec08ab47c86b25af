"""The order book: open demands and offers of one lighthouse, matched first come, first served. Pure: no I/O.

A demand and an offer match when model, objective, token, cost, lighthouse, validator and generation are equal. A book
serves one lighthouse, and has a queue of orders for each set of the other terms. Adding, matching and removing take
the same time at a thousand open orders and at a million; an order takes little more memory than its text.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeVar

from mesh.market.refusals import Refusal
from schemas import Demand, address_bytes

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Iterator

    from schemas import Offer, Verified

    Order = Demand | Offer
    Terms = tuple[str, str, str, int, str, int]

K = TypeVar("K", bound="Hashable")
T = TypeVar("T")

LIMIT: Final = 24_576
"""Open orders that a book holds by default: with up to 2 KB each, a provider stays below 200 MB."""
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


class QueueNode(Generic[T]):
    """An item in a queue. A queue is a ring: the last node's `after` is the first.

    Outside a queue a node has no neighbours, not even itself: a cycle would keep the item until the next garbage
    collection.
    """

    __slots__ = ("after", "before", "item")

    def __init__(self, item: T) -> None:
        self.item = item
        self.before: QueueNode[T]
        self.after: QueueNode[T]


class Queues(Generic[K, T]):
    """A first-in-first-out queue for each key, with removal from the middle in constant time.

    An empty queue takes no memory.
    """

    def __init__(self) -> None:
        self._first: dict[K, QueueNode[T]] = {}

    def first(self, key: K) -> QueueNode[T] | None:
        """The node that has waited longest at `key`."""
        return self._first.get(key)

    def items(self, key: K) -> Iterator[T]:
        """The items of the queue at `key`, the one that has waited longest first; it must not change meanwhile."""
        first = node = self._first.get(key)
        while node is not None:
            yield node.item
            node = None if node.after is first else node.after

    def append(self, key: K, node: QueueNode[T]) -> None:
        """Append a node, which is in no queue, to the queue at `key`."""
        first = self._first.get(key)
        if first is None:
            self._first[key] = node.before = node.after = node
        else:
            last = first.before
            last.after = first.before = node
            node.before, node.after = last, first

    def remove(self, key: K, node: QueueNode[T]) -> None:
        """Remove a node from the queue at `key`, which it must be in."""
        if node.after is node:
            del self._first[key]
        else:
            node.before.after, node.after.before = node.after, node.before
            if self._first[key] is node:
                self._first[key] = node.after
        del node.before, node.after


class OrderBook:
    """The open orders of the lighthouse at `lighthouse` (EIP-55 address), `limit` of them at most.

    An order stays for `deadline_limit` blocks at most, even if its deadline is later. A full book makes room: the
    signer with the most orders loses its newest; if none has more than one, the oldest order that is not matched, or
    that pays nothing, leaves.

    Not thread-safe. Methods are O(1) in the number of open orders, unless they say otherwise.
    """

    def __init__(self, lighthouse: str, *, limit: int = LIMIT, deadline_limit: int = UNLIMITED) -> None:
        self._lighthouse = lighthouse
        self._limit = limit
        self._deadline_limit = deadline_limit
        self._head = 0
        self._nodes: dict[bytes, _BookNode] = {}
        self._signers: Queues[str, bytes] = Queues()
        """The identities of each signer's orders, oldest first."""
        self._numbers: Counter[str] = Counter()
        """How many orders each signer has."""
        self._heaviest = ""
        """The signer that had the most orders when it added one."""
        self._unpaid: OrderedDict[bytes, None] = OrderedDict()
        """The identities of orders that are not matched or pay nothing, oldest first."""
        self._demands: Queues[Terms, Verified[Order]] = Queues()
        self._offers: Queues[Terms, Verified[Order]] = Queues()
        self._aside: set[bytes] = set()
        """Orders in the book that are not matched."""
        self._due: Queues[int, bytes] = Queues()
        """The identities of the orders that leave in each block."""

    def __len__(self) -> int:
        return len(self._nodes)

    def __contains__(self, identity: bytes) -> bool:
        return identity in self._nodes

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
        counterpart = waiting.first(_terms(message))
        if counterpart is not None:
            self.remove(order_id(counterpart.item))
            return _match(order, counterpart.item)
        evicted = self._make_room(order)
        if evicted is None:
            return Refusal.FULL
        self._enter(order)
        return Added(order, evicted)

    def set_aside(self, order: Verified[Order]) -> bool:
        """Add an order that is not matched until it is removed and added; False if the book refuses it."""
        if self._refusal(order) is not None or len(self._nodes) >= self._limit:
            return False
        self._aside.add(order_id(order))
        self._enter(order)
        return True

    def remove(self, identity: bytes) -> Verified[Order] | None:
        """Remove and return the order with this identity; None if it is not in the book."""
        node = self._nodes.pop(identity, None)
        if node is None:
            return None
        self._due.remove(node.due, node.of_due)
        message, signer = node.item.message, node.item.signer
        self._signers.remove(signer, node.of_signer)
        self._numbers[signer] -= 1
        if not self._numbers[signer]:
            del self._numbers[signer]
        self._unpaid.pop(identity, None)
        if identity in self._aside:
            self._aside.remove(identity)
        else:
            self._side(message).remove(_terms(message), node)
        return node.item

    def expire(self, head: int) -> list[Verified[Order]]:
        """Remove and return every order whose deadline, or time in the book, is not after block `head`.

        O(blocks passed + orders expired). A lower `head` than before (after a reorganisation) changes nothing.
        """
        before, self._head = self._head, max(self._head, head)
        reached: Iterable[int] = range(before + 1, head + 1)
        if head - before > len(self._nodes):
            reached = sorted({node.due for node in self._nodes.values() if node.due <= head})
        expired: list[Verified[Order]] = []
        for block in reached:
            while (node := self._due.first(block)) is not None and (order := self.remove(node.item)) is not None:
                expired.append(order)
        return expired

    def orders(self) -> Iterator[Verified[Order]]:
        """The open orders, oldest first. O(orders); the book must not change during the iteration."""
        return (node.item for node in self._nodes.values())

    def of(self, signer: str) -> list[Verified[Order]]:
        """The open orders of a signer. O(those orders)."""
        return [self._nodes[identity].item for identity in self._signers.items(signer)]

    def _refusal(self, order: Verified[Order]) -> Refusal | None:
        message = order.message
        if message.lighthouse != self._lighthouse:
            return Refusal.LIGHTHOUSE
        expired = message.deadline <= self._head
        return Refusal.EXPIRED if expired else Refusal.DUPLICATE if order_id(order) in self else None

    def _enter(self, order: Verified[Order]) -> None:
        message, identity = order.message, order_id(order)
        due = min(message.deadline, self._head + self._deadline_limit)
        node = self._nodes[identity] = _BookNode(order, due, identity)
        if identity not in self._aside:
            self._side(message).append(_terms(message), node)
        if identity in self._aside or not _pays(message):
            self._unpaid[identity] = None
        self._due.append(node.due, node.of_due)
        self._signers.append(order.signer, node.of_signer)
        self._numbers[order.signer] += 1
        if self._numbers[order.signer] >= self._numbers.get(self._heaviest, 0):
            self._heaviest = order.signer

    def _make_room(self, order: Verified[Order]) -> tuple[Verified[Order], ...] | None:
        """Evict an order if the book is full, and return it; None if the new one has no better right to a place."""
        if len(self._nodes) < self._limit:
            return ()
        most = self._numbers.get(self._heaviest, 0)
        if self._numbers.get(order.signer, 0) >= max(most, 1):
            return None
        if most > 1:
            last = self._signers.first(self._heaviest)
            assert last is not None
            evicted = self.remove(last.before.item)
        elif self._unpaid:
            evicted = self.remove(next(iter(self._unpaid)))
        else:
            return None
        assert evicted is not None
        return (evicted,)

    def _side(self, message: Order) -> Queues[Terms, Verified[Order]]:
        return self._demands if isinstance(message, Demand) else self._offers


class _BookNode(QueueNode["Verified[Order]"]):
    """An order in a book, when it leaves, and the nodes of its identity by signer and by block."""

    __slots__ = ("due", "of_due", "of_signer")

    def __init__(self, order: Verified[Order], due: int, identity: bytes) -> None:
        super().__init__(order)
        self.due = due
        self.of_due, self.of_signer = QueueNode(identity), QueueNode(identity)


def _pays(order: Order) -> bool:
    """Whether an order costs its maker something, which makes a flood of such orders expensive."""
    return (order.cost + order.validator_fee if isinstance(order, Demand) else order.lighthouse_fee) > 0


def _terms(order: Order) -> Terms:
    return (order.model, order.objective, order.token, order.cost, order.validator, order.generation)


def _match(order: Verified[Order], other: Verified[Order]) -> Match:
    if isinstance(order.message, Demand):
        return Match(order, other)  # type: ignore[arg-type]
    return Match(other, order)  # type: ignore[arg-type]
