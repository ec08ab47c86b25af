"""Daemons of the years when the legacy network ran."""

from __future__ import annotations

import asyncio
import json
from base64 import b64decode
from typing import TYPE_CHECKING

import aiohttp
import pytest

from bridges.ipfs import AccessDenied, Daemon, PubSubDisabled
from bridges.ipfs.writing import legacy_json
from schemas import encode
from tests.bridges.ipfs.bridges import bridging, on_mesh, until_seen
from tests.bridges.ipfs.replays import OldDaemon
from tests.support.orders import demand, offer
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter

SECONDS = 60.0


@pytest.fixture
async def pair() -> AsyncIterator[tuple[OldDaemon, OldDaemon]]:
    async with OldDaemon() as one, OldDaemon() as two:
        one.others, two.others = [two], [one]
        yield one, two


async def test_the_dialect_is_found_by_the_version(pair: tuple[OldDaemon, OldDaemon]) -> None:
    async with Daemon(pair[0].api) as daemon:
        assert str(await daemon.greet()) == "go-ipfs 0.4.18"
        assert daemon.dialect == "plain"


async def test_messages_pass_both_ways_in_the_old_dialect(
    pair: tuple[OldDaemon, OldDaemon], router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    one, two = pair
    order, answer = demand(), offer()
    async with (
        asyncio.timeout(SECONDS),
        aiohttp.ClientSession() as http,
        http.get(f"{two.api}/api/v0/pubsub/sub", params={"arg": topic}) as heard,
        on_mesh(router.endpoint, topic) as mesh,
        bridging(router.endpoint, one.api, topic, tmp_path / "journal.sqlite") as bridge,
    ):
        await until(lambda: bridge.status().state == "connected", seconds=SECONDS)
        await until_seen(mesh, bridge.address)
        assert bridge.status().ipfs_peers == (two.peer_id,)
        # As the clients of 2018 published: everything in the address.
        await http.get(f"{two.api}/api/v0/pubsub/pub", params=[("arg", topic), ("arg", legacy_json(order).decode())])
        await until(lambda: mesh.heard, seconds=SECONDS)
        assert mesh.payloads == [encode(order)]
        mesh.channel.publish(answer)
        lines = [json.loads(await heard.content.readline()) for _ in range(2)]
        assert [b64decode(line["data"]) for line in lines] == [legacy_json(order), legacy_json(answer)]
        assert lines[1]["topicIDs"] == [topic]


async def test_a_daemon_without_pubsub_says_so_and_what_to_do(topic: str) -> None:
    async with OldDaemon(pubsub=False) as old, Daemon(old.api) as daemon:
        await daemon.greet()
        with pytest.raises(PubSubDisabled, match="not enabled") as refused:
            await daemon.publish(topic, b"hello")
        assert "--enable-pubsub-experiment" in refused.value.hint


async def test_a_protected_daemon_wants_the_right_header() -> None:
    async with OldDaemon(authorization="Bearer right") as old:
        async with Daemon(old.api, authorization="Bearer right") as daemon:
            await daemon.greet()
        async with Daemon(old.api, authorization="Bearer wrong") as daemon:
            with pytest.raises(AccessDenied) as denied:
                await daemon.greet()
            assert "wrong" not in str(denied.value)
