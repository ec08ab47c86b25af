"""Runs of jobs: they continue what an interrupted one has recorded, and follow the settings."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from mesh.recording import AT_ONCE, open_objective
from schemas import String
from tests.mesh.agent.samples import job, liability

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent.jobs import Executor
    from tests.support.market import Place


@pytest.fixture
async def executor(place: Place) -> AsyncIterator[Executor]:
    """The executor of a robot that does nothing by itself."""
    async with place.agent("robot", enable_executor=False) as robot:
        yield robot.runtime.executor


async def test_an_interrupted_recording_is_continued(executor: Executor) -> None:
    first = await executor.create_run(job())
    first.open()
    first.publish("/led", "before")
    await first.close()  # and then, before the Result was in the ledger, a crash
    second = await executor.create_run(job())
    second.open()
    second.publish("/led", "after")
    summary = await second.close()
    assert summary.recovered == 1
    recorded = [String.decode(message.payload).data for message in open_objective(summary.path).messages()]
    assert recorded == ["before", "after"]


async def test_a_run_that_is_cancelled_while_its_recording_is_opened_leaves_it_to_another(executor: Executor) -> None:
    cancelled = asyncio.create_task(executor.create_run(job()))
    await asyncio.sleep(0)
    cancelled.cancel()
    with pytest.raises(asyncio.CancelledError):
        await cancelled
    summary = await (await executor.create_run(job())).close()
    assert summary.messages == 0


@pytest.mark.parametrize("leftover", ["", ".part", ".cut"])
async def test_a_discarded_recording_is_not_continued(executor: Executor, leftover: str) -> None:
    first = await executor.create_run(job())
    first.open()
    first.publish("/led", "before")
    path = (await first.close()).path
    path.rename(path.with_name(path.name + leftover))
    executor.recordings.discard(liability().address)
    summary = await (await executor.create_run(job())).close()
    assert (summary.messages, summary.recovered) == (0, 0)


async def test_a_recording_that_does_not_exist_can_be_discarded(executor: Executor) -> None:
    executor.recordings.discard(liability().address)


async def test_the_settings_choose_pace_and_topics(place: Place) -> None:
    async with place.agent("robot", enable_executor=False, playback="recorded", recording_topics=" /a,/b/c ,") as robot:
        run = await robot.runtime.executor.create_run(job())
        assert run.speed == 1.0
        assert run.recorded == frozenset({"/a", "/b/c"})
        await run.close()


async def test_by_default_all_topics_are_recorded(executor: Executor) -> None:
    run = await executor.create_run(job())
    assert (run.speed, run.recorded) == (AT_ONCE, None)
    await run.close()
