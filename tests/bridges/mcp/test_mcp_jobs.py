"""Whole jobs over real doors: found, quoted, ordered, watched, stopped, refunded, verified."""

from __future__ import annotations

import pytest
from mcp_types.version import LATEST_HANDSHAKE_VERSION, LATEST_MODERN_VERSION

from tests.support.mcp.world import PRICE, World, content, ended


@pytest.mark.parametrize("version", [LATEST_MODERN_VERSION, LATEST_HANDSHAKE_VERSION])
async def test_a_robot_is_found_quoted_hired_watched_and_its_work_verified(world: World, version: str) -> None:
    async with world.door(version) as client:
        assert client.protocol_version == version
        found = content(await client.call_tool("find_robots", {}))
        [robot] = [one for one in found["robots"] if one["address"] == world.robot]
        assert robot["is_allowed"]
        described = content(await client.call_tool("describe_model", {"model": robot["models"][0]["cid"]}))
        [topic] = described["topics"]
        assert (topic["topic"], topic["is_allowed"]) == ("/count", True)
        count = next(field for field in topic["fields"] if field["path"] == "count")
        assert (count["maximum"], count["unit"]) == (100, "pieces")
        assert count["allowed"] == [{"minimum": 1, "maximum": 10, "choices": []}]
        messages = [{"topic": "/count", "value": {"count": 1, "mode": "fine"}}]
        quoted = content(await client.call_tool("quote", {"model": world.cid, "messages": messages}))
        [quote] = quoted["quotes"]
        assert (quote["cost"], quote["verdict"]) == ({"text": "2 XRT", "units": PRICE}, "allowed")
        before, made = await world.money(), await world.contracts()
        job = content(await client.call_tool("order", world.order("one")))
        job = await ended(client, job)
        assert job["state"] == "done", job
        assert await world.money() == before - PRICE
        assert await world.contracts() == made + 1
        again = content(await client.call_tool("order", world.order("one")))
        assert (again["job_id"], again["contract"]) == (job["job_id"], job["contract"])
        recording = content(await client.call_tool("recording", {"job_id": job["job_id"]}))
        assert "/slow" in {one["topic"]["text"] for one in recording["topics"]}
        values = content(await client.call_tool("recording", {"job_id": job["job_id"], "topic": "/slow"}))
        assert len(values["values"]) == 1
        checks = content(await client.call_tool("verify", {"job_id": job["job_id"]}))
        assert checks["holds"], checks
        spent = content(await client.call_tool("statement", {}))
        assert job["contract"] in {entry["contract"] for entry in spent["entries"]}
        balance = content(await client.call_tool("balance", {}))
        assert balance["hour_left"]["text"] == "18 XRT"
        for uri in ("aira://market", f"aira://robot/{world.robot}", "aira://jobs"):
            (read,) = (await client.read_resource(uri)).contents
            assert world.robot in read.text  # type: ignore[union-attr]
        for uri in (f"aira://contract/{job['contract']}", f"aira://recording/{job['job_id']}"):
            (read,) = (await client.read_resource(uri)).contents
            assert job["result"] in read.text  # type: ignore[union-attr]


async def test_a_job_that_fails_is_refunded(world: World) -> None:
    async with world.door(LATEST_MODERN_VERSION) as client:
        before = await world.money()
        messages = [{"topic": "/count", "value": {"count": 1, "mode": "fail"}}]
        job = await ended(client, content(await client.call_tool("order", world.order("one", messages=messages))))
        assert job["state"] == "refunded"
        assert await world.money() == before


async def test_a_job_is_stopped_and_refunded(world: World) -> None:
    async with world.door(LATEST_MODERN_VERSION) as client:
        before = await world.money()
        messages = [{"topic": "/count", "value": {"count": 10, "mode": "fine"}}] * 3
        job = content(await client.call_tool("order", world.order("one", messages=messages)))
        while job["state"] != "running":
            asked = {"job_id": job["job_id"], "revision": job["revision"], "wait_seconds": 10}
            job = content(await client.call_tool("job", asked))
        await client.call_tool("stop_job", {"job_id": job["job_id"], "why": "enough"})
        job = await ended(client, job)
        assert job["state"] == "stopped"
        assert await world.money() == before
