"""From a Zenoh subscriber's thread into asyncio, fast, and bounded everywhere.

Zenoh's callback only puts the sample into a ring. One thread takes what is there (up to a batch), turns each sample
into what the consumer wants (decoding and checking signatures happen here, off the event loop) and hands the batch to
the loop in one call. At most two batches are on their way to the consumer; while it is busy the ring fills and the
*oldest* samples fall out of it, counted. A consumer that stands still thus costs old messages, never memory, and
never stalls the session.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final, Generic, Self, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    import zenoh

log = logging.getLogger(__name__)

T = TypeVar("T")

CAPACITY: Final = 8192
"""Samples that the ring holds before the oldest falls out."""
BATCH: Final = 256
"""Samples handed to the loop in one call at most."""
IN_FLIGHT: Final = 2
"""Batches between the pump's thread and the consumer at most."""


class Pump(Generic[T]):
    """An async iterator of what `convert` makes of each sample on `selector`: `async with Pump(...) as pump`.

    `convert` runs on the pump's own thread and returns None for a sample that is not to be handed on; it must not
    raise for bad input. Samples arrive in order. Leaving `async with` undeclares the subscriber and ends the thread;
    samples not yet handed over are lost. One consumer.
    """

    def __init__(
        self,
        session: zenoh.Session,
        selector: str,
        convert: Callable[[zenoh.Sample], T | None],
        *,
        capacity: int = CAPACITY,
    ) -> None:
        self._session = session
        self._selector = selector
        self._convert = convert
        self._capacity = capacity
        self._ring: deque[zenoh.Sample] = deque(maxlen=capacity)
        self._arrived = threading.Event()
        self._slots = threading.Semaphore(IN_FLIGHT)
        self._stopping = False
        self._batches: deque[list[T]] = deque()
        self._current: deque[T] = deque()
        self._ready = asyncio.Event()
        self._failure: BaseException | None = None
        self.received = 0
        """Samples that Zenoh delivered."""
        self.dropped = 0
        """Samples that fell out of the ring because the consumer was too slow."""

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self._thread = threading.Thread(target=self._run, name=f"pump {self._selector}", daemon=True)
        self._thread.start()
        self._subscriber: Any = self._session.declare_subscriber(self._selector, self._arrive)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopping = True
        self._arrived.set()
        self._slots.release()
        await asyncio.to_thread(self._end)

    def _end(self) -> None:
        if not self._session.is_closed():
            self._subscriber.undeclare()
        self._thread.join()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> T:
        while not self._current:
            if not self._batches:
                if self._failure is not None:
                    raise self._failure
                self._ready.clear()
                await self._ready.wait()
                continue
            self._current = deque(self._batches.popleft())
            self._slots.release()
        return self._current.popleft()

    def feed(self, sample: zenoh.Sample) -> None:
        """Put a sample from elsewhere (a query's answer) into the ring; waits for room. On a thread of the caller's."""
        while len(self._ring) >= self._capacity // 2 and not self._stopping:
            time.sleep(0.001)
        self._arrive(sample)

    def _arrive(self, sample: zenoh.Sample) -> None:
        """Zenoh's callback: nothing here may block, or the whole session stands still."""
        self.received += 1
        if len(self._ring) == self._capacity:
            self.dropped += 1
        self._ring.append(sample)
        if not self._arrived.is_set():
            self._arrived.set()

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._slots.acquire()
                batch = self._next_batch()
                if batch:
                    self._hand_over(batch)
        except Exception as error:
            log.exception("the pump of %s failed", self._selector)
            self._failure = error
            self._hand_over([])

    def _next_batch(self) -> list[T]:
        """Wait until samples are there and convert them; empty only when the pump stops."""
        batch: list[T] = []
        while not self._stopping and not batch:
            self._arrived.wait()
            self._arrived.clear()
            while self._ring and len(batch) < BATCH:
                item = self._convert(self._ring.popleft())
                if item is not None:
                    batch.append(item)
            if self._ring:
                self._arrived.set()
        return batch

    def _hand_over(self, batch: list[T]) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._receive, batch)

    def _receive(self, batch: list[T]) -> None:
        if batch:
            self._batches.append(batch)
        self._ready.set()
