"""The pump: samples from a Zenoh subscriber into asyncio, fast, with bounded memory.

One thread moves samples from Zenoh's queue into a ring, converts them (decoding and signature checks run here, off the
event loop) and passes them to the loop in batches. At most two batches are in flight; while the consumer is busy, the
ring fills up and drops the *oldest* samples, which are counted. A slow consumer therefore loses old messages, but costs
no memory and never stalls the session, because the thread keeps emptying Zenoh's queue.
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
from mesh.log_context import log_event
from mesh.network import sending

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextvars import Context

log = logging.getLogger(__name__)

T = TypeVar("T")

RING_CAPACITY: Final = 8192
"""Samples that the ring holds before it drops the oldest."""
FED_CAPACITY: Final = 65_536
"""Fed samples that may wait beside the ring; more are dropped."""
BATCH: Final = 256
"""Samples converted for one call into the loop, at most."""
BATCHES_IN_FLIGHT: Final = 2
"""Batches between the pump's thread and the consumer, at most."""
ZENOH_QUEUE: Final = 8192
"""Capacity of Zenoh's own queue; the pump's thread empties it many times faster than samples arrive."""
SLOT_WAIT: Final = 0.002
"""Seconds the thread waits for the consumer before it empties Zenoh's queue again."""


def call_in_loop(
    loop: asyncio.AbstractEventLoop, function: Callable[..., object], *arguments: Any, context: Context | None = None
) -> None:
    """Schedule `function` on the event loop from any thread; does nothing if the loop has been closed.

    It runs in `context`, so that log events carry their source; Zenoh's threads have no context of their own.
    """
    try:
        loop.call_soon_threadsafe(function, *arguments, context=context)
    except RuntimeError:
        if not loop.is_closed():
            raise


class Pump(Generic[T]):
    """An async iterator over the converted samples on `selector`: `async with Pump(...) as pump`.

    `convert` runs on the pump's own thread and returns None for a sample to skip; the iterator raises what `convert`
    raises. Samples arrive in order. `capacity` bounds the ring, `fed_capacity` the samples given to `feed`. Leaving
    `async with` undeclares the subscriber and ends the thread and the iteration; undelivered samples are lost.
    Supports one consumer. Raises `ClosedError` before it is entered.
    """

    def __init__(
        self,
        session: zenoh.Session,
        selector: str,
        convert: Callable[[zenoh.Sample], T | None],
        *,
        capacity: int = RING_CAPACITY,
        fed_capacity: int = FED_CAPACITY,
    ) -> None:
        self._session = session
        self._selector = selector
        self._convert = convert
        self._lock = threading.Lock()
        self._ring: deque[zenoh.Sample] = deque(maxlen=capacity)
        self._fed = 0
        self._fed_capacity = fed_capacity
        self._slots = threading.Semaphore(BATCHES_IN_FLIGHT)
        self._stopping = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._batches: deque[tuple[list[T], Callable[[], None]]] = deque()
        self._current: deque[T] = deque()
        self._ready = asyncio.Event()
        self._failure: Exception | None = None
        self.received = 0
        """Samples that Zenoh delivered or that were fed."""
        self.dropped = 0
        """Samples that were dropped because the consumer was too slow."""

    async def __aenter__(self) -> Self:
        if self._loop is not None:
            raise ClosedError("a subscription can be entered only once", hint="subscribe again")
        self._subscriber: Any = self._session.declare_subscriber(
            self._selector, zenoh.handlers.FifoChannel(ZENOH_QUEUE)
        )
        self._loop = asyncio.get_running_loop()
        self._thread = threading.Thread(
            target=self._run, args=(self._loop, self._subscriber.handler), name=f"pump {self._selector}", daemon=True
        )
        self._thread.start()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._stopping = True
        self._ready.set()
        await asyncio.to_thread(self._end)

    def _end(self) -> None:
        """Undeclaring the subscriber closes Zenoh's queue, which ends the thread."""
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
        """The consumer's event loop. Raises `ClosedError` before `async with`."""
        if self._loop is None:
            raise ClosedError("the subscription is not open", hint="use it inside `async with`")
        return self._loop

    def feed(self, sample: zenoh.Sample) -> None:
        """Convert and deliver a sample from elsewhere (a query's reply), on any thread, without waiting.

        Fed samples bypass the ring, so that live ones do not displace them; beyond `fed_capacity` they are dropped.
        """
        loop = self.check_entered()
        with self._lock:
            self.received += 1
            if self._fed >= self._fed_capacity:
                self.dropped += 1
                return
            self._fed += 1
        item = self._convert(sample)
        call_in_loop(loop, self._receive, [] if item is None else [item], self._fed_taken)

    def _fed_taken(self) -> None:
        with self._lock:
            self._fed -= 1

    def insert(self, item: T) -> None:
        """Deliver an item that was converted elsewhere. Call it on the loop's thread."""
        self._current.append(item)
        self._ready.set()

    def fail(self, error: Exception) -> None:
        """Raise `error` from the iterator once the items before it are consumed. Call it on the loop's thread."""
        self._failure = error
        self._ready.set()

    def _run(self, loop: asyncio.AbstractEventLoop, queue: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        try:
            while not self._stopping:
                self._take(queue)
                if self._ring and self._slots.acquire(timeout=SLOT_WAIT):
                    batch = [self._ring.popleft() for _ in range(min(BATCH, len(self._ring)))]
                    items = [item for sample in batch if (item := self._convert(sample)) is not None]
                    call_in_loop(loop, self._receive, items, self._slots.release)
        except zenoh.ZError:  # the queue was closed, which ends the thread
            if not self._stopping:
                call_in_loop(loop, self.fail, ClosedError("the network session of a subscription was closed"))
        except Exception as error:
            failed = log_event("subscription-failed", selector=self._selector)
            log.exception("the subscription to %s failed", self._selector, extra=failed)
            call_in_loop(loop, self.fail, error)
            with suppress(zenoh.ZError):  # a full queue would stall the session
                while True:
                    queue.recv()

    def _take(self, queue: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        """Move samples from Zenoh's queue into the ring; wait for one when both are empty."""
        sample = queue.try_recv() if self._ring else queue.recv()
        dropped = received = 0
        while sample is not None:
            received += 1
            dropped += len(self._ring) == self._ring.maxlen
            self._ring.append(sample)
            sample = queue.try_recv() if received < ZENOH_QUEUE else None
        sending.received(self._session)
        with self._lock:
            self.received += received
            self.dropped += dropped

    def _receive(self, batch: list[T], taken: Callable[[], None]) -> None:
        if batch:
            self._batches.append((batch, taken))
            self._ready.set()
        else:
            taken()
