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


SYSTEM_CLOCK: Final[Clock] = time
"""The clocks of this machine."""
