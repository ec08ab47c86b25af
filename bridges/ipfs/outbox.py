"""Messages on their way to one side: those that this bridge is to carry, and those left to another. Pure."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from bridges.ipfs.gate import Passenger
    from bridges.ipfs.turns import Turn

RESCUE: Final = 10.0
"""Seconds in which nothing that was left to others arrived, after which it is not left to them any more."""


@dataclass(slots=True)
class Waiting:
    """A message that waits. `shared`: another bridge was there when it came, and keeps it too."""

    passenger: Passenger
    shared: bool
    left_to: Turn | None
    since: float


class Outbox:
    """Holds `limit` messages at most; one that finds no room is not accepted, so that what is accepted is not lost."""

    def __init__(self, *, limit: int) -> None:
        self._limit = limit
        self._mine: OrderedDict[bytes, Waiting] = OrderedDict()
        self._left: OrderedDict[bytes, Waiting] = OrderedDict()
        self._unheard: OrderedDict[bytes, Waiting] = OrderedDict()
        self._progress = 0.0

    def __len__(self) -> int:
        """How many wait for this bridge to carry them."""
        return len(self._mine)

    def __contains__(self, fingerprint: bytes) -> bool:
        return fingerprint in self._mine or fingerprint in self._left

    @property
    def left(self) -> int:
        """How many are left to other bridges and were not seen on the far side yet."""
        return len(self._left)

    @property
    def unheard(self) -> int:
        """How many were said when nobody listened, and will be said again."""
        return len(self._unheard)

    def add(self, waiting: Waiting) -> bool:
        """Accept a message; False when there is no room."""
        if len(self._mine) + len(self._left) >= self._limit:
            return False
        where = self._mine if waiting.left_to is None else self._left
        if where is self._left and not where:
            self._progress = waiting.since
        where[waiting.passenger.fingerprint] = waiting
        return True

    def next(self) -> Waiting | None:
        """The message that has waited longest for this bridge."""
        return next(iter(self._mine.values()), None)

    def arrived(self, fingerprint: bytes, *, now: float) -> bool:
        """It is on the far side, whoever carried it; False if it did not wait."""
        if self._left.pop(fingerprint, None) is not None:
            self._progress = now
            return True
        return self._mine.pop(fingerprint, None) is not None

    def drop(self, fingerprint: bytes) -> None:
        """Give a message up."""
        self._mine.pop(fingerprint, None)

    def said_to_nobody(self, waiting: Waiting) -> bool:
        """Keep a message that was carried when nobody listened; False if the oldest such one had to go for it."""
        self._unheard[waiting.passenger.fingerprint] = waiting
        if len(self._unheard) <= self._limit:
            return True
        self._unheard.popitem(last=False)
        return False

    def heard(self, fingerprint: bytes) -> None:
        """Somebody else has said it where there are listeners."""
        self._unheard.pop(fingerprint, None)

    def say_again(self) -> int:
        """Somebody listens now: what nobody heard waits again, before all else. How many they are."""
        again, self._unheard = self._unheard, OrderedDict()
        for fingerprint in reversed(again):
            self._mine[fingerprint] = again[fingerprint]
            self._mine.move_to_end(fingerprint, last=False)
        return len(again)

    def hand_over(self, to: Turn, *, now: float) -> None:
        """Another is to carry from now on: it has what came since it is there."""
        for fingerprint in [name for name, waiting in self._mine.items() if waiting.shared]:
            self._leave(self._mine.pop(fingerprint), to, now)

    def gone(self, turn: Turn, heir: Turn | None, *, now: float) -> None:
        """Who had that turn does not carry any more: `heir` does, or this bridge."""
        for fingerprint in [name for name, waiting in self._left.items() if waiting.left_to == turn]:
            waiting = self._left.pop(fingerprint)
            if heir is None:
                self._take(waiting)
            else:
                self._leave(waiting, heir, now)

    def forget_left(self) -> list[bytes]:
        """This bridge was away and can't have seen what others carried meanwhile: trust that they did. Which it was."""
        forgotten = list(self._left)
        self._left.clear()
        return forgotten

    def rescue(self, *, now: float) -> int:
        """Take back what was left to others if nothing of it arrives any more. How many they are."""
        if now - self._progress < RESCUE:
            return 0
        late = [name for name, waiting in self._left.items() if now - waiting.since >= RESCUE]
        for fingerprint in late:
            self._take(self._left.pop(fingerprint))
        return len(late)

    def _take(self, waiting: Waiting) -> None:
        waiting.left_to = None
        self._mine[waiting.passenger.fingerprint] = waiting

    def _leave(self, waiting: Waiting, to: Turn, now: float) -> None:
        if not self._left:
            self._progress = now
        waiting.left_to = to
        self._left[waiting.passenger.fingerprint] = waiting
