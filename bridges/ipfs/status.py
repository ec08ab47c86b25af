"""How a bridge is, for whoever asks it over Zenoh."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from schemas.status import BridgeStatus
from schemas.status import bridge_status_key as status_key

if TYPE_CHECKING:
    from collections.abc import Callable

WINDOW: Final = 10.0
"""Seconds over which a rate is taken."""


class Rate:
    """How often something happened lately. `clock` gives seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._buckets: deque[tuple[int, int]] = deque()

    def count(self) -> None:
        """It happened."""
        second = int(self._clock())
        if self._buckets and self._buckets[-1][0] == second:
            self._buckets[-1] = (second, self._buckets[-1][1] + 1)
        else:
            self._buckets.append((second, 1))
            self._trim()

    def per_second(self) -> float:
        """The mean of the last `WINDOW` seconds."""
        self._trim()
        return sum(count for _, count in self._buckets) / WINDOW

    def _trim(self) -> None:
        while self._buckets and self._buckets[0][0] <= self._clock() - WINDOW:
            self._buckets.popleft()


__all__ = ["WINDOW", "BridgeStatus", "Rate", "status_key"]
