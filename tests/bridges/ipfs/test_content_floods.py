"""Floods of messages that name files: what they cost the honest, with a real daemon."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from bridges.ipfs._content import URGENT, Gateway
from mesh.base.flood import Drops
from mesh.content import ContentUnavailable
from schemas.unixfs import CHUNK_SIZE, cid_of_bytes
from tests.bridges.ipfs.test_content import SECONDS, agent, blocks_of, bridged, content_of, gateway
from tests.support.ports import free_port
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    from tests.bridges.ipfs.conftest import Swarm
    from tests.support.ipfs_bridge.legacy import LegacyClient
    from tests.support.routers import EmbeddedRouter

DEAD = 160


async def test_demands_with_dead_cids_do_not_delay_a_result(
    swarm: Swarm, bob: LegacyClient, router: EmbeddedRouter, tmp_path: Path
) -> None:
    content, drops = content_of(CHUNK_SIZE + 1, str(tmp_path)), Drops()
    async with (
        agent(router.endpoint, tmp_path / "agent") as robot,
        bridged(router.endpoint, swarm.a.api, tmp_path / "bridge", drops=drops) as bridge,
    ):
        for number in range(DEAD):
            dead = cid_of_bytes(f"{tmp_path} {number}".encode())
            bridge.content.adds.add(dead, f"fresh {number}")
            bridge.content.fetches.add(dead, f"fresh {number}")
            bridge.content.adds.add(cid_of_bytes(dead.encode()), "one signer")
        cid = await asyncio.to_thread(robot.store.put_bytes, content)

        bridge.content.adds.add(cid, "robot", priority=URGENT)
        await until(lambda: bridge.content.metrics().added == 1, what="the result on IPFS", seconds=SECONDS)

        counts = bridge.content.metrics()
        assert counts.adds_queued + counts.fetches_queued > DEAD, "the flood still waits"
        assert counts.failed > 0, "one signer had too many"
        assert drops.heaviest("content-queue-full", 1)[0][0] == "one signer"
        assert await bob.cat(cid) == content


async def test_a_file_that_many_demands_name_is_added_once(
    swarm: Swarm, router: EmbeddedRouter, tmp_path: Path
) -> None:
    async with (
        agent(router.endpoint, tmp_path / "agent") as person,
        bridged(router.endpoint, swarm.a.api, tmp_path / "bridge") as bridge,
    ):
        cid = await asyncio.to_thread(person.store.put_bytes, content_of(3 * CHUNK_SIZE, str(tmp_path)))
        for number in range(20):
            bridge.content.adds.add(cid, f"signer {number}")
        await until(lambda: bridge.content.metrics().joined == 19, what="all of them", seconds=SECONDS)
        await until(lambda: bridge.content.metrics().added == 1, what="the file on IPFS", seconds=SECONDS)
        assert bridge.content.metrics().adds_queued == 0


async def test_leaves_of_a_fetched_file_are_no_files_of_their_own(router: EmbeddedRouter, tmp_path: Path) -> None:
    content = b"".join(content_of(CHUNK_SIZE, f"{tmp_path} {number}") for number in range(9))
    blocks = blocks_of(tmp_path, content)
    cid = cid_of_bytes(content)
    *_, last, _ = blocks
    available = {name: block for name, block in blocks.items() if name != last}
    async with (
        gateway(available) as address,
        Gateway(address) as source,
        bridged(router.endpoint, f"http://127.0.0.1:{free_port()}", tmp_path / "bridge", source) as bridge,
        agent(router.endpoint, tmp_path / "agent") as robot,
    ):
        with pytest.raises(ContentUnavailable):
            await bridge.content.fetch(cid)  # from here on the bridge serves the root, and lacks a leaf
        available.update(blocks)

        assert (await robot.exchange.fetch(cid, timeout=SECONDS)).read_bytes() == content

        content_bridge = bridge.content
        await until(lambda: not content_bridge._tasks and not content_bridge.metrics().fetches_queued, seconds=SECONDS)
        await until(lambda: not content_bridge.fetches._running, what="the end of all fetches", seconds=SECONDS)
        assert not set(bridge.store.list()) - {cid}
