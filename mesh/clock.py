"""The clocks of a machine. Tests pass others."""

from __future__ import annotations

import time
from typing import Final, Protocol


class Clock(Protocol):
    """The time of day, which can be set, and the monotonic clock, which only moves forward."""

    def time(self) -> float:
        """The time of day: seconds since 1970."""

    def time_ns(self) -> int:
        """The same in nanoseconds."""

    def monotonic(self) -> float:
        """The monotonic clock, in seconds."""

    def monotonic_ns(self) -> int:
        """The same in nanoseconds."""


class _SystemClock:
    def time(self) -> float:
        return time.time()

    def time_ns(self) -> int:
        return time.time_ns()

    def monotonic(self) -> float:
        return time.monotonic()

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()


SYSTEM_CLOCK: Final[Clock] = _SystemClock()
"""The clocks of this machine."""
