"""An asyncio event loop in simulated time: asyncio's own, but for waiting."""

from __future__ import annotations

import asyncio
import heapq
from typing import TYPE_CHECKING, Any, Final

from tests.simulation.scheduler import SECOND, Fiber, Process, Scheduler
from tests.simulation.threads import SimpleQueue

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine


MOST_WORKERS: Final = 6
"""Threads for blocking functions, as asyncio has on two cores."""


class Future(asyncio.Future[Any]):
    """A future whose place in a set depends on the history, not on its address in memory."""

    def __hash__(self) -> int:
        return self.number

    number = 0


class Task(asyncio.Task[Any]):
    """The same for tasks. A task has its number before asyncio puts it into its set of all tasks."""

    def __init__(self, coro: Any, *, loop: Any, number: int, **options: Any) -> None:
        self.number = number
        super().__init__(coro, loop=loop, **options)

    def __hash__(self) -> int:
        return self.number


class SimulatedLoop(asyncio.BaseEventLoop):
    """The event loop of one simulated process."""

    def __init__(self, scheduler: Scheduler, process: Process) -> None:
        super().__init__()
        self._scheduler = scheduler
        self._process = process
        self._fiber: Fiber | None = None
        self._sleeping = False
        self._tasks: list[Task] = []
        self._prune_at = 100
        self._work = SimpleQueue()
        self._workers = self._idle = 0
        self.set_task_factory(self._make_task)

    def time(self) -> float:
        """Simulated seconds."""
        return self._scheduler.now_ns / SECOND

    def create_future(self) -> asyncio.Future[Any]:
        """A future of this loop."""
        future = Future(loop=self)
        future.number = self._scheduler.count()
        return future

    def _make_task(self, loop: Any, coro: Any, **options: Any) -> Task:
        task = Task(coro, loop=loop, number=self._scheduler.count(), **options)
        self._tasks.append(task)
        if len(self._tasks) > self._prune_at:
            self._tasks = [one for one in self._tasks if not one.done()]
            self._prune_at = 2 * len(self._tasks) + 100
        return task

    def run_in_executor(self, executor: Any, func: Any, *args: Any) -> asyncio.Future[Any]:  # type: ignore[override]
        """Run a function in a thread of this process: one that is idle, or a new one while there are few."""
        if executor is not None:
            return super().run_in_executor(executor, func, *args)
        future = self.create_future()
        self._work.put((future, func, args))
        if self._idle < self._work.qsize() and self._workers < MOST_WORKERS:
            self._workers += 1
            self._scheduler.spawn(self._do_work, f"worker {self._workers}", self._process)
        return future

    def _do_work(self) -> None:
        while True:
            self._idle += 1
            future, function, arguments = self._work.get()
            self._idle -= 1
            if not future.cancelled():
                try:
                    found, error = function(*arguments), None
                except BaseException as failure:
                    found, error = None, failure
                self.call_soon_threadsafe(_settle, future, found, error)

    def _run_once(self) -> None:
        scheduler, ready, scheduled = self._scheduler, self._ready, self._scheduled  # type: ignore[attr-defined]
        while scheduled and scheduled[0]._cancelled:
            heapq.heappop(scheduled)._scheduled = False
        if ready:
            scheduler.pause()
        elif not self._stopping:  # type: ignore[attr-defined]
            self._sleeping = True
            self._fiber = scheduler.current
            timeout = None if not scheduled else max(0, round((scheduled[0]._when - self.time()) * SECOND))
            scheduler.wait(timeout)
            self._sleeping = False
        ends = self.time() + 1e-9
        while scheduled and scheduled[0]._when < ends:
            handle = heapq.heappop(scheduled)
            handle._scheduled = False
            ready.append(handle)
        for _ in range(len(ready)):
            handle = ready.popleft()
            if not handle._cancelled:
                self._process.step()
                handle._run()

    def _write_to_self(self) -> None:
        if self._sleeping and self._fiber is not None:
            self._sleeping = False
            self._scheduler.wake(self._fiber)

    def _process_events(self, event_list: object) -> None:
        """There are no sockets."""


def _settle(future: asyncio.Future[Any], found: Any, error: BaseException | None) -> None:
    if future.cancelled():
        return
    if error is None:
        future.set_result(found)
    else:
        future.set_exception(error)


def start(
    scheduler: Scheduler,
    process: Process,
    main: Callable[[], Coroutine[Any, Any, None]],
    ended: Callable[[BaseException | None], None],
) -> None:
    """Run `main` in an event loop of its own, in a thread of the process; `ended` is called with its error."""

    def run() -> None:
        loop = SimulatedLoop(scheduler, process)
        process.kept.append(loop)
        error: BaseException | None = None
        try:
            asyncio.set_event_loop(None)
            loop.run_until_complete(main())
        except BaseException as failure:
            error = failure
        process.is_dead = True
        ended(error)

    scheduler.spawn(run, f"main {process.name}", process)
