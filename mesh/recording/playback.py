"""When each message of a recording is due. Pure: the clock is given, and no file is read here.

Due times count from the start of playing, so that a pause of the process delays messages but never shifts those that
come after: what is late goes out at once, in order.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol, TypeAlias

from msgspec import Struct

from mesh.recording.objective import Played

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterable, Iterable, Iterator

_SECOND: Final = 10**9
_EARLY_NS: Final = 200_000
"""An event loop counts in whole milliseconds and wakes up to one too late; what is left after waking earlier than that
is yielded away, which costs two hundredths of a core at 1 kHz and takes as much off how late messages are."""
_UNPAUSED: Final = 32
"""Late messages after which the event loop gets its turn."""


@dataclass(frozen=True)
class RecordedTimes:
    """Messages as far apart as their log times say, divided by `speed`. Raises `ValueError` unless that is above 0."""

    speed: float = 1.0

    def __post_init__(self) -> None:
        if not self.speed > 0:
            raise ValueError(f"a speed of {self.speed} does not play anything")

    def due_ns(self, position: int, elapsed_ns: int) -> int:
        """When the message at `position` is due, recorded `elapsed_ns` after the first; from the start, nanoseconds."""
        return elapsed_ns if self.speed == 1 else int(elapsed_ns / self.speed)


@dataclass(frozen=True)
class AtOnce:
    """Every message as soon as the one before is out."""

    def due_ns(self, position: int, elapsed_ns: int) -> int:
        """Always now."""
        return 0


@dataclass(frozen=True)
class FixedRate:
    """`hz` messages a second, whatever their times. Raises `ValueError` unless that is above 0."""

    hz: float

    def __post_init__(self) -> None:
        if not self.hz > 0:
            raise ValueError(f"a rate of {self.hz} does not play anything")

    def due_ns(self, position: int, elapsed_ns: int) -> int:
        """When the message at `position` is due, from the start, nanoseconds."""
        return int(position * _SECOND / self.hz)


Pace: TypeAlias = RecordedTimes | AtOnce | FixedRate


class Step(Struct, frozen=True):
    """A message to be played `due_ns` nanoseconds after the start; `index` is its place in the whole recording."""

    index: int
    due_ns: int
    message: Played


class Clock(Protocol):
    """A time that only goes forward, in nanoseconds from anywhere."""

    def now_ns(self) -> int:
        """The time now."""

    async def sleep_until(self, when_ns: int) -> None:
        """Return at `when_ns`, or after a turn of the event loop if that is past."""


class MonotonicClock:
    """The clock of this machine."""

    def now_ns(self) -> int:
        """The time now."""
        return time.monotonic_ns()

    async def sleep_until(self, when_ns: int) -> None:
        """Return at `when_ns`, late by about a millisecond at most if the loop is not busy."""
        await asyncio.sleep(max(0, when_ns - _EARLY_NS - time.monotonic_ns()) / _SECOND)
        while time.monotonic_ns() < when_ns:  # noqa: ASYNC110 - nothing else tells the time as exactly
            await asyncio.sleep(0)


def timeline(messages: Iterable[Played], pace: Pace, *, first_index: int = 0, start_ns: int = 0) -> Iterator[Step]:
    """When each message, in the order given, is due.

    The first is due at once; `first_index` is its place in the recording. With `start_ns`, messages recorded less
    than that after the first are left out, and the others are due as if the recording began there.
    """
    schedule = _Schedule(pace, first_index=first_index, start_ns=start_ns)
    for message in messages:
        step = schedule.step(message)
        if step is not None:
            yield step


async def paced(
    messages: AsyncIterable[Played], pace: Pace, clock: Clock, *, first_index: int = 0, start_ns: int = 0
) -> AsyncGenerator[Step, None]:
    """Each step of the `timeline` of `messages` when it is due by `clock`, never before.

    Time starts when the first message is there. Cancelling is safe between two steps.
    """
    schedule = _Schedule(pace, first_index=first_index, start_ns=start_ns)
    begin, unpaused = None, 0
    async for message in messages:
        step = schedule.step(message)
        if step is None:
            continue
        begin = clock.now_ns() if begin is None else begin
        unpaused += 1
        if begin + step.due_ns > clock.now_ns() or unpaused >= _UNPAUSED:
            unpaused = 0
            await clock.sleep_until(begin + step.due_ns)
        yield step


class _Schedule:
    """Gives every message that comes its place and its time."""

    def __init__(self, pace: Pace, *, first_index: int, start_ns: int) -> None:
        self._pace = pace
        self._index = first_index - 1
        self._position = -1
        self._start_ns = start_ns
        self._origin: int | None = None

    def step(self, message: Played) -> Step | None:
        """The step of the next message; None if it lies before the start."""
        self._index += 1
        if self._origin is None:
            self._origin = message.log_time_ns
        elapsed = message.log_time_ns - self._origin - self._start_ns
        if elapsed < 0:
            return None
        self._position += 1
        return Step(self._index, self._pace.due_ns(self._position, elapsed), message)
