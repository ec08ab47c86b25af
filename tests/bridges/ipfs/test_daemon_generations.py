"""Daemons of 2018 and of today, as replays of their RPC."""

from __future__ import annotations

import asyncio
import json
from base64 import b64decode
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import aiohttp
import pytest

from bridges.ipfs import Daemon, IpfsError
from bridges.ipfs._relay import legacy_json
from schemas import encode
from tests.support.ipfs_bridge.bridges import bridging, on_mesh, until_seen
from tests.support.ipfs_bridge.legacy import LegacyClient
from tests.support.ipfs_bridge.replays import OldDaemon, RecentDaemon
from tests.support.orders import demand, offer
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from bridges.ipfs import ChannelBridge
    from tests.support.ipfs_bridge.bridges import Mesh
    from tests.support.routers import EmbeddedRouter


SECONDS = 60.0


@pytest.fixture
async def pair() -> AsyncIterator[tuple[OldDaemon, OldDaemon]]:
    async with OldDaemon() as one, OldDaemon() as two:
        one.others, two.others = [two], [one]
        yield one, two


async def test_the_old_dialect_is_detected_by_the_version(pair: tuple[OldDaemon, OldDaemon]) -> None:
    async with Daemon(pair[0].api) as daemon:
        assert str(await daemon.detect_version()) == "go-ipfs 0.4.18"
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


async def test_an_old_daemon_without_pubsub(topic: str) -> None:
    async with OldDaemon(pubsub=False) as old, Daemon(old.api) as daemon:
        await daemon.detect_version()
        with pytest.raises(IpfsError) as refused:
            await daemon.publish(topic, b"hello")
        assert refused.value.code == "pubsub-disabled"
        assert "--enable-pubsub-experiment" in refused.value.hint


async def test_a_protected_old_daemon_requires_the_right_header() -> None:
    async with OldDaemon(authorization="Bearer right") as old:
        async with Daemon(old.api, authorization="Bearer right") as daemon:
            await daemon.detect_version()
        async with Daemon(old.api, authorization="Bearer wrong") as daemon:
            with pytest.raises(IpfsError) as denied:
                await daemon.detect_version()
            assert denied.value.code == "access-denied"
            assert "wrong" not in str(denied.value)


@asynccontextmanager
async def bridged(
    one: RecentDaemon, two: RecentDaemon, endpoint: str, topic: str, folder: Path
) -> AsyncIterator[tuple[LegacyClient, Mesh, ChannelBridge]]:
    """A legacy client of daemon `two`, a client on the mesh, and a bridge at daemon `one`."""
    one.others, two.others = [two], [one]
    async with (
        LegacyClient(two.api) as bob,
        on_mesh(endpoint, topic) as mesh,
        bridging(endpoint, one.api, topic, folder / "journal.sqlite") as bridge,
    ):
        await bob.listen(topic)
        await until(lambda: bridge.status().state == "connected", seconds=SECONDS)
        await until_seen(mesh, bridge.address)
        yield bob, mesh, bridge


async def test_messages_pass_both_ways_in_the_current_dialect(
    router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
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


async def test_concurrent_channels_publish_in_order_at_one_daemon() -> None:
    async with RecentDaemon(slow=0.05) as recent, Daemon(recent.api) as daemon:
        await daemon.detect_version()
        await asyncio.gather(*(daemon.publish(f"topic {number}", b"hello") for number in range(6)))
        assert recent.refused_as_replay == 0


async def test_a_flood_reaches_nodes_that_validate_out_of_order(
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


async def test_messages_are_not_sent_again_to_a_listener_that_heard_them(
    router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    orders = [demand(cost=number) for number in range(40)]
    async with (
        RecentDaemon() as one,
        RecentDaemon() as two,
        LegacyClient(two.api) as bob,
        on_mesh(router.endpoint, topic) as mesh,
        bridging(router.endpoint, one.api, topic, tmp_path / "journal.sqlite") as bridge,
    ):
        one.others, two.others = [two], [one]
        await until_seen(mesh, bridge.address)
        await until(lambda: bridge.status().state == "alone", seconds=SECONDS)
        for order in orders:
            mesh.channel.publish(order)
        await until(lambda: bridge.status().to_ipfs.unheard >= 3, seconds=SECONDS)
        await bob.listen(topic)
        await until(lambda: set(bob.heard) == set(map(legacy_json, orders)), seconds=SECONDS)
        await until(lambda: bridge.status().to_ipfs.unheard == bridge.status().to_ipfs.waiting == 0, seconds=SECONDS)
    # One message may be on its way while the listener appears.
    assert len(bob.heard) - len(orders) <= 1


async def test_a_message_published_out_of_order_is_published_again(
    router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    async with RecentDaemon(slow=0.2) as recent, Daemon(recent.api) as daemon, Daemon(recent.api) as other:
        await daemon.detect_version()
        recent.validates.clear()
        earlier = asyncio.create_task(daemon.publish(topic, b"one"))
        await until(lambda: recent.numbered % 2, what="a number", seconds=SECONDS)
        await other.publish(topic, b"two")
        recent.validates.set()
        with raises_with(IpfsError, code="published-out-of-order"):
            await earlier
        async with (
            on_mesh(router.endpoint, topic) as mesh,
            LegacyClient(recent.api) as bob,
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


async def test_a_recent_daemon_without_pubsub(topic: str) -> None:
    async with RecentDaemon(pubsub=False) as recent, Daemon(recent.api) as daemon:
        await daemon.detect_version()
        with pytest.raises(IpfsError) as refused:
            await daemon.publish(topic, b"hello")
        assert refused.value.code == "pubsub-disabled"
        assert "Pubsub.Enabled true" in refused.value.hint


async def test_a_protected_recent_daemon_names_the_paths_it_must_allow() -> None:
    async with RecentDaemon(authorization="Bearer right") as recent:
        async with Daemon(recent.api, authorization="Bearer right") as daemon:
            await daemon.detect_version()
        async with Daemon(recent.api, authorization="Bearer wrong") as daemon:
            with pytest.raises(IpfsError) as denied:
                await daemon.detect_version()
            assert "pubsub" in denied.value.hint
            assert denied.value.code == "access-denied"
            assert "wrong" not in str(denied.value)


async def test_the_replay_rejects_browsers_and_get_like_a_kubo(topic: str) -> None:
    async with RecentDaemon() as recent, aiohttp.ClientSession() as http:
        async with http.get(f"{recent.api}/api/v0/version") as answer:
            assert answer.status == 405
        async with http.post(f"{recent.api}/api/v0/version", headers={"User-Agent": "Mozilla/5.0"}) as answer:
            assert answer.status == 403
        async with http.post(f"{recent.api}/api/v0/version", headers={"Origin": "http://page"}) as answer:
            assert answer.status == 403
