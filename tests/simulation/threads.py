"""Simulated threads, locks, queues and clocks in the place of Python's: `install` once, before anything else is loaded.

What is above them in the standard library (events, semaphores, executors) is Python's own.
"""

from __future__ import annotations

import importlib
import math
import os
import queue
import random
import secrets
import sys
import threading
import time
from collections import deque
from contextlib import nullcontext
from types import GenericAlias
from typing import TYPE_CHECKING, Any, Final

from tests.simulation.scheduler import SECOND, START_WALL_NS, Fiber, Scheduler

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

TOO_EARLY: Final = ("concurrent.futures.thread", "mesh.network", "mesh.agent", "web3", "zenoh")


class World:
    """What is simulated now. There is one scheduler at a time, as there is one `time` and one `threading`."""

    scheduler: Scheduler


def scheduler() -> Scheduler:
    """The scheduler of the history that runs."""
    return World.scheduler


class Lock:
    """`threading.Lock`."""

    def __init__(self) -> None:
        self._locked = False
        self._waiting: deque[Fiber] = deque()

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        """Take the lock; see `threading.Lock.acquire`."""
        current = World.scheduler
        if blocking:
            current.maybe_pause()
        if not self._locked:
            self._locked = True
            return True
        if not blocking:
            return False
        # At least a nanosecond: who waits in a loop until a time has come must get there.
        ends = None if timeout < 0 else current.now_ns + max(1, math.ceil(timeout * SECOND))
        fiber = current.current
        assert fiber is not None, "a lock is taken outside of any thread"
        while self.locked():
            self._waiting.append(fiber)
            woken = current.wait(None if ends is None else ends - current.now_ns)
            if not woken:
                if fiber in self._waiting:
                    self._waiting.remove(fiber)
                return self.acquire(blocking=False)
        self._locked = True
        return True

    def release(self) -> None:
        """Release the lock."""
        if not self._locked:
            raise RuntimeError("release unlocked lock")
        self._locked = False
        if self._waiting:
            World.scheduler.wake(self._waiting.popleft())

    def locked(self) -> bool:
        """Whether it is taken."""
        return self._locked

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *exc_info: object) -> None:
        self.release()

    def _at_fork_reinit(self) -> None:
        self._locked = False


class SimpleQueue:
    """`queue.SimpleQueue`, as far as it is used."""

    __class_getitem__: Any = classmethod(GenericAlias)

    def __init__(self) -> None:
        self._items: deque[Any] = deque()
        self._waiting: deque[Fiber] = deque()

    def qsize(self) -> int:
        """How many items wait."""
        return len(self._items)

    def put(self, item: Any) -> None:
        """Add an item."""
        World.scheduler.maybe_pause()
        self._items.append(item)
        if self._waiting:
            World.scheduler.wake(self._waiting.popleft())

    put_nowait = put

    def get(self, block: bool = True) -> Any:
        """Remove the oldest item; `block` waits for one, else `queue.Empty` is raised."""
        current = World.scheduler
        current.maybe_pause()
        while not self._items:
            if not block:
                raise queue.Empty
            assert current.current is not None, "a queue is waited for outside of any thread"
            self._waiting.append(current.current)
            current.wait()
        return self._items.popleft()

    def get_nowait(self) -> Any:
        """The oldest item; raises `queue.Empty` if there is none."""
        return self.get(block=False)


class Thread:
    """`threading.Thread`, as far as it is used."""

    def __init__(
        self,
        group: None = None,
        target: Callable[..., object] | None = None,
        name: str | None = None,
        args: Iterable[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
        *,
        daemon: bool | None = None,
    ) -> None:
        self.name = name or "thread"
        self.daemon = bool(daemon)
        self._target, self._args, self._kwargs = target, tuple(args), dict(kwargs or {})
        self._fiber: Fiber | None = None
        self._done = threading.Event()

    def start(self) -> None:
        """Start it."""
        self._fiber = World.scheduler.spawn(self._bootstrap, self.name)

    def run(self) -> None:
        """What it does."""
        if self._target is not None:
            self._target(*self._args, **self._kwargs)

    def join(self, timeout: float | None = None) -> None:
        """Wait for its end."""
        self._done.wait(timeout)

    def is_alive(self) -> bool:
        """Whether it runs."""
        return self._fiber is not None and not self._done.is_set()

    @property
    def ident(self) -> int | None:
        """Its number."""
        return None if self._fiber is None else self._fiber.number

    def _bootstrap(self) -> None:
        try:
            self.run()
        finally:
            self._done.set()


class CurrentThread:
    """What `threading.current_thread` returns; only logging and `fork` ask."""

    name = "simulated"
    ident = 0
    daemon = True

    def _reset_internal_locks(self, is_alive: bool) -> None:
        """Called after a fork, by Python 3.11 and 3.12."""

    def _after_fork(self, new_ident: int | None = None) -> None:
        """Called after a fork, from Python 3.13 on."""


_CURRENT: Any = CurrentThread()


def _ident() -> int:
    current = World.scheduler.current
    return 0 if current is None else current.number


def _monotonic_ns() -> int:
    return World.scheduler.now_ns


def _wall_ns() -> int:
    process = World.scheduler.process
    return World.scheduler.now_ns + START_WALL_NS + (0 if process is None else process.wall_offset_ns)


def _sleep(seconds: float) -> None:
    World.scheduler.wait(round(seconds * SECOND))


def _number(self: Any) -> int:
    """A hash that does not depend on an address in memory: the order of a set would."""
    number: int = self.__dict__.setdefault("_simulated_number", 0) or World.scheduler.count()
    self.__dict__["_simulated_number"] = number
    return number


def number_in_sets(*kinds: type) -> None:
    """Give the instances of these classes hashes by the order in which they are first put into a set."""
    for kind in kinds:
        kind.__hash__ = _number  # type: ignore[assignment,method-assign]


def install() -> None:
    """Replace threads, locks, clocks and randomness for the rest of this process."""
    early = [name for name in TOO_EARLY if name in sys.modules]
    if early:
        raise RuntimeError(f"loaded before the simulation: {', '.join(early)}")
    World.scheduler = Scheduler(0)
    for name, function in (("_ns", _monotonic_ns), ("", lambda: _monotonic_ns() / SECOND)):
        setattr(time, f"monotonic{name}", function)
        setattr(time, f"perf_counter{name}", function)
    time.time_ns, time.time, time.sleep = _wall_ns, lambda: _wall_ns() / SECOND, _sleep  # type: ignore[assignment]
    module: Any = threading
    module._time = time.monotonic
    module.get_ident = _ident
    module.current_thread = lambda: _CURRENT
    module._active = {0: _CURRENT}
    module.Lock = module._allocate_lock = module.allocate_lock = Lock
    module.RLock = module._PyRLock
    module.Thread = Thread
    queues: Any = queue
    queues.time = time.monotonic
    queues.SimpleQueue = SimpleQueue
    number_in_sets(Thread, threading.Event, queue.Queue)
    stopping: Any = importlib.import_module("mesh.role.local_stop")
    stopping.listening = lambda *_: nullcontext()  # it waits for a real socket, on which nobody calls here
    os.urandom = lambda size: World.scheduler.random.randbytes(size)
    secrets.token_bytes = lambda size=None: World.scheduler.random.randbytes(32 if size is None else size)  # type: ignore[assignment]


def begin(seed: int) -> Scheduler:
    """A new history."""
    World.scheduler = Scheduler(seed)
    random.seed(seed)
    return World.scheduler
