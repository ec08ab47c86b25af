"""The clocks of tests: that of a market, in which handlers' timers and the chain's blocks can be brought forward; and
an event loop whose clock advances when nothing else can run: `asyncio.sleep(20)` takes no time there.
"""

from __future__ import annotations

import asyncio
import selectors
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, TypeVar, TypeVarTuple

from mesh.agent.jobs import job_of_handler
from mesh.errors import AiraError, InputError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator
    from concurrent.futures import Executor

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

DAY: Final = 24 * 3600.0
"""The most seconds that pass at once, and in a loop of simulated time."""


class Timer:
    """A timer of a handler, as event loops have them."""

    _source_traceback = None

    def __init__(self, loop: asyncio.AbstractEventLoop, when: float, call: Callable[[], object]) -> None:
        self._call = call
        self._loop = loop
        self._set(when)

    def _set(self, when: float) -> None:
        self._when = when
        self._handle = _call_at(self._loop, when, self._call)

    def when(self) -> float:
        """When it is due, by the loop's clock."""
        return self._when

    def cancel(self) -> None:
        """It is not called."""
        self._handle.cancel()

    def cancelled(self) -> bool:
        """Whether it was cancelled."""
        return self._handle.cancelled()

    @property
    def is_set(self) -> bool:
        """Whether it is still to be called."""
        return not self._handle.cancelled() and self._when > self._loop.time()

    def bring_forward(self, seconds: float) -> None:
        """It is due earlier."""
        self._handle.cancel()
        self._set(self._when - seconds)


def _call_at(loop: asyncio.AbstractEventLoop, when: float, call: Callable[[], object]) -> asyncio.TimerHandle:
    handle: asyncio.TimerHandle = type(loop).call_at(loop, when, call)
    return handle


class MarketClock:
    """The clock of a market: `await market.clock.advance(20)`.

    It moves two things: the timers of handlers of jobs (`asyncio.sleep`, `asyncio.timeout`), and the chain, by a block
    for each second. All else goes by the clock of the machine: connections, messages that are sent again, `time.time`,
    threads, and simulated boards.
    """

    def __init__(self, mine: Callable[[int], Awaitable[None]], busy: Callable[[], set[str]]) -> None:
        self._mine = mine
        self._busy = busy
        self._timers: dict[str, set[Timer]] = {}
        """Those of handlers, by the address of the job."""

    @contextmanager
    def running(self) -> Iterator[None]:
        """Meanwhile it knows the timers that handlers set in this event loop.

        Of several markets in it, the one that was opened last has the timers.
        """
        loop: Any = asyncio.get_running_loop()
        before = loop.call_at

        def call_at(when: float, callback: Any, *arguments: Any, context: Any = None) -> Any:
            if not (job := job_of_handler()):
                return type(loop).call_at(loop, when, callback, *arguments, context=context)
            timers = self._timers.setdefault(job, set())
            timers -= {timer for timer in timers if not timer.is_set}
            timer = Timer(loop, when, lambda: loop.call_soon(callback, *arguments, context=context))
            timers.add(timer)
            return timer

        loop.call_at = call_at
        try:
            yield
        finally:
            loop.call_at = before

    async def advance(self, seconds: float) -> None:
        """Let that many seconds pass at once, for the handlers of jobs that run here, and for the chain.

        A handler that sleeps more than once sleeps on from where it is. Handlers that compute, or wait for something
        else, get a second for it. Raises `InputError` for less than 0 s or more than a day.
        """
        if not 0 <= seconds <= DAY:
            raise InputError(f"{seconds:g} s can't pass at once", hint="name 0 to 86400 s", code="not-a-time")
        left, loop = seconds, asyncio.get_running_loop()
        while True:
            await self._until_asleep()
            timers = [timer for timers in self._timers.values() for timer in timers if timer.is_set]
            first = min((timer.when() for timer in timers), default=None)
            step = left if first is None else min(left, max(first - loop.time(), 0.0))
            for timer in timers:
                timer.bring_forward(step)
            left -= step
            if left <= 0 or first is None:
                break
            await asyncio.sleep(0)
        await self._until_asleep()
        blocks, at_once = round(seconds), 1_000
        while blocks > 0:
            await self._mine(min(blocks, at_once))
            blocks -= at_once

    async def _until_asleep(self) -> None:
        """Return when all handlers of running jobs sleep, after a second at the latest."""
        until = time.monotonic() + 1
        while time.monotonic() < until and any(not self._sleeps(job) for job in self._busy()):  # noqa: ASYNC110
            await asyncio.sleep(0.002)

    def _sleeps(self, job: str) -> bool:
        return any(timer.is_set for timer in self._timers.get(job, ()))


class SimulatedTimeLoop(asyncio.SelectorEventLoop):
    """Its `time` begins at 0, and jumps to the next timer once no callback is ready.

    While something outside may still call, a function in a thread or a socket, time passes as usual. Raises `AiraError`
    (`handler-stuck`) out of its run when everything waits and there is no timer, and after a simulated day: what never
    ends would end no test.
    """

    def __init__(self) -> None:
        self._now = 0.0
        self._outside = 0
        super().__init__(_Selector(self))

    def time(self) -> float:
        """Simulated seconds since it was made."""
        return self._now

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        self._now += seconds
        if self._now > DAY:
            raise stuck(f"have not ended within {DAY / 3600:g} simulated hours")

    @property
    def waits_outside(self) -> bool:
        """Whether a thread is at work."""
        return self._outside > 0

    @contextmanager
    def outside(self) -> Iterator[None]:
        """Meanwhile time passes as usual, because a thread is at work."""
        self._outside += 1
        try:
            yield
        finally:
            self._outside -= 1

    def run_in_executor(self, executor: Executor | None, func: Callable[[*Ts], T], *args: *Ts) -> asyncio.Future[T]:
        """As in other loops; time passes as usual until it has ended."""
        future = super().run_in_executor(executor, func, *args)
        self._outside += 1
        future.add_done_callback(self._ended)
        return future

    async def shutdown_default_executor(self, *timeout: float | None) -> None:
        """As in other loops, whose threads end in real time. Python 3.11 knows no `timeout`."""
        with self.outside():
            await super().shutdown_default_executor(*timeout)

    def _ended(self, future: asyncio.Future[Any]) -> None:
        self._outside -= 1


class _Selector(selectors.DefaultSelector):
    """Waits for the loop: with the clock of the machine only if something outside of it may happen."""

    def __init__(self, loop: SimulatedTimeLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        # Asked first: a thread that ends in between has already made the loop's own socket readable.
        is_outside = self._loop.waits_outside or len(self.get_map()) > 1
        events = super().select(0)
        if events or (timeout is not None and timeout <= 0):
            return events
        if is_outside:
            began = time.monotonic()
            longest = 0.01  # then it looks again at the threads
            events = super().select(longest if timeout is None else min(timeout, longest))
            self._loop.advance(time.monotonic() - began)
        elif timeout is None:
            raise stuck("wait for what nothing in the test does")
        else:
            self._loop.advance(timeout)
        return events


def stuck(what: str) -> AiraError:
    """The error of handlers that do not end."""
    hint = "a handler that waits for a device, or for another agent, needs a Market"
    return AiraError(f"the handlers of the job {what}", hint=hint, code="handler-stuck")
