"""Simulated time and threads: greenlets that run one at a time, in an order that the seed decides.

Only the scheduler decides which thread runs next, and time passes only when none can run (and a little with each
step). So a history depends on nothing but its seed.
"""

from __future__ import annotations

import asyncio
import heapq
import random
import sys
import time
from asyncio import events
from typing import TYPE_CHECKING, Any, Final

import greenlet  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SECOND: Final = 1_000_000_000
REAL_TIME: Final = time.perf_counter
"""The real clock."""
STEP_NS: Final = 20_000
"""What one callback of an event loop costs. Code that polls a clock would never end if it cost nothing."""
BUSY_STEPS: Final = 20_000
"""Steps of a process in a second that mean that it is busy with nothing. Honest work takes up to 5,200; 50,000 fit."""
START_WALL_NS: Final = 1_800_000_000 * SECOND
KEEPS_TASK: Final = sys.version_info >= (3, 14)


class HistoryFailed(Exception):
    """The history can't go on: the simulator itself met something that it does not expect."""


class Fiber:
    """A simulated thread: a greenlet, and what belongs to a thread in CPython."""

    def __init__(
        self, number: int, process: Process | None, name: str, run: Callable[[], None], hub: greenlet.greenlet
    ) -> None:
        self.number = number
        self.process = process
        self.name = name
        self.greenlet = greenlet.greenlet(run, parent=hub)
        self.wakeups = 0
        """Counts the waits of this fiber: a timer of an earlier wait has no effect."""
        self.is_waiting = False
        self.timed_out = False
        self.loop: asyncio.AbstractEventLoop | None = None
        self.hooks: Any = None
        self.task: Any = None
        """With the running event loop, what CPython keeps for each thread; the task since Python 3.14."""


class Process:
    """A process of the market, from its start to its end or crash. Everything that it starts belongs to it."""

    def __init__(self, scheduler: Scheduler, name: str) -> None:
        self.scheduler = scheduler
        self.name = name
        self.is_dead = False
        self.steps = 0
        self.commits = 0
        self.crash_at_step: int | None = None
        self.crash_at_commit: int | None = None
        self.wall_offset_ns = 0
        self.on_crash: Callable[[], None] = lambda: None
        self.on_busy: Callable[[], None] = lambda: None
        self._second = 0
        self._busy_at = 0
        self.kept: list[object] = []
        """What must not be collected after a crash, which would run its cleanup."""

    def step(self) -> None:
        """Count a step of this process. It may be its last."""
        self.steps += 1
        self.scheduler.now_ns += STEP_NS
        second = self.scheduler.now_ns // SECOND
        if second != self._second:
            self._second, self._busy_at = second, self.steps + BUSY_STEPS
        if self.steps == self._busy_at:
            self.on_busy()
        if self.steps == self.crash_at_step:
            self.scheduler.crash(self)

    def commit(self) -> None:
        """Count something that is durable from now on. It may be the last thing that the process did."""
        self.commits += 1
        if self.commits == self.crash_at_commit:
            self.scheduler.crash(self)


class Scheduler:
    """Runs fibers, and the calls that are due at a time. `random` is the only source of chance in a history."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.now_ns = 1_000 * SECOND
        self.current: Fiber | None = None
        self.switches = 0
        self.preempt = 0.0
        """How probable it is that a thread is interrupted where it takes a free lock."""
        self._watch: Callable[[Fiber], object] | None = None
        self._hub = greenlet.getcurrent()
        self._runnable: list[Fiber] = []
        self._timers: list[tuple[int, int, Callable[..., None], tuple[Any, ...]]] = []
        self._count = 0
        self._fibers: set[Fiber] = set()
        """All that have not ended. Those of dead processes stay here, since collecting one would run its cleanup."""
        self.failures: list[tuple[str, BaseException]] = []

    @property
    def process(self) -> Process | None:
        """The process whose code is running."""
        return None if self.current is None else self.current.process

    def count(self) -> int:
        """A new number, in the order of the history."""
        self._count += 1
        return self._count

    def watch_switches(self, path: Path) -> None:
        """Write each switch to a file, to find out why two runs of a seed differ."""
        file = path.open("w", buffering=1)
        self._watch = lambda fiber: file.write(f"{self.now_ns} {fiber.number} {fiber.name} {self._count}\n")

    # What fibers call.

    def spawn(self, run: Callable[[], None], name: str, process: Process | None = None) -> Fiber:
        """Start a thread of the process that is running now, or of the one given."""

        def guarded() -> None:
            try:
                run()
            except greenlet.GreenletExit:
                raise
            except BaseException as error:
                self.failures.append((name, error))

        fiber = Fiber(self.count(), process or self.process, name, guarded, self._hub)
        self._fibers.add(fiber)
        self._runnable.append(fiber)
        return fiber

    def wait(self, timeout_ns: int | None = None) -> bool:
        """Stop the current fiber until `wake`; False if the timeout passed first."""
        fiber = self.current
        if fiber is None:
            raise HistoryFailed("the scheduler itself can't wait")
        fiber.is_waiting, fiber.timed_out = True, False
        fiber.wakeups += 1
        if timeout_ns is not None:
            self.call_at(self.now_ns + max(0, timeout_ns), self._time_out, fiber, fiber.wakeups)
        self._switch_out(fiber)
        return not fiber.timed_out

    def wake(self, fiber: Fiber) -> None:
        """Let a waiting fiber go on."""
        if fiber.is_waiting:
            fiber.is_waiting = False
            self._runnable.append(fiber)

    def pause(self) -> None:
        """Let others run, if any can."""
        if self._runnable and self.current is not None:
            self._runnable.append(self.current)
            self._switch_out(self.current)

    def maybe_pause(self) -> None:
        """Let others run sometimes: where real threads may be interrupted."""
        if self.preempt and self.current is not None and self.random.random() < self.preempt:
            self.pause()

    def crash(self, process: Process) -> None:
        """End a process now, as `kill -9` does. Does not return in a fiber of that process."""
        if process.is_dead:
            return
        process.is_dead = True
        process.on_crash()
        fiber = self.current
        if fiber is not None and fiber.process is process:
            self._switch_out(fiber)

    # What the simulation around them calls.

    def call_at(self, when_ns: int, function: Callable[..., None], *arguments: Any) -> None:
        """Call a function at a time, outside of any process. It must not block."""
        heapq.heappush(self._timers, (when_ns, self.count(), function, arguments))

    def call_later(self, seconds: float, function: Callable[..., None], *arguments: Any) -> None:
        """The same, so many seconds from now."""
        self.call_at(self.now_ns + round(seconds * SECOND), function, *arguments)

    def run(self, is_done: Callable[[], bool], *, until_ns: int) -> bool:
        """Run until `is_done`, which is asked each second and at the end; False if that time comes first."""
        asked = -1
        while True:
            while self._runnable:
                # `randrange` takes longer than the switch itself.
                self._switch_in(self._runnable.pop(int(self.random.random() * len(self._runnable))))
                if self._timers and self._timers[0][0] <= self.now_ns:
                    self._fire()
            following = self._timers[0][0] if self._timers else None
            if self.now_ns // SECOND != asked or following is None or following > until_ns:
                asked = self.now_ns // SECOND
                if is_done():
                    return True
            if following is None:
                raise HistoryFailed("nothing can ever happen again")
            if following > until_ns:
                return False
            self.now_ns = max(self.now_ns, self._timers[0][0])
            self._fire()

    def _fire(self) -> None:
        while self._timers and self._timers[0][0] <= self.now_ns:
            _, _, function, arguments = heapq.heappop(self._timers)
            function(*arguments)

    def _time_out(self, fiber: Fiber, wakeups: int) -> None:
        if fiber.is_waiting and fiber.wakeups == wakeups:
            fiber.is_waiting, fiber.timed_out = False, True
            self._runnable.append(fiber)

    def _switch_in(self, fiber: Fiber) -> None:
        if fiber.process is not None and fiber.process.is_dead:
            return
        self.switches += 1
        if self._watch is not None:
            self._watch(fiber)
        self.current = fiber
        if fiber.loop is not None:
            events._set_running_loop(fiber.loop)
            sys.set_asyncgen_hooks(*fiber.hooks)
            if KEEPS_TASK:
                asyncio.tasks._swap_current_task(fiber.loop, fiber.task)  # type: ignore[attr-defined]
        fiber.greenlet.switch()
        if fiber.greenlet.dead:
            self._fibers.discard(fiber)
            events._set_running_loop(None)
        self.current = None

    def _switch_out(self, fiber: Fiber) -> None:
        loop = events._get_running_loop()
        if loop is not None and loop is not fiber.loop:
            fiber.hooks = sys.get_asyncgen_hooks()
        fiber.loop = loop
        if loop is not None:
            if KEEPS_TASK:
                fiber.task = asyncio.tasks._swap_current_task(loop, None)  # type: ignore[attr-defined]
            events._set_running_loop(None)
        self._hub.switch()
