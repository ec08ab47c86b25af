"""From a Zenoh subscriber into asyncio, fast, and bounded everywhere.

One thread takes samples out of Zenoh's queue into a ring, turns them into what the consumer wants (decoding and
checking signatures happen here, off the event loop) and hands them to the loop in batches. At most two batches are on
their way to the consumer; while it is busy the ring fills and the *oldest* samples fall out of it, counted. A consumer
that stands still thus costs old messages, never memory, and never stalls the session: the thread goes on to empty
Zenoh's queue whatever the consumer does.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, Generic, Self, TypeVar

import zenoh

from mesh.errors import ClosedError
from mesh.network.crossing import call_in_loop

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

log = logging.getLogger(__name__)

T = TypeVar("T")

CAPACITY: Final = 8192
"""Samples that the ring holds before the oldest falls out."""
FED_CAPACITY: Final = 65_536
"""Samples from elsewhere that wait beside the ring; more are dropped."""
BATCH: Final = 256
"""Samples converted for one call of the loop at most."""
IN_FLIGHT: Final = 2
"""Batches between the pump's thread and the consumer at most."""
QUEUE: Final = 8192
"""Samples in Zenoh's own queue; the pump's thread empties it many times faster than they come."""
BUSY: Final = 0.002
"""Seconds for which the thread waits for the consumer before it looks after Zenoh's queue again."""


class Pump(Generic[T]):
    """An async iterator of what `convert` makes of each sample on `selector`: `async with Pump(...) as pump`.

    `convert` runs on the pump's own thread and returns None for a sample that is not to be handed on; what it raises
    comes out of the iterator. Samples arrive in order. Leaving `async with` undeclares the subscriber and ends thread
    and iteration; samples not yet handed over are lost. One consumer. Raises `ClosedError` before it is entered.
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
        self._lock = threading.Lock()
        self._ring: deque[zenoh.Sample] = deque(maxlen=capacity)
        self._fed = 0
        self._slots = threading.Semaphore(IN_FLIGHT)
        self._stopping = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._batches: deque[tuple[list[T], Callable[[], None]]] = deque()
        self._current: deque[T] = deque()
        self._ready = asyncio.Event()
        self._failure: Exception | None = None
        self.received = 0
        """Samples that Zenoh delivered, and those that were fed."""
        self.dropped = 0
        """Samples that fell out of the ring because the consumer was too slow."""

    async def __aenter__(self) -> Self:
        if self._loop is not None:
            raise ClosedError("a subscription is used once", hint="subscribe again")
        self._subscriber: Any = self._session.declare_subscriber(self._selector, zenoh.handlers.FifoChannel(QUEUE))
        self._loop = asyncio.get_running_loop()
        self._thread = threading.Thread(
            target=self._run, args=(self._loop, self._subscriber.handler), name=f"pump {self._selector}", daemon=True
        )
        self._thread.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopping = True
        self._ready.set()
        await asyncio.to_thread(self._end)

    def _end(self) -> None:
        """Undeclaring closes Zenoh's queue, which ends the thread."""
        if not self._session.is_closed():
            self._subscriber.undeclare()
        self._thread.join()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> T:
        self.check_entered()
        while not self._stopping:
            if self._current:
                return self._current.popleft()
            if self._batches:
                batch, taken = self._batches.popleft()
                self._current.extend(batch)
                taken()
            elif self._failure is not None:
                raise self._failure
            else:
                self._ready.clear()
                await self._ready.wait()
        raise StopAsyncIteration

    def check_entered(self) -> asyncio.AbstractEventLoop:
        """The loop of the consumer. Raises `ClosedError` before `async with`."""
        if self._loop is None:
            raise ClosedError("the subscription is not open", hint="use it inside `async with`")
        return self._loop

    def feed(self, sample: zenoh.Sample) -> None:
        """Take a sample from elsewhere (a query's answer), and convert it, on any thread, without waiting.

        It stands beside the ring, so that the live ones do not push it out; one that finds no room is dropped.
        """
        loop = self.check_entered()
        with self._lock:
            self.received += 1
            if self._fed >= FED_CAPACITY:
                self.dropped += 1
                return
            self._fed += 1
        item = self._convert(sample)
        call_in_loop(loop, self._receive, [] if item is None else [item], self._fed_taken)

    def _fed_taken(self) -> None:
        with self._lock:
            self._fed -= 1

    def insert(self, item: T) -> None:
        """Hand the consumer something that came another way. On the loop's thread."""
        self._current.append(item)
        self._ready.set()

    def fail(self, error: Exception) -> None:
        """Let the consumer have this error when all that has arrived is consumed. On the loop's thread."""
        self._failure = error
        self._ready.set()

    def _run(self, loop: asyncio.AbstractEventLoop, queue: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        try:
            while not self._stopping:
                self._take(queue)
                if self._ring and self._slots.acquire(timeout=BUSY):
                    batch = [self._ring.popleft() for _ in range(min(BATCH, len(self._ring)))]
                    items = [item for sample in batch if (item := self._convert(sample)) is not None]
                    call_in_loop(loop, self._receive, items, self._slots.release)
        except zenoh.ZError:  # the closed queue is how the thread is told to end
            if not self._stopping:
                call_in_loop(loop, self.fail, ClosedError("the network session of a subscription was closed"))
        except Exception as error:
            log.exception("the pump of %s failed", self._selector)
            call_in_loop(loop, self.fail, error)
            with suppress(zenoh.ZError):  # a full queue would stall the session
                while True:
                    queue.recv()

    def _take(self, queue: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        """Move what is in Zenoh's queue into the ring; wait for something to come when both are empty."""
        sample = queue.try_recv() if self._ring else queue.recv()
        dropped = received = 0
        while sample is not None:
            received += 1
            dropped += len(self._ring) == self._ring.maxlen
            self._ring.append(sample)
            sample = queue.try_recv() if received < QUEUE else None
        with self._lock:
            self.received += received
            self.dropped += dropped

    def _receive(self, batch: list[T], taken: Callable[[], None]) -> None:
        if batch:
            self._batches.append((batch, taken))
            self._ready.set()
        else:
            taken()
