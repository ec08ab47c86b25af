"""Services that end: with what is under way, and with a session that was closed."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from mesh.errors import ClosedError
from mesh.network import ServiceFailed, Services, call
from schemas.rpc import Done, StartLiability
from tests.mesh.network.offers import ADDRESS, REQUEST, done, offering
from tests.support.waiting import at_most, until, until_answered

if TYPE_CHECKING:
    import zenoh


async def test_leaving_breaks_off_what_is_not_answered(here: zenoh.Session, there: zenoh.Session) -> None:
    begun = asyncio.Event()
    ended: list[str] = []

    async def start(request: StartLiability) -> Done:
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
    with at_most(2), pytest.raises(ServiceFailed, match="nobody answers"):
        await asking
    with at_most(2), pytest.raises(ServiceFailed, match="nobody answers"):
        await call(here, ADDRESS, "start", REQUEST)


async def test_a_question_that_comes_while_leaving_is_turned_down(here: zenoh.Session, there: zenoh.Session) -> None:
    asked: list[zenoh.Query] = []
    services = await Services(there, ADDRESS).__aenter__()
    await services.__aexit__(None, None, None)
    with there.declare_queryable("test", asked.append):
        await until_answered(here, "test")
        asking = asyncio.create_task(asyncio.to_thread(lambda: list(here.get("test"))))
        await until(lambda: asked)

        services._answer_soon(asked.pop(), "test", StartLiability, done)

        with at_most(2):
            assert await asking == []


async def test_leaving_after_the_session_was_closed_does_not_hang(there: zenoh.Session, here: zenoh.Session) -> None:
    begun = asyncio.Event()

    async def start(request: StartLiability) -> Done:
        begun.set()
        await asyncio.Event().wait()
        raise AssertionError

    async with asyncio.timeout(3):
        async with offering(there, here, start=start):
            asking = asyncio.create_task(call(here, ADDRESS, "start", REQUEST))
            await begun.wait()
            there.close()  # type: ignore[no-untyped-call]

        with pytest.raises(ServiceFailed):
            await asking


async def test_cancelling_a_question_takes_effect_at_once(here: zenoh.Session, there: zenoh.Session) -> None:
    begun = asyncio.Event()

    async def start(request: StartLiability) -> Done:
        begun.set()
        await asyncio.Event().wait()
        raise AssertionError

    def ask_in_a_loop_of_its_own() -> None:
        async def ask() -> None:
            async with asyncio.timeout(0.3):
                await call(here, ADDRESS, "start", REQUEST, timeout=30)

        with pytest.raises(TimeoutError):
            asyncio.run(ask())

    async with offering(there, here, start=start):
        with at_most(3):  # the loop ends when its threads have ended
            await asyncio.to_thread(ask_in_a_loop_of_its_own)
        assert begun.is_set()


async def test_services_are_offered_inside_async_with(here: zenoh.Session) -> None:
    services = Services(here, ADDRESS)
    for _ in range(2):
        with pytest.raises(ClosedError):
            services.offer("start", done)
        async with services:
            pass
