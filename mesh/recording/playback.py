"""Playback: when each message of a recording is due, and giving it then.

Due times count from the start of the playback, so that a pause of the process delays messages but does not shift later
ones: late messages go out at once, in order.
"""

from __future__ import annotations

import asyncio
import math
import time
from contextlib import aclosing
from itertools import islice
from typing import TYPE_CHECKING, Final, Protocol

from msgspec import Struct

from mesh.recording.objective import Objective, Played

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterable, Iterator

AT_ONCE: Final = math.inf
"""The speed at which every message follows the one before immediately."""


class Step(Struct, frozen=True):
    """A message to play `due_ns` nanoseconds after the start; `index` is its number in the whole recording."""

    index: int
    due_ns: int
    message: Played


class PlaybackClock(Protocol):
    """A monotonic clock, in nanoseconds."""

    def now_ns(self) -> int:
        """The time now."""

    async def sleep_until(self, when_ns: int) -> None:
        """Return at `when_ns`; if that is past, after one turn of the event loop."""


class MonotonicClock:
    def now_ns(self) -> int:
        """The time now."""
        return time.monotonic_ns()

    async def sleep_until(self, when_ns: int) -> None:
        """Return at `when_ns`, at most about a millisecond late if the loop is not busy."""
        # An event loop counts in whole milliseconds and wakes up to one too late. So this sleeps until 0.2 ms before
        # the time and yields to the loop for the rest, which costs 2 % of a core at 1 kHz.
        await asyncio.sleep(max(0, when_ns - 200_000 - time.monotonic_ns()) / 1_000_000_000)
        while time.monotonic_ns() < when_ns:  # noqa: ASYNC110 - no other wait is as precise
            await asyncio.sleep(0)


async def paced(
    messages: AsyncIterable[Played], speed: float, clock: PlaybackClock, *, first_index: int = 0, start_ns: int = 0
) -> AsyncGenerator[Step, None]:
    """Each message as a step when it is due by `clock`, never earlier: recorded times count `speed` times faster.

    The first is due at once, and time starts with it; `first_index` is its number in the recording. With `start_ns`,
    messages recorded less than that after the first are skipped, and the others are due as if the recording began
    there. Cancelling is safe between two steps.
    """
    index, unpaused = first_index - 1, 0
    origin, begin = 0, None
    async for message in messages:
        index += 1
        if index == first_index:
            origin = message.log_time_ns
        elapsed = message.log_time_ns - origin - start_ns
        if elapsed < 0:
            continue
        due = elapsed if speed == 1 else int(elapsed / speed)  # a float does not hold all nanoseconds
        if begin is None:
            begin = clock.now_ns()
        unpaused += 1
        if begin + due > clock.now_ns() or unpaused >= 32:  # if all are late, the event loop gets its turn as well
            unpaused = 0
            await clock.sleep_until(begin + due)
        yield Step(index, due, message)


_CLOCK: Final = MonotonicClock()


async def play(
    objective: Objective, *, speed: float = 1.0, start_index: int = 0, start_ns: int = 0, clock: PlaybackClock = _CLOCK
) -> AsyncGenerator[Step, None]:
    """Play an objective: each of its messages when it is due, at `speed` times the recorded pace.

    `start_index` skips that many messages, and the next is due at once: to continue after an interruption. `start_ns`
    starts that long after the first message (after the one at `start_index`). Cancelling, or leaving the loop, stops
    reading. Raises `CorruptRecording` if the file has changed since it was opened.
    """
    messages = read_ahead(objective.messages(from_index=start_index))
    async with aclosing(messages):
        async for step in paced(messages, speed, clock, first_index=start_index, start_ns=start_ns):
            yield step


async def read_ahead(messages: Iterator[Played]) -> AsyncGenerator[Played, None]:
    """The same messages, read in a thread batch by batch: one batch is read while the one before is played."""
    reading = asyncio.ensure_future(asyncio.to_thread(_batch, messages))
    try:
        while batch := await asyncio.shield(reading):
            reading = asyncio.ensure_future(asyncio.to_thread(_batch, messages))
            for message in batch:
                yield message
    finally:
        # A generator can't be closed while a thread runs it.
        await asyncio.wait([reading])
        if not reading.cancelled():
            reading.exception()
        close = getattr(messages, "close", None)
        if close is not None:
            close()


def _batch(messages: Iterator[Played]) -> list[Played]:
    """At most 64 messages or about 4 MiB: reading more could delay a message that is due."""
    batch: list[Played] = []
    size = 0
    for message in islice(messages, 64):
        batch.append(message)
        size += len(message.payload)
        if size >= 4 << 20:
            break
    return batch
