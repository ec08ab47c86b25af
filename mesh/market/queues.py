"""First-in-first-out queues by key, with removal from the middle in constant time. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterator

K = TypeVar("K", bound="Hashable")
T = TypeVar("T")


class Link(Generic[T]):
    """A place in a queue, and what stands there. The queues are rings: the last link's `after` is the first.

    Outside a queue it has no neighbours, not even itself: a cycle would keep the item until the garbage collector came.
    """

    __slots__ = ("after", "before", "item")

    def __init__(self, item: T) -> None:
        self.item = item
        self.before: Link[T]
        self.after: Link[T]


class Queues(Generic[K, T]):
    """A queue for each key; a key without a queue costs nothing."""

    def __init__(self) -> None:
        self._first: dict[K, Link[T]] = {}

    def __len__(self) -> int:
        """How many keys have a queue."""
        return len(self._first)

    def __iter__(self) -> Iterator[K]:
        return iter(self._first)

    def first(self, key: K) -> Link[T] | None:
        """The link that has waited longest at `key`."""
        return self._first.get(key)

    def append(self, key: K, link: Link[T]) -> None:
        """Put a link, which stands in no queue, at the end of the one at `key`."""
        first = self._first.get(key)
        if first is None:
            self._first[key] = link.before = link.after = link
        else:
            last = first.before
            last.after = first.before = link
            link.before, link.after = last, first

    def remove(self, key: K, link: Link[T]) -> None:
        """Take a link out of the queue at `key`, where it stands."""
        if link.after is link:
            del self._first[key]
        else:
            link.before.after, link.after.before = link.after, link.before
            if self._first[key] is link:
                self._first[key] = link.after
        del link.before, link.after
