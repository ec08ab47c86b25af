"""Playing a recording from its file: read ahead in a thread, given when due."""

from __future__ import annotations

import asyncio
from contextlib import aclosing
from itertools import islice
from typing import TYPE_CHECKING, Final

from mesh.recording.playback import Clock, MonotonicClock, Pace, RecordedTimes, Step, paced

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Iterator

    from mesh.recording.objective import Objective, Played

_AHEAD: Final = 64
"""Messages read at once, while as many before them are played; reading more would hold up one that is due."""
_AHEAD_BYTES: Final = 4 << 20
_AS_RECORDED: Final = RecordedTimes()
_CLOCK: Final = MonotonicClock()


async def play(
    objective: Objective,
    *,
    pace: Pace = _AS_RECORDED,
    start_index: int = 0,
    start_ns: int = 0,
    clock: Clock = _CLOCK,
) -> AsyncGenerator[Step, None]:
    """The messages of an objective, each when it is due.

    `start_index` leaves out that many messages, and the next is due at once: to go on after an interruption.
    `start_ns` starts that long after the first message (after the one at `start_index`). Cancelling, or leaving the
    loop, ends the reading. Raises `CorruptRecording` if the file changed since it was opened.
    """
    messages = _read_ahead(objective.messages(from_index=start_index))
    async with aclosing(messages):
        async for step in paced(messages, pace, clock, first_index=start_index, start_ns=start_ns):
            yield step


async def _read_ahead(messages: Iterator[Played]) -> AsyncGenerator[Played, None]:
    """The same messages, taken from a thread a batch at a time; one batch is read while the one before is used."""
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
    batch: list[Played] = []
    size = 0
    for message in islice(messages, _AHEAD):
        batch.append(message)
        size += len(message.payload)
        if size >= _AHEAD_BYTES:
            break
    return batch
