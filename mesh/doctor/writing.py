"""Two sessions of one identity: what the one writes, and whether the other hears it."""

from __future__ import annotations

import asyncio
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from mesh.errors import RemoteError
from mesh.network import call_in_loop

if TYPE_CHECKING:
    from collections.abc import Callable

SECONDS: Final = 2.0
"""In which the router would have passed on what it heeds."""
AGAIN: Final = 0.05
"""Seconds between two puts, or two looks."""
MEASURED: Final = b"now"
"""What is written to be timed: what was written before may come late."""
GRACE: Final = 0.2
"""Seconds in which what was written before something that was heard must have come, too."""


class Heard(NamedTuple):
    """What came, and when: by the clock that only goes forward, and by the one of the day (seconds since 1970)."""

    sample: zenoh.Sample
    at: float
    now: float


class Pair:
    """A session that writes and one that hears, both open. `stamped` is the time that the router has put on something
    and that of this machine when it was heard (seconds since 1970), once something was."""

    def __init__(self, writer: zenoh.Session, reader: zenoh.Session) -> None:
        self._writer = writer
        self._reader = reader
        self.stamped: tuple[float, float] | None = None

    async def round_trip(self, key: str) -> float | None:
        """Seconds until the reader hears what is written at `key`; None if it never does."""
        heard: asyncio.Queue[Heard] = asyncio.Queue()
        with ExitStack() as declared:
            self._hear(declared, key, heard.put_nowait)
            if not await self._comes_through(key, heard):
                return None
            began = time.monotonic()
            self._put(key, MEASURED)
            try:
                async with asyncio.timeout(SECONDS):
                    sample, at, now = await heard.get()
                    while sample.payload.to_bytes() != MEASURED:
                        sample, at, now = await heard.get()
            except TimeoutError:
                return None
            if sample.timestamp is not None:
                self.stamped = sample.timestamp.get_time().timestamp(), now
            return at - began

    async def is_heeded(self, *keys: str) -> bool:
        """Whether the router tells the writer that the reader listens at one of these keys."""
        with ExitStack() as declared:
            publishers = [self._watched(declared, key) for key in keys]
            return await _within(SECONDS, lambda: any(map(_is_matching, publishers)))

    async def passing(
        self, foreign: tuple[str, ...], *, own: str, barrier: str | None
    ) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Those of the `foreign` keys at which the reader may hear, and those of them at which it does hear the writer.

        `own` is a key that the reader surely may hear, `barrier` one that the writer surely may write: when that was
        heard, all that was written before has been heard, or never will be. Raises `RemoteError` if it is not heard.
        """
        heard: set[str] = set()
        with ExitStack() as declared:
            publishers = {key: self._watched(declared, key, heard) for key in foreign}
            last = self._watched(declared, own, heard)
            await _within(SECONDS, lambda: _is_matching(last))
            await asyncio.sleep(GRACE)
            tried = tuple(key for key, publisher in publishers.items() if _is_matching(publisher))
            for key in tried:
                self._put(key)
            if barrier is not None:
                self._put(barrier)
                if not await _within(SECONDS, lambda: barrier in heard):
                    raise RemoteError(
                        f"what may be written did not come back within {SECONDS:g} s, so what may not tells nothing",
                        hint="is the router overloaded, or the network? try again",
                    )
                await asyncio.sleep(GRACE)
            else:
                await asyncio.sleep(SECONDS)
        return tried, tuple(key for key in tried if key in heard)

    async def _comes_through(self, key: str, heard: asyncio.Queue[Heard]) -> bool:
        """Write again and again until it is heard: the router learns of a subscriber in its own time."""
        ends = time.monotonic() + SECONDS
        while time.monotonic() < ends:
            self._put(key)
            try:
                async with asyncio.timeout(AGAIN):
                    await heard.get()
                    return True
            except TimeoutError:
                continue
        return False

    def _watched(self, declared: ExitStack, key: str, heard: set[str] | None = None) -> Any:
        """A publisher of the writer at `key`, where the reader listens."""
        keys = set() if heard is None else heard
        self._hear(declared, key, lambda heard: keys.add(str(heard.sample.key_expr)))
        return declared.enter_context(self._writer.declare_publisher(key))

    def _hear(self, declared: ExitStack, key: str, take: Callable[[Heard], object]) -> None:
        loop = asyncio.get_running_loop()

        def heard(sample: zenoh.Sample) -> None:
            call_in_loop(loop, take, Heard(sample, time.monotonic(), time.time()))

        declared.enter_context(self._reader.declare_subscriber(key, heard))

    def _put(self, key: str, payload: bytes = b"") -> None:
        self._writer.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)


def _is_matching(publisher: Any) -> bool:
    return bool(publisher.matching_status.matching)


async def _within(seconds: float, condition: Callable[[], bool]) -> bool:
    """Whether it comes true within so many seconds."""
    ends = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > ends:
            return False
        await asyncio.sleep(AGAIN / 5)
    return True
