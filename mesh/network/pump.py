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
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Self, TypeVar

import zenoh

from mesh.base.background import call_in_loop
from mesh.base.flood import Drops, forget_oldest
from mesh.base.log_context import log_event
from mesh.errors import ClosedError
from mesh.network import sending

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


class RingLimits(NamedTuple):
    """How a ring tells copies from items that came for the first time."""

    remembered: int = 65_536
    """Items that are remembered, at most; half of them at least."""
    copies: int = 4
    """Copies of an item that are counted: later ones count as the last of these."""
    in_order: int = 2048
    """First copies that wait while the oldest go first: some 140 ms of verifications. When more wait, the newest do."""


RING_LIMITS: Final = RingLimits()


class _SizedQueue(deque[tuple[Any, int]]):
    """Items with their sizes in bytes, and their total `size`. The oldest are trimmed beyond the bounds, but never the
    last one.

    While more than `in_order` wait, the newest go first.
    """

    def __init__(self, capacity: int, capacity_bytes: int, *, in_order: int) -> None:
        super().__init__()
        self._capacity = capacity
        self._capacity_bytes = capacity_bytes
        self._in_order = in_order
        self.size = 0

    def trim(self) -> int:
        """Drop what is beyond the bounds; returns how many."""
        before = len(self)
        while len(self) > self._capacity or (self.size > self._capacity_bytes and len(self) > 1):
            self.size -= self.popleft()[1]
        return before - len(self)

    def take(self, number: int) -> list[Any]:
        """Remove up to `number` items."""
        next_item = self.pop if len(self) > self._in_order else self.popleft
        taken = [next_item() for _ in range(min(number, len(self)))]
        self.size -= sum([size for _, size in taken])
        return [item for item, _ in taken]


class ReceiveRing:
    """Received items that wait for their conversion, the oldest of which are dropped when there are too many.

    With `second_chance`, which needs hashable items, first copies have a queue, second copies another, and so on. Each
    gets the same share of the conversions, and what the others leave. In the queues of copies the newest go first, and
    fewer wait: `capacity` and `capacity_bytes` divided by the number of queues. Among first copies they do while more
    than `RING_LIMITS.in_order` wait, so that what a flood has left behind delays nobody. Honest senders repeat what has
    no effect, so in a flood of new messages their second copy gets through at once, and in a flood of second copies the
    third does.
    """

    def __init__(self, capacity: int, capacity_bytes: int, *, second_chance: bool) -> None:
        self._second_chance = second_chance
        self._queues = [
            _SizedQueue(capacity, capacity_bytes, in_order=RING_LIMITS.in_order if second_chance else capacity)
        ]
        if second_chance:
            queues = RING_LIMITS.copies
            few, few_bytes = capacity // queues, capacity_bytes // queues
            self._queues += [_SizedQueue(few, few_bytes, in_order=0) for _ in range(queues - 1)]
        self._copies: dict[int, int] = {}
        """How often an item came, by its hash with a key that only this process knows."""

    def __len__(self) -> int:
        return sum(map(len, self._queues))

    def extend(self, items: Iterable[Any], sizes: Iterable[int]) -> int:
        """Add items of these sizes in bytes, except None; returns how many were dropped for them."""
        number, copies, queues, second_chance = 0, self._copies, self._queues, self._second_chance
        last = len(queues) - 1
        for item, size in zip(items, sizes, strict=False):  # there are fewer items if the conversion of one failed
            if item is None:
                continue
            if second_chance:
                key = hash(item)
                number = copies.pop(key, 0)
                copies[key] = number + 1 if number < last else number
            queue = queues[number]
            queue.append((item, size))
            queue.size += size
        forget_oldest(copies, RING_LIMITS.remembered)
        return sum([queue.trim() for queue in queues])

    def take(self, number: int) -> list[Any]:
        """Remove up to `number` items."""
        taken: list[Any] = []
        filled = sorted(filter(None, self._queues), key=len)
        for left, queue in zip(range(len(filled), 0, -1), filled, strict=True):
            taken += queue.take(-(-(number - len(taken)) // left))
        return taken


log = logging.getLogger(__name__)

T = TypeVar("T")


class PumpLimits(NamedTuple):
    """What a pump takes, and holds before it drops the oldest."""

    samples: int = 8192
    """Samples that it holds."""
    size: int = 8 << 20
    """Bytes of payloads that it holds."""
    payload: int | None = None
    """Bytes of the largest payload that it takes."""


class PumpPace(NamedTuple):
    """How samples go from Zenoh's threads to the event loop."""

    queue: int = 512
    """Samples in Zenoh's own queue; each may keep 64 KiB alive. While it is full, Zenoh stops reading from the
    router."""
    resent_queue: int = 2048
    """The same for what is sent again; while it is full, Zenoh drops the oldest."""
    together: int = 64
    """Samples that are taken out of Zenoh's queue together; each may keep 64 KiB alive."""
    batch: int = 512
    """Samples converted for one call into the loop, at most."""
    batches: int = 2
    """Batches between the pump's thread and the consumer, at most."""
    wait: float = 0.008
    """Seconds the thread waits for the consumer before it empties Zenoh's queue again."""
    longest_wait: float = 0.064
    """The same while Zenoh's queue stays empty, at most."""


PUMP_LIMITS: Final = PumpLimits()
PUMP_PACE: Final = PumpPace()


class ResentConversion(NamedTuple, Generic[T]):
    """How items are made of messages that their senders repeat, and that are expensive to convert."""

    copy: Callable[[list[zenoh.Sample]], list[Any]]
    """Takes what is needed out of some samples; None to skip one."""
    convert: Callable[[list[Any]], Iterable[list[T]]]
    """Makes items of up to a batch of copies, and yields some of them every few milliseconds, so that the thread can
    empty Zenoh's queue in between."""


class Pump(Generic[T]):
    """An async iterator over the converted samples on `selector`: `async with Pump(session, selector, convert)`.

    `convert` makes an item of a sample at once, or returns None to skip it. If that is expensive, and senders repeat
    what has no effect, pass two functions instead (`ResentConversion`): a flood never stops the session for
    samples on other keys then, as Zenoh's queue drops the oldest, which are not counted. All run on the pump's thread;
    the iterator raises what they raise. Items arrive in order, except copies, and what `ReceiveRing` takes out of order
    in a flood. `drops` counts what is beyond the `limits`. `declare` declares another subscriber than a plain one, of a
    selector and a handler. Leaving `async with` ends the subscription, the thread and the iteration; undelivered
    samples are lost. There is one consumer. Raises `ClosedError` before it is entered.
    """

    def __init__(
        self,
        session: zenoh.Session,
        selector: str,
        convert: Callable[[zenoh.Sample], T | None] | ResentConversion[T],
        *,
        limits: PumpLimits = PUMP_LIMITS,
        drops: Drops | None = None,
        declare: Callable[..., Any] | None = None,
    ) -> None:
        self._session = session
        self._declare = session.declare_subscriber if declare is None else declare
        self.selector: Final = selector
        """The key expression that is subscribed to."""
        self._are_resent = isinstance(convert, ResentConversion)
        if isinstance(convert, ResentConversion):
            self._copy_all, self._convert_all = convert
        else:
            self._copy_all = partial(self._convert_each, convert)
            self._convert_all = lambda copies: (copies,)
        self._limits = limits
        self._drops = Drops() if drops is None else drops
        self._lock = threading.Lock()
        self._ring = ReceiveRing(limits.samples, limits.size, second_chance=self._are_resent)
        self._slots = threading.Semaphore(PUMP_PACE.batches)
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
        channel: Any = zenoh.handlers.FifoChannel(PUMP_PACE.queue)
        if self._are_resent:
            channel = zenoh.handlers.RingChannel(PUMP_PACE.resent_queue)
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
            wait = PUMP_PACE.wait
            while not self._stopping:
                wait = PUMP_PACE.wait if self._take(queue, wait=True) else min(2 * wait, PUMP_PACE.longest_wait)
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
        taken, together = 0, PUMP_PACE.together
        while sample is not None:
            samples = [sample, *islice(iter(queue.try_recv, None), together - 1)]
            if dropped := self._ring.extend(*self._copies(samples)):
                with self._lock:
                    self.dropped += dropped
                self._drops.count("overflow", number=dropped)
            taken += len(samples)
            # a turn is bounded by the same number, however few are kept
            is_more = len(samples) == together and taken < PUMP_LIMITS.samples and self._copy_failure is None
            sample = queue.try_recv() if is_more else None
        if taken:
            sending.received(self._session)
        return taken

    def _copies(self, samples: list[zenoh.Sample]) -> tuple[list[Any], list[int]]:
        """Copies of samples, and their sizes in bytes, without those that are too large; on any thread.

        Each step is taken for all, because its code is in the CPU's caches then.
        """
        received, limit = len(samples), self._limits.payload
        with self._lock:
            self.received += received
        sizes = [len(sample.payload) for sample in samples]
        if limit is not None and max(sizes) > limit:
            samples = [sample for sample, size in zip(samples, sizes, strict=True) if size <= limit]
            sizes = [size for size in sizes if size <= limit]
            self._drops.count("too-large", number=received - len(samples))
        return self._copy_all(samples), sizes

    def _convert_each(self, convert: Callable[[zenoh.Sample], T | None], samples: list[zenoh.Sample]) -> list[T | None]:
        """What `convert` makes of samples. An error is raised once the samples before it are converted."""
        converted: list[T | None] = []
        try:
            converted.extend(map(convert, samples))
        except Exception as error:
            self._copy_failure = error
        return converted

    def _deliver_batch(self, loop: asyncio.AbstractEventLoop, queue: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        """Convert up to a batch of samples, emptying Zenoh's queue in between, and pass them to the loop."""
        batch: list[T] = []
        try:
            for items in self._convert_all(self._ring.take(PUMP_PACE.batch)):
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
