"""The pump: samples from a Zenoh subscriber into asyncio, fast, with bounded memory.

One thread copies samples from Zenoh's queue into a ring (a sample keeps its receive buffer alive), converts them
(signature checks run here, off the event loop) and passes them to the loop in batches, at most two at a time. When more
arrives than is converted or consumed, the ring drops the *oldest* samples and counts them. The thread keeps emptying
Zenoh's queue, so the session does not stall.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import deque
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, Generic, Self, TypeVar

import zenoh

from mesh.background import call_in_loop
from mesh.errors import ClosedError
from mesh.flood import Drops
from mesh.log_context import log_event
from mesh.network import sending
from mesh.network.ring import ReceiveRing

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

log = logging.getLogger(__name__)

T = TypeVar("T")

RING_CAPACITY: Final = 8192
"""Samples that the ring holds before it drops the oldest."""
RING_BYTES: Final = 8 * 1024 * 1024
"""Bytes of payloads that the ring holds before it drops the oldest."""
TOGETHER: Final = 64
"""Samples that are taken out of Zenoh's queue together; each may keep 64 KiB alive."""
BATCH: Final = 512
"""Samples converted for one call into the loop, at most."""
BATCHES_IN_FLIGHT: Final = 2
"""Batches between the pump's thread and the consumer, at most."""
ZENOH_QUEUE: Final = 512
"""Samples in Zenoh's own queue; each may keep 64 KiB alive. While it is full, Zenoh stops reading from the router."""
RESENT_QUEUE: Final = 2048
"""The same for what is sent again; while it is full, Zenoh drops the oldest."""
SLOT_WAIT: Final = 0.008
"""Seconds the thread waits for the consumer before it empties Zenoh's queue again."""
LONGEST_SLOT_WAIT: Final = 0.064
"""The same while Zenoh's queue stays empty, at most."""


class Pump(Generic[T]):
    """An async iterator over the converted samples on `selector`: `async with Pump(session, selector, convert)`.

    `convert` makes an item of a sample at once, or returns None to skip it. If that is expensive, pass two functions
    instead: `copy_all` takes what is needed out of some samples (None to skip one), and `convert_all` makes items of up
    to `BATCH` copies and yields some of them every few milliseconds, so that the thread can empty Zenoh's queue in
    between. They run on the pump's thread; the iterator raises what they raise. Items arrive in order, except copies,
    and what `ReceiveRing` takes out of order in a flood. `capacity` and `capacity_bytes` bound the ring. Samples of
    more than `payload_limit` bytes are refused. `drops` counts what is dropped or refused. `declare` declares another
    subscriber than a plain one, of a selector and a handler. With `resent` (senders repeat what has no effect) a flood
    never stops the session for samples on other keys: Zenoh's queue drops the oldest instead, which are not counted.
    Leaving `async with` ends the subscription, the thread and the iteration; undelivered samples are lost. There is
    one consumer. Raises `ClosedError` before it is entered.
    """

    def __init__(
        self,
        session: zenoh.Session,
        selector: str,
        convert: Callable[[zenoh.Sample], T | None] | None = None,
        *,
        copy_all: Callable[[list[zenoh.Sample]], list[Any]] | None = None,
        convert_all: Callable[[list[Any]], Iterable[list[T]]] | None = None,
        capacity: int = RING_CAPACITY,
        capacity_bytes: int = RING_BYTES,
        payload_limit: int | None = None,
        drops: Drops | None = None,
        declare: Callable[..., Any] | None = None,
        resent: bool = False,
    ) -> None:
        self._session = session
        self._resent = resent
        self._declare = session.declare_subscriber if declare is None else declare
        self.selector: Final = selector
        """The key expression that is subscribed to."""
        self._convert = convert
        self._copy_all = copy_all or self._convert_each
        self._convert_all: Callable[[list[Any]], Iterable[list[T]]] = convert_all or (lambda copies: (copies,))
        self._payload_limit = payload_limit
        self._drops = Drops() if drops is None else drops
        self._lock = threading.Lock()
        self._ring = ReceiveRing(capacity, capacity_bytes, second_chance=convert_all is not None)
        self._slots = threading.Semaphore(BATCHES_IN_FLIGHT)
        self._stopping = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._batches: deque[tuple[list[T], Callable[[], None]]] = deque()
        self._current: deque[T] = deque()
        self._ready = asyncio.Event()
        self._copy_failure: Exception | None = None
        self._failure: Exception | None = None
        self.received = 0
        """Samples that Zenoh delivered or that were copied."""
        self.dropped = 0
        """Samples that were dropped because more arrived than could be converted or consumed."""

    async def __aenter__(self) -> Self:
        if self._loop is not None:
            raise ClosedError("a subscription can be entered only once", hint="subscribe again")
        channel: Any = zenoh.handlers.FifoChannel(ZENOH_QUEUE)
        if self._resent:
            channel = zenoh.handlers.RingChannel(RESENT_QUEUE)
        self._subscriber: Any = self._declare(self.selector, channel)
        self._loop = asyncio.get_running_loop()
        self._thread = threading.Thread(
            target=self._run, args=(self._loop, self._subscriber.handler), name=f"pump {self.selector}", daemon=True
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

    def take_ready(self) -> T | None:
        """The next item if it has arrived already: what `anext` returns then, at a fraction of its cost."""
        return self._current.popleft() if self._current and not self._stopping else None

    def copy(self, sample: zenoh.Sample) -> Any | None:
        """What `feed` takes of a sample from elsewhere (a query's reply), on any thread; None if it is refused."""
        copies, _ = self._copies([sample])
        return next(iter(copies), None)

    def feed(self, copies: list[Any]) -> None:
        """Convert and deliver what `copy` returned, beside the ring, on any thread, without waiting."""
        for items in self._convert_all(copies):
            call_in_loop(self.check_entered(), self._receive, items, lambda: None)

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
            wait = SLOT_WAIT
            while not self._stopping:
                wait = SLOT_WAIT if self._take(queue, wait=True) else min(2 * wait, LONGEST_SLOT_WAIT)
                if self._ring and self._slots.acquire(timeout=wait):
                    self._deliver_batch(loop, queue)
        except zenoh.ZError:  # the queue was closed, which ends the thread
            if not self._stopping:
                call_in_loop(loop, self.fail, ClosedError("the network session of a subscription was closed"))
        except Exception as error:
            facts = log_event("subscription-failed", selector=self.selector)
            log.exception("the subscription to %s failed", self.selector, extra=facts)
            call_in_loop(loop, self.fail, error)
            with suppress(zenoh.ZError):  # a full queue would stall the session
                while True:
                    queue.recv()

    def _take(self, queue: zenoh.handlers.Handler[zenoh.Sample], *, wait: bool) -> int:
        """Move samples from Zenoh's queue into the ring; `wait` for one when both are empty. Returns how many came."""
        if self._copy_failure is not None:
            if wait and not self._ring:
                raise self._copy_failure
            return 0
        sample = queue.recv() if wait and not self._ring else queue.try_recv()
        taken = 0
        while sample is not None:
            samples = [sample, *islice(iter(queue.try_recv, None), TOGETHER - 1)]
            if dropped := self._ring.extend(*self._copies(samples)):
                with self._lock:
                    self.dropped += dropped
                self._drops.count("overflow", number=dropped)
            taken += len(samples)
            is_more = len(samples) == TOGETHER and taken < RING_CAPACITY and self._copy_failure is None
            sample = queue.try_recv() if is_more else None
        if taken:
            sending.received(self._session)
        return taken

    def _copies(self, samples: list[zenoh.Sample]) -> tuple[list[Any], list[int]]:
        """Copies of samples, and their sizes in bytes, without those that are too large; on any thread.

        Each step is taken for all, because its code is in the CPU's caches then.
        """
        received, limit = len(samples), self._payload_limit
        with self._lock:
            self.received += received
        sizes = [len(sample.payload) for sample in samples]
        if limit is not None and max(sizes) > limit:
            samples = [sample for sample, size in zip(samples, sizes, strict=True) if size <= limit]
            sizes = [size for size in sizes if size <= limit]
            self._drops.count("too-large", number=received - len(samples))
        return self._copy_all(samples), sizes

    def _convert_each(self, samples: list[zenoh.Sample]) -> list[T | None]:
        """What `convert` makes of samples. An error is raised once the samples before it are converted."""
        assert self._convert is not None, "a pump needs `convert` or `copy_all`"
        converted: list[T | None] = []
        try:
            converted.extend(map(self._convert, samples))
        except Exception as error:
            self._copy_failure = error
        return converted

    def _deliver_batch(self, loop: asyncio.AbstractEventLoop, queue: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        """Convert up to a batch of samples, emptying Zenoh's queue in between, and pass them to the loop."""
        batch: list[T] = []
        try:
            for items in self._convert_all(self._ring.take(BATCH)):
                batch += items
                self._take(queue, wait=False)
        finally:
            call_in_loop(loop, self._receive, batch, self._slots.release)

    def _receive(self, batch: list[T], taken: Callable[[], None]) -> None:
        if batch:
            self._batches.append((batch, taken))
            self._ready.set()
        else:
            taken()
