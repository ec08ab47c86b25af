"""An event loop whose clock advances when nothing else can run: `asyncio.sleep(20)` takes no time."""

from __future__ import annotations

import asyncio
import selectors
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, TypeVar, TypeVarTuple

from mesh.errors import AiraError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from concurrent.futures import Executor

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

LONGEST: Final = 24 * 3600.0
"""Simulated seconds after which a loop gives up: what never ends would end no test."""
SLICE: Final = 0.01
"""Seconds for which it waits for a thread before it looks again."""


class SimulatedTimeLoop(asyncio.SelectorEventLoop):
    """Its `time` begins at 0, and jumps to the next timer once no callback is ready.

    While something outside may still call, a function in a thread or a socket, time passes as usual. Raises `AiraError`
    (`handler-stuck`) out of its run when everything waits and there is no timer, and after `LONGEST`.
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
        if self._now > LONGEST:
            raise stuck(f"have not ended within {LONGEST / 3600:g} simulated hours")

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
            events = super().select(SLICE if timeout is None else min(timeout, SLICE))
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
