"""Door, client and signer that end in the middle of a job: it is one contract, found again by its key."""

from __future__ import annotations

import asyncio
import os
import signal
from contextlib import suppress
from typing import Any

import pytest
from mcp_types.version import LATEST_HANDSHAKE_VERSION, LATEST_MODERN_VERSION

from tests.support.mcp.world import PRICE, World, content, ended
from tests.support.waiting import until_found

SLOW = [{"topic": "/count", "value": {"count": 3, "mode": "fine"}}]


@pytest.mark.in_turn("state")
@pytest.mark.parametrize("state", ["asked", "waiting", "running"])
@pytest.mark.parametrize("victim", ["door", "client", "signer"])
async def test_a_job_is_found_again(world: World, victim: str, state: str) -> None:
    before, made = await world.money(), await world.contracts()
    asked = world.order("one", messages=SLOW)
    begun = asyncio.Event()

    async def first() -> None:
        async with world.door(LATEST_MODERN_VERSION) as client:
            call = asyncio.create_task(client.call_tool("order", asked))
            await asyncio.sleep(0.05)
            if state == "asked":
                begun.set()
            await call
            begun.set()
            await asyncio.Event().wait()

    running = asyncio.create_task(first())
    await begun.wait()
    if state != "asked":
        await until_found(lambda: reached(world, state), what=state)
    match victim:
        case "door":
            os.kill(int(world.pid_file.read_text()), signal.SIGKILL)
        case "client":
            running.cancel()
        case "signer":
            await world.stop_signer()
            await world.start_signer()
    async with world.door(LATEST_HANDSHAKE_VERSION) as client:
        job = content(await client.call_tool("order", asked))
        again = content(await client.call_tool("job", {"job_id": job["job_id"]}))
        assert again["job_id"] == job["job_id"]
        job = await ended(client, job)
        assert job["state"] == "done", job
        listed = content(await client.call_tool("jobs", {}))["jobs"]
        assert [one["job_id"] for one in listed] == [job["job_id"]]
    assert (await world.money(), await world.contracts()) == (before - PRICE, made + 1)
    running.cancel()
    with suppress(BaseException):
        await running


async def reached(world: World, state: str) -> Any:
    jobs = (await world.owner_jobs()).jobs
    return jobs and (jobs[0].state == state or (state == "waiting" and jobs[0].state in ("accepted", "running")))
