"""Runs of jobs that are cancelled or discarded."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from tests.support.agent.samples import job, liability

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent.jobs import Executor
    from tests.support.market import Place


@pytest.fixture
async def executor(place: Place) -> AsyncIterator[Executor]:
    """The executor of a robot that does nothing by itself."""
    async with place.agent("robot", enable_executor=False) as robot:
        yield robot.runtime.executor


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
