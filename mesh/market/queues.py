"""First-in-first-out queues by key, as the order book needs them: with removal from the middle in constant time."""

from __future__ import annotations

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

    def __len__(self) -> int:
        """The number of keys with a queue."""
        return len(self._first)

    def __iter__(self) -> Iterator[K]:
        return iter(self._first)

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
