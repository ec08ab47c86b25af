"""Queues of an order book: with removal from the middle in constant time, and by who has how many orders."""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterator

K = TypeVar("K", bound="Hashable")
T = TypeVar("T")


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


class Share:
    """A part of a book's orders, by their identities: who has how many, and which leaves the full book."""

    def __init__(self) -> None:
        self._signers: Queues[str, bytes] = Queues()
        """The identities of each signer's orders, oldest first."""
        self._numbers: Counter[str] = Counter()
        """How many orders each signer has."""
        self._heaviest = ""
        """The signer that had the most orders when it added one."""
        self._oldest: OrderedDict[bytes, None] = OrderedDict()

    def __contains__(self, identity: bytes) -> bool:
        return identity in self._oldest

    def __len__(self) -> int:
        return len(self._oldest)

    def of(self, signer: str) -> Iterator[bytes]:
        """The identities of a signer's orders, oldest first."""
        return self._signers.items(signer)

    def add(self, identity: bytes, signer: str, node: QueueNode[bytes]) -> None:
        """Add an order, with the node of its identity."""
        self._signers.append(signer, node)
        self._oldest[identity] = None
        self._numbers[signer] += 1
        if self._numbers[signer] >= self._numbers.get(self._heaviest, 0):
            self._heaviest = signer

    def remove(self, identity: bytes, signer: str, node: QueueNode[bytes]) -> None:
        """Remove an order that was added."""
        self._signers.remove(signer, node)
        del self._oldest[identity]
        self._numbers[signer] -= 1
        if not self._numbers[signer]:
            del self._numbers[signer]

    def victim(self, signer: str, *, or_oldest: bool) -> bytes | None:
        """The order that leaves for one of `signer`: the newest of the signer with the most, if that is more than one.

        Else the oldest order, if that may leave. None if nobody has more than this signer.
        """
        most = self._numbers.get(self._heaviest, 0)
        if self._numbers.get(signer, 0) >= max(most, 1):
            return None
        if most > 1:
            newest = self._signers.first(self._heaviest)
            return None if newest is None else newest.before.item
        return next(iter(self._oldest), None) if or_oldest else None
