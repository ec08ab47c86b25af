"""The ring in which received samples wait: bounded in number and bytes, with a second chance for what is sent again."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

REMEMBERED: Final = 65_536
"""Dropped items that a ring remembers."""


class _Lane:
    """Items in order; the oldest are dropped beyond `capacity` items or `capacity_bytes`, but never the last one."""

    def __init__(self, capacity: int, capacity_bytes: int) -> None:
        self.items: deque[tuple[Any, int]] = deque()
        self._bytes = 0
        self._capacity = capacity
        self._capacity_bytes = capacity_bytes

    def append(self, item: Any, size: int) -> list[Any]:
        """Add an item of `size` bytes; returns what was dropped for it."""
        items, dropped = self.items, []
        items.append((item, size))
        self._bytes += size
        while len(items) > self._capacity or (self._bytes > self._capacity_bytes and len(items) > 1):
            dropped += self.take(1)
        return dropped

    def take(self, number: int) -> list[Any]:
        """Remove up to `number` items, the oldest first."""
        taken = [self.items.popleft() for _ in range(min(number, len(self.items)))]
        self._bytes -= sum(size for _, size in taken)
        return [item for item, _ in taken]


class ReceiveRing:
    """Received items that wait for their conversion, the oldest of which are dropped when there are too many.

    With `second_chance`, which needs hashable items, an item that equals one that was dropped before waits in a lane of
    its own, which gets three quarters of the conversions. Honest senders send again what has no effect; so in a flood
    of ever new messages their second copy gets through, where otherwise each copy had the same small chance.
    """

    def __init__(self, capacity: int, capacity_bytes: int, *, second_chance: bool) -> None:
        self._first = _Lane(capacity, capacity_bytes)
        self._again = _Lane(capacity, capacity_bytes)
        self._second_chance = second_chance
        # Hashes of dropped items, with a key that only this process knows, in two generations.
        self._young: set[int] = set()
        self._old: set[int] = set()

    def __len__(self) -> int:
        return len(self._first.items) + len(self._again.items)

    def append(self, item: Any, size: int) -> int:
        """Add an item of `size` bytes; returns how many were dropped for it."""
        is_known = self._young and self._was_dropped(item)
        dropped = (self._again if is_known else self._first).append(item, size)
        if dropped and self._second_chance:
            self._remember(dropped)
        return len(dropped)

    def take(self, number: int) -> list[Any]:
        """Remove up to `number` items."""
        waiting = len(self._first.items)
        again = self._again.take(number - min(waiting, number // 4))
        return again + self._first.take(number - len(again))

    def _was_dropped(self, item: Any) -> bool:
        number = hash(item)
        return number in self._young or number in self._old

    def _remember(self, dropped: list[Any]) -> None:
        if len(self._young) >= REMEMBERED // 2:
            self._young, self._old = set(), self._young
        self._young.update(map(hash, dropped))
