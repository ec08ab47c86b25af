"""Waiting for a condition: it is checked repeatedly, and the test fails at the deadline."""

from __future__ import annotations

import asyncio
import os
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    import zenoh

T = TypeVar("T")

SECONDS = 60.0
PAUSE = 0.005
STALL = 5.0
"""Seconds for which a busy machine may do nothing for a test."""


async def until(
    condition: Callable[[], object], *, what: str = "", seconds: float = SECONDS, pause: float = PAUSE
) -> None:
    """Return when `condition()` is true; fail the test after `seconds`. It is checked after each `pause`."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"{what or 'the condition'} did not come about within {seconds:g} s"
        await asyncio.sleep(pause)


def wait_until(condition: Callable[[], object], *, what: str = "", seconds: float = SECONDS) -> None:
    """As `until`, where there is no event loop."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"{what or 'the condition'} did not come about within {seconds:g} s"
        time.sleep(PAUSE)


async def until_found(search: Callable[[], Awaitable[T]], *, what: str = "", seconds: float = SECONDS) -> T:
    """As `until`, for a question that is itself waited for; returns its answer."""
    deadline = time.monotonic() + seconds
    while not (found := await search()):
        assert time.monotonic() < deadline, f"{what or 'the condition'} did not come about within {seconds:g} s"
        await asyncio.sleep(PAUSE)
    return found


async def until_heard(session: zenoh.Session, key: str) -> None:
    """Return when a put of `session` on `key` finds a subscriber: declarations take their time to get around."""
    with session.declare_publisher(key) as publisher:
        await until(lambda: publisher.matching_status.matching, what=f"a subscriber of {key}")  # type: ignore[attr-defined]


async def until_answered(session: zenoh.Session, selector: str) -> None:
    """Return when a query of `session` on `selector` finds a queryable."""
    with session.declare_querier(selector) as querier:
        await until(lambda: querier.matching_status.matching, what=f"a queryable on {selector}")  # type: ignore[attr-defined]


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Fail if the body takes longer, and longer than the machine may stall.

    A machine with more to run than processors gets that many times as long.
    """
    started = time.monotonic()
    yield
    took = time.monotonic() - started
    allowed = STALL + seconds * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
    assert took < allowed, f"took {took:.2f} s, and {allowed:g} s are allowed"
