"""The ring of a pump: what was received and waits for its conversion, bounded by number and bytes. No I/O."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, Final

from mesh.flood import forget_oldest

if TYPE_CHECKING:
    from collections.abc import Iterable

REMEMBERED: Final = 65_536
"""Items that the ring remembers, at most; half of them at least."""
COPIES: Final = 4
"""Copies of an item that the ring counts: later ones count as the last of these."""
IN_ORDER: Final = 2048
"""First copies that wait while the oldest go first: some 140 ms of verifications. When more wait, the newest do."""


class _Lane(deque[tuple[Any, int]]):
    """Items with their sizes in bytes, and their total `size`. The oldest are trimmed beyond the bounds, but never the
    last one.

    While more than `in_order` wait, the newest go first.
    """

    def __init__(self, capacity: int, capacity_bytes: int, *, in_order: int) -> None:
        super().__init__()
        self._capacity = capacity
        self._capacity_bytes = capacity_bytes
        self._in_order = in_order
        self.size = 0

    def trim(self) -> int:
        """Drop what is beyond the bounds; returns how many."""
        before = len(self)
        while len(self) > self._capacity or (self.size > self._capacity_bytes and len(self) > 1):
            self.size -= self.popleft()[1]
        return before - len(self)

    def take(self, number: int) -> list[Any]:
        """Remove up to `number` items."""
        next_item = self.pop if len(self) > self._in_order else self.popleft
        taken = [next_item() for _ in range(min(number, len(self)))]
        self.size -= sum([size for _, size in taken])
        return [item for item, _ in taken]


class ReceiveRing:
    """Received items that wait for their conversion, the oldest of which are dropped when there are too many.

    With `second_chance`, which needs hashable items, first copies have a lane, second copies another, and so on. Each
    lane gets the same share of the conversions, and what the others leave. In the lanes of copies the newest go first,
    and fewer wait: `capacity` and `capacity_bytes` divided by `COPIES`. Among first copies they do while more than
    `IN_ORDER` wait, so that what a flood has left behind delays nobody. Honest senders repeat what has no effect, so in
    a flood of new messages their second copy gets through at once, and in a flood of second copies the third does.
    """

    def __init__(self, capacity: int, capacity_bytes: int, *, second_chance: bool) -> None:
        self._second_chance = second_chance
        self._lanes = [_Lane(capacity, capacity_bytes, in_order=IN_ORDER if second_chance else capacity)]
        if second_chance:
            few, few_bytes = capacity // COPIES, capacity_bytes // COPIES
            self._lanes += [_Lane(few, few_bytes, in_order=0) for _ in range(COPIES - 1)]
        self._copies: dict[int, int] = {}
        """How often an item came, by its hash with a key that only this process knows."""

    def __len__(self) -> int:
        return sum(map(len, self._lanes))

    def extend(self, items: Iterable[Any], sizes: Iterable[int]) -> int:
        """Add items of these sizes in bytes, except None; returns how many were dropped for them."""
        number, copies, lanes, second_chance = 0, self._copies, self._lanes, self._second_chance
        for item, size in zip(items, sizes, strict=False):  # there are fewer items if the conversion of one failed
            if item is None:
                continue
            if second_chance:
                key = hash(item)
                number = copies.pop(key, 0)
                copies[key] = number + 1 if number < COPIES - 1 else number
            lane = lanes[number]
            lane.append((item, size))
            lane.size += size
        forget_oldest(copies, REMEMBERED)
        return sum([lane.trim() for lane in lanes])

    def take(self, number: int) -> list[Any]:
        """Remove up to `number` items."""
        taken: list[Any] = []
        filled = sorted(filter(None, self._lanes), key=len)
        for left, lane in zip(range(len(filled), 0, -1), filled, strict=True):
            taken += lane.take(-(-(number - len(taken)) // left))
        return taken
