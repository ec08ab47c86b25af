"""How services and calls end: closing while requests are in progress, closed sessions, cancelled calls."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, cast

import pytest

from mesh.errors import ClosedError
from mesh.network import ServiceFailed, Services, call
from tests.support.network.services import ADDRESS, REQUEST, done, offering
from tests.support.waiting import at_most, until, until_answered

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh

    from schemas.rpc import Done, LiabilityRequest


async def test_closing_cancels_requests_in_progress(here: zenoh.Session, there: zenoh.Session) -> None:
    begun = asyncio.Event()
    ended: list[str] = []

    async def start(request: LiabilityRequest) -> Done:
        begun.set()
        try:
            await asyncio.Event().wait()
        finally:
            ended.append("handler")
        raise AssertionError

    async with offering(there, here, start=start):
        asking = asyncio.create_task(call(here, ADDRESS, "start", REQUEST))
        await begun.wait()

    assert ended == ["handler"]
    with at_most(2), pytest.raises(ServiceFailed) as error:
        await asking
    assert error.value.reason == "no-agent"
    with at_most(2), pytest.raises(ServiceFailed) as error:
        await call(here, ADDRESS, "start", REQUEST)
    assert error.value.reason == "no-agent"


class CapturingSession:
    """A session that keeps the callback of a queryable, to deliver a query after the queryable was withdrawn."""

    deliver: Callable[[zenoh.Query], None]

    def declare_queryable(self, key: str, callback: Callable[[zenoh.Query], None]) -> None:
        self.deliver = callback

    def is_closed(self) -> bool:
        return True


async def test_a_query_that_arrives_while_closing_is_dropped(here: zenoh.Session, there: zenoh.Session) -> None:
    asked: list[zenoh.Query] = []
    session = CapturingSession()
    async with Services(cast("zenoh.Session", session), ADDRESS) as services:
        services.offer("start", done)
    with there.declare_queryable("test", asked.append):
        await until_answered(here, "test")
        asking = asyncio.create_task(asyncio.to_thread(lambda: list(here.get("test"))))
        await until(lambda: asked)

        session.deliver(asked.pop())

        with at_most(2):
            assert await asking == []


async def test_closing_after_the_session_was_closed_does_not_hang(there: zenoh.Session, here: zenoh.Session) -> None:
    begun = asyncio.Event()

    async def start(request: LiabilityRequest) -> Done:
        begun.set()
        await asyncio.Event().wait()
        raise AssertionError

    with at_most(3):
        async with offering(there, here, start=start):
            asking = asyncio.create_task(call(here, ADDRESS, "start", REQUEST, timeout=60))
            await begun.wait()
            there.close()  # type: ignore[no-untyped-call]

        with pytest.raises(ServiceFailed):
            await asking


async def test_cancelling_a_call_takes_effect_at_once(here: zenoh.Session, there: zenoh.Session) -> None:
    begun = threading.Event()

    async def start(request: LiabilityRequest) -> Done:
        begun.set()
        await asyncio.Event().wait()
        raise AssertionError

    def ask_in_a_loop_of_its_own() -> None:
        async def ask() -> None:
            asking = asyncio.create_task(call(here, ADDRESS, "start", REQUEST, timeout=60))
            await until(begun.is_set, what="the request")
            asking.cancel()
            await asking

        with pytest.raises(asyncio.CancelledError):
            asyncio.run(ask())

    async with offering(there, here, start=start):
        with at_most(3):  # the loop ends when its threads have ended
            await asyncio.to_thread(ask_in_a_loop_of_its_own)


async def test_services_are_offered_only_inside_async_with(here: zenoh.Session) -> None:
    services = Services(here, ADDRESS)
    for _ in range(2):
        with pytest.raises(ClosedError):
            services.offer("start", done)
        async with services:
            pass
