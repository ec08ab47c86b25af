"""Background tasks: how they end, and which error is raised."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.base.background import Background
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Coroutine


async def for_ever(ended: list[str], name: str) -> None:
    try:
        await asyncio.Event().wait()
    finally:
        ended.append(name)


async def fail(error: Exception) -> None:
    await asyncio.sleep(0)
    raise error


async def test_leaving_cancels_all_tasks() -> None:
    ended: list[str] = []

    async with asyncio.timeout(60), Background() as tasks:
        tasks.start(for_ever(ended, "a"), "a")
        tasks.start(for_ever(ended, "b"), "b")
        await asyncio.sleep(0)

    assert sorted(ended) == ["a", "b"]


async def test_a_task_has_its_name() -> None:
    async with Background() as tasks:
        tasks.start(for_ever([], ""), "the name")

        assert "the name" in {task.get_name() for task in asyncio.all_tasks()}


async def beside(*works: Coroutine[Any, Any, None], body: Coroutine[Any, Any, None]) -> None:
    async with Background() as tasks:
        for number, work in enumerate(works):
            tasks.start(work, str(number))
        await asyncio.sleep(0)
        await body


async def test_a_failed_task_cancels_body_and_other_tasks_and_its_error_is_raised() -> None:
    ended: list[str] = []

    with pytest.raises(ValueError, match="broken"):
        await beside(for_ever(ended, "a"), fail(ValueError("broken")), body=for_ever(ended, "body"))

    assert sorted(ended) == ["a", "body"]


async def test_an_error_of_the_body_is_raised() -> None:
    ended: list[str] = []

    with pytest.raises(ValueError, match="body"):
        await beside(for_ever(ended, "a"), body=fail(ValueError("body")))

    assert ended == ["a"]


async def test_several_errors_are_raised_as_a_group() -> None:
    with pytest.raises(ExceptionGroup) as raised:
        await beside(fail(ValueError("one")), fail(TypeError("two")), body=for_ever([], "body"))

    assert {type(error) for error in raised.value.exceptions} == {ValueError, TypeError}


async def test_cancelling_the_body_from_outside_stays_a_cancellation() -> None:
    ended: list[str] = []
    inside = asyncio.Event()

    async def body() -> None:
        async with Background() as tasks:
            tasks.start(for_ever(ended, "a"), "a")
            await asyncio.sleep(0)
            inside.set()
            await asyncio.Event().wait()

    running = asyncio.create_task(body())
    await inside.wait()
    running.cancel()

    with pytest.raises(asyncio.CancelledError):
        await running
    assert ended == ["a"]


async def test_a_task_can_end_before_the_body() -> None:
    done: list[str] = []

    async def short(name: str) -> None:
        done.append(name)

    async with Background() as tasks:
        tasks.start(short("first"), "first")
        await until(lambda: done == ["first"])
        tasks.start(short("second"), "second")
        await until(lambda: done == ["first", "second"])
