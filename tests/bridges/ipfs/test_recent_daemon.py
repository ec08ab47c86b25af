"""What daemons of today answer otherwise."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import aiohttp
import pytest

from bridges.ipfs import AccessDenied, Daemon, Overtaken, PubSubDisabled
from bridges.ipfs.writing import legacy_json
from schemas import encode
from tests.bridges.ipfs.bridges import bridging, on_mesh, until_seen
from tests.bridges.ipfs.legacy import Bare
from tests.bridges.ipfs.replays import RecentDaemon
from tests.support.orders import demand, offer
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from bridges.ipfs import ChannelBridge
    from tests.bridges.ipfs.bridges import Mesh
    from tests.support.routers import EmbeddedRouter

SECONDS = 60.0


@asynccontextmanager
async def bridged(
    one: RecentDaemon, two: RecentDaemon, endpoint: str, topic: str, folder: Path
) -> AsyncIterator[tuple[Bare, Mesh, ChannelBridge]]:
    """Somebody at the second of two daemons, the mesh, and a bridge between that and the first."""
    one.others, two.others = [two], [one]
    async with (
        Bare(two.api) as bob,
        on_mesh(endpoint, topic) as mesh,
        bridging(endpoint, one.api, topic, folder / "journal.sqlite") as bridge,
    ):
        await bob.listen(topic)
        await until(lambda: bridge.status().state == "connected", seconds=SECONDS)
        await until_seen(mesh, bridge.address)
        yield bob, mesh, bridge


async def test_messages_pass_both_ways(router: EmbeddedRouter, topic: str, tmp_path: Path) -> None:
    async with (
        RecentDaemon() as one,
        RecentDaemon() as two,
        bridged(one, two, router.endpoint, topic, tmp_path) as (bob, mesh, bridge),
    ):
        assert (bridge.status().daemon, bridge.status().dialect) == ("kubo 0.44.0", "multibase")
        await bob.publish(topic, legacy_json(order := demand()))
        await until(lambda: mesh.heard, seconds=SECONDS)
        mesh.channel.publish(answer := offer())
        await until(lambda: len(bob.heard) == 2, seconds=SECONDS)
        assert mesh.payloads[0] == encode(order)
        assert bob.heard == [legacy_json(order), legacy_json(answer)]


async def test_several_channels_do_not_overtake_each_other_at_one_daemon() -> None:
    async with RecentDaemon(slow=0.05) as recent, Daemon(recent.api) as daemon:
        await daemon.greet()
        await asyncio.gather(*(daemon.publish(f"topic {number}", b"hello") for number in range(6)))
        assert recent.overtaken == 0


async def test_a_flood_of_the_mesh_comes_to_other_nodes_that_check_it_in_the_wrong_order(
    router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    async with (
        RecentDaemon() as one,
        RecentDaemon(busy=0.01) as two,
        bridged(one, two, router.endpoint, topic, tmp_path) as (bob, mesh, bridge),
    ):
        orders = [demand(cost=number) for number in range(50)]
        for order in orders:
            mesh.channel.publish(order)
        await until(lambda: bridge.status().to_ipfs.carried == len(orders), seconds=SECONDS)
        await until(lambda: len(bob.heard) + two.lost == len(orders), seconds=SECONDS)
        assert bob.heard == [legacy_json(order) for order in orders]


async def test_what_somebody_else_has_overtaken_is_published_again(
    router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    async with RecentDaemon(slow=0.2) as recent, Daemon(recent.api) as daemon, Daemon(recent.api) as other:
        await daemon.greet()
        with pytest.raises(Overtaken) as refused:
            await asyncio.gather(daemon.publish(topic, b"one"), other.publish(topic, b"two"))
        assert refused.value.status == 500
        async with (
            on_mesh(router.endpoint, topic) as mesh,
            Bare(recent.api) as bob,
            bridging(router.endpoint, recent.api, topic, tmp_path / "journal.sqlite") as bridge,
        ):
            await bob.listen(topic)
            await until_seen(mesh, bridge.address)
            orders = [demand(cost=number) for number in range(10)]
            crowd = [asyncio.create_task(bob.publish(topic, b"noise")) for _ in range(10)]
            for order in orders:
                mesh.channel.publish(order)
            await asyncio.gather(*crowd)
            await until(lambda: set(map(legacy_json, orders)) <= set(bob.heard), seconds=SECONDS)
            assert bridge.status().to_ipfs.dropped == {}


async def test_a_daemon_without_pubsub_says_so(topic: str) -> None:
    async with RecentDaemon(pubsub=False) as recent, Daemon(recent.api) as daemon:
        await daemon.greet()
        with pytest.raises(PubSubDisabled, match="not enabled") as refused:
            await daemon.publish(topic, b"hello")
        assert "Pubsub.Enabled true" in refused.value.hint


async def test_what_the_secret_of_a_protected_daemon_must_open_is_told() -> None:
    async with RecentDaemon(authorization="Bearer right") as recent:
        async with Daemon(recent.api, authorization="Bearer right") as daemon:
            await daemon.greet()
        async with Daemon(recent.api, authorization="Bearer wrong") as daemon:
            with pytest.raises(AccessDenied, match="Access Denied") as denied:
                await daemon.greet()
            assert "pubsub" in denied.value.hint
            assert "wrong" not in str(denied.value)


async def test_the_replay_keeps_browsers_and_get_out_as_a_kubo_does(topic: str) -> None:
    async with RecentDaemon() as recent, aiohttp.ClientSession() as http:
        async with http.get(f"{recent.api}/api/v0/version") as answer:
            assert answer.status == 405
        async with http.post(f"{recent.api}/api/v0/version", headers={"User-Agent": "Mozilla/5.0"}) as answer:
            assert answer.status == 403
        async with http.post(f"{recent.api}/api/v0/version", headers={"Origin": "http://page"}) as answer:
            assert answer.status == 403
