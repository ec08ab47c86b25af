"""Clocks that tests set."""

from __future__ import annotations

from typing import Final

SECOND: Final = 10**9
HOUR: Final = 3600 * SECOND
NOON: Final = 1_800_000_000 * SECOND
"""A time of day, in nanoseconds."""


class SetClock:
    """A clock that stands, until a test moves it."""

    def __init__(self, unix_ns: int = NOON) -> None:
        self.unix_ns = unix_ns
        self.counted_ns = 5 * SECOND

    def pass_by(self, nanoseconds: int) -> None:
        self.unix_ns += nanoseconds
        self.counted_ns += nanoseconds

    def time(self) -> float:
        return self.unix_ns / SECOND

    def time_ns(self) -> int:
        return self.unix_ns

    def monotonic(self) -> float:
        return self.counted_ns / SECOND

    def monotonic_ns(self) -> int:
        return self.counted_ns
