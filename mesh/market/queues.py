"""First-in-first-out queues by key, with removal from the middle in constant time. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterator

K = TypeVar("K", bound="Hashable")
T = TypeVar("T")


class Link(Generic[T]):
    """A place in a queue, and what stands there. The queues are rings: the last link's `after` is the first."""

    __slots__ = ("after", "before", "item")

    def __init__(self, item: T) -> None:
        self.item = item
        self.before: Link[T] = self
        self.after: Link[T] = self


class Queues(Generic[K, T]):
    """A queue for each key; a key without a queue costs nothing."""

    def __init__(self) -> None:
        self._first: dict[K, Link[T]] = {}

    def __len__(self) -> int:
        """How many keys have a queue."""
        return len(self._first)

    def __iter__(self) -> Iterator[K]:
        return iter(self._first)

    def first(self, key: K) -> T | None:
        """What has waited longest at `key`."""
        link = self._first.get(key)
        return None if link is None else link.item

    def append(self, key: K, item: T) -> Link[T]:
        """Put `item` at the end of the queue at `key`; the link takes it out again."""
        link = Link(item)
        first = self._first.setdefault(key, link)
        if first is not link:
            last = first.before
            last.after = first.before = link
            link.before, link.after = last, first
        return link

    def remove(self, key: K, link: Link[T]) -> None:
        """Take the link that `append` gave for `key` out; exactly once."""
        if link.after is link:
            del self._first[key]
        else:
            link.before.after, link.after.before = link.after, link.before
            if self._first[key] is link:
                self._first[key] = link.after
        del link.before, link.after
