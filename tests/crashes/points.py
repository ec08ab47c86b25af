"""The points of a job at which processes fail: a method of this project, before or after it runs for the n-th time.

A process that is started with a point (in the variable `CRASH_POINT`) stops there once: it creates the file
`reached` in its control folder and waits for the file `go`. What it contains, if anything, is by how many seconds the
process sets its wall clock.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

REACHED: Final = "reached"
GO: Final = "go"
POLL_SECONDS: Final = 0.005


@dataclass(frozen=True)
class Point:
    """`before` or `after` the `nth` call of a method, as in `before mesh.agent.ledger:Ledger.complete 1`."""

    when: str
    method: str
    nth: int = 1

    def __str__(self) -> str:
        return f"{self.when} {self.method} {self.nth}"

    @classmethod
    def parse(cls, text: str) -> Point:
        when, method, nth = text.split()
        return cls(when, method, int(nth))

    @property
    def name(self) -> str:
        """Short, for the name of a test."""
        return f"{self.when}-{self.method.partition(':')[2]}-{self.nth}"

    def find(self) -> tuple[type, str]:
        """The class and the name of the method. Raises `AttributeError` if there is none."""
        module, _, path = self.method.partition(":")
        owner, _, name = path.rpartition(".")
        found: type = getattr(importlib.import_module(module), owner)
        getattr(found, name)
        return found, name

    def install(self, control: Path) -> None:
        """Make this process wait at the point."""
        owner, name = self.find()
        original: Callable[..., Any] = getattr(owner, name)
        calls = 0

        def pass_by(when: str) -> None:
            nonlocal calls
            calls += when == self.when
            if when == self.when and calls == self.nth:
                wait_at_point(control)

        if inspect.iscoroutinefunction(original):

            @functools.wraps(original)
            async def wrapped(*args: Any, **kwargs: Any) -> Any:
                pass_by("before")
                result = await original(*args, **kwargs)
                pass_by("after")
                return result

            setattr(owner, name, wrapped)
            return

        @functools.wraps(original)
        def wrapped_plain(*args: Any, **kwargs: Any) -> Any:
            pass_by("before")
            result = original(*args, **kwargs)
            pass_by("after")
            return result

        setattr(owner, name, wrapped_plain)


def wait_at_point(control: Path) -> None:
    """Say that the point is reached and wait until the test has done what it wants. Blocks the whole process."""
    (control / REACHED).touch()
    while not (control / GO).exists():
        time.sleep(POLL_SECONDS)
    jump = (control / GO).read_text()
    if jump:
        set_clock(float(jump))


def set_clock(seconds: float) -> None:
    """Set this process's wall clock forward or back. The monotonic clock goes on."""
    real, real_ns = time.time, time.time_ns
    time.time = lambda: real() + seconds
    time.time_ns = lambda: real_ns() + int(seconds * 1e9)
