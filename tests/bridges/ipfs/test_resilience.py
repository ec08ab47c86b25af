"""Resilience: outages of daemons and routers, no listeners, restarts of the bridge, failover to another bridge."""

from __future__ import annotations

import asyncio
import secrets
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest

from bridges.ipfs import RelayJournal
from bridges.ipfs._relay import legacy_json
from mesh.errors import ConfigurationError
from schemas import TransactionFeedback, encode
from tests.support.ipfs_bridge.bridges import bridging, on_mesh, until_seen
from tests.support.ipfs_bridge.legacy import LegacyClient
from tests.support.orders import demand, offer
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from bridges.ipfs import ChannelBridge
    from tests.bridges.ipfs.conftest import Swarm
    from tests.support.ipfs import JsIpfs, Kubo
    from tests.support.ipfs_bridge.bridges import Mesh
    from tests.support.routers import EmbeddedRouter

SECONDS = 90.0


@pytest.fixture
def own_daemon(kind: type[JsIpfs | Kubo]) -> Iterator[JsIpfs | Kubo]:
    """A daemon of this test's own, not started yet."""
    with ExitStack() as stack:
        daemon = kind()
        stack.callback(daemon.close)
        yield daemon


@pytest.fixture
async def mesh(router: EmbeddedRouter, topic: str) -> AsyncIterator[Mesh]:
    async with on_mesh(router.endpoint, topic) as mesh:
        yield mesh


@pytest.mark.full
async def test_no_accepted_message_is_lost_by_outages_of_the_daemon(
    own_daemon: JsIpfs | Kubo,
    swarm: Swarm,
    bob: LegacyClient,
    mesh: Mesh,
    router: EmbeddedRouter,
    topic: str,
    tmp_path: Path,
) -> None:
    await bob.listen(topic)
    orders = [demand(cost=number) for number in range(60)]
    neighbours = (swarm.b.swarm_address,)
    async with bridging(router.endpoint, own_daemon.api, topic, tmp_path / "journal", swarm_peers=neighbours) as bridge:
        await until_seen(mesh, bridge.address)
        for order in orders[:20]:
            mesh.channel.publish(order)
        await until(lambda: bridge.status().to_ipfs.waiting == 20, seconds=SECONDS)
        assert bridge.status().state == "no daemon"
        await until(lambda: own_daemon.api in bridge.status().last_error, seconds=SECONDS)

        await asyncio.to_thread(own_daemon.start)
        await until(lambda: len(set(bob.heard)) == 20, what="the waiting messages", seconds=SECONDS)
        await until(lambda: bridge.status().state == "connected", seconds=SECONDS)
        assert bridge.status().last_error == ""

        for order in orders[20:40]:
            mesh.channel.publish(order)
            if order is orders[30]:
                await asyncio.to_thread(own_daemon.kill)
        await until(lambda: bridge.status().state == "no daemon", seconds=SECONDS)
        for order in orders[40:]:
            mesh.channel.publish(order)
        await asyncio.to_thread(own_daemon.start)
        await until(lambda: len(set(bob.heard)) == 60, what="the messages accepted meanwhile", seconds=SECONDS)
        assert bridge.status().losses == 1

        await until_found(lambda: bob.peers(topic), seconds=SECONDS)
        await bob.publish(topic, legacy_json(answer := offer()))
        await until(lambda: encode(answer) in mesh.payloads, seconds=SECONDS)
    # The message in flight when the daemon died may arrive twice, and at each of its two starts the one that was being
    # published while the first listener appeared. Every other message arrives once.
    assert len(bob.heard) - 1 - len(set(bob.heard[:-1])) <= 3


@pytest.mark.full
async def test_a_frozen_daemon_is_detected_and_used_again_afterwards(
    own_daemon: JsIpfs | Kubo,
    swarm: Swarm,
    bob: LegacyClient,
    mesh: Mesh,
    router: EmbeddedRouter,
    topic: str,
    tmp_path: Path,
) -> None:
    await bob.listen(topic)
    await asyncio.to_thread(own_daemon.start)
    one, two, answer = demand(), demand(), offer()
    await bob.call("swarm/connect", ("arg", own_daemon.swarm_address))
    async with bridging(router.endpoint, own_daemon.api, topic, tmp_path / "journal", call_timeout=3.0) as bridge:
        await ready(bridge, mesh)
        mesh.channel.publish(one)
        await until(lambda: bob.heard, seconds=SECONDS)
        own_daemon.pause()
        try:
            await until(lambda: bridge.status().state == "no daemon", seconds=SECONDS)
            mesh.channel.publish(two)
            await until(lambda: bridge.status().to_ipfs.waiting == 1, seconds=SECONDS)
            # It still accepts connections, but answers nothing.
            await until(lambda: own_daemon.api in bridge.status().last_error, seconds=SECONDS)
        finally:
            own_daemon.resume()
        await until(lambda: legacy_json(two) in bob.heard, seconds=SECONDS)
        await until_found(lambda: bob.peers(topic), seconds=SECONDS)
        await bob.publish(topic, legacy_json(answer))
        await until(lambda: encode(answer) in mesh.payloads, seconds=SECONDS)
        assert bridge.status().losses >= 1


@pytest.mark.full
async def test_messages_without_listeners_are_sent_once_there_is_one(
    own_daemon: JsIpfs | Kubo,
    swarm: Swarm,
    bob: LegacyClient,
    mesh: Mesh,
    router: EmbeddedRouter,
    topic: str,
    tmp_path: Path,
) -> None:
    await asyncio.to_thread(own_daemon.start)
    orders = [demand(cost=number) for number in range(5)]
    async with bridging(router.endpoint, own_daemon.api, topic, tmp_path / "journal") as bridge:
        await until(lambda: bridge.status().state == "alone", seconds=SECONDS)
        await until_seen(mesh, bridge.address)
        for order in orders:
            mesh.channel.publish(order)
        await until(lambda: bridge.status().to_ipfs.unheard == 5, seconds=SECONDS)
        await bob.listen(topic)
        await bob.call("swarm/connect", ("arg", own_daemon.swarm_address))
        await until(lambda: len(bob.heard) >= 5, seconds=SECONDS)
        await until(lambda: bridge.status().to_ipfs.unheard == bridge.status().to_ipfs.waiting == 0, seconds=SECONDS)
        mesh.channel.publish(last := offer())
        await until(lambda: legacy_json(last) in bob.heard, seconds=SECONDS)
    assert bob.heard == [*map(legacy_json, orders), legacy_json(last)]


async def test_a_restarted_bridge_sends_what_waited_and_nothing_twice(
    own_daemon: JsIpfs | Kubo,
    swarm: Swarm,
    bob: LegacyClient,
    mesh: Mesh,
    router: EmbeddedRouter,
    topic: str,
    tmp_path: Path,
) -> None:
    await bob.listen(topic)
    known, waited = demand(), demand()
    journal = tmp_path / "journal"
    async with bridging(router.endpoint, swarm.a.api, topic, journal) as bridge:
        await ready(bridge, mesh)
        mesh.channel.publish(known)
        await until(lambda: bob.heard and bridge.status().to_ipfs.carried == 1, seconds=SECONDS)
    async with bridging(router.endpoint, own_daemon.api, topic, journal) as bridge:  # its daemon is not running
        await until_seen(mesh, bridge.address)
        mesh.channel.publish(waited)
        mesh.channel.publish(known)  # senders repeat a message until it has an effect
        await until(lambda: bridge.status().to_ipfs.known == 1, seconds=SECONDS)
        assert bridge.status().to_ipfs.waiting == 1
    async with bridging(router.endpoint, swarm.a.api, topic, journal) as bridge:
        await ready(bridge, mesh)
        await until(lambda: len(bob.heard) == 2, seconds=SECONDS)
        mesh.channel.publish(waited)
        mesh.channel.publish(known)
        await until(lambda: bridge.status().to_ipfs.known >= 2, seconds=SECONDS)
        mesh.channel.publish(last := offer())
        await until(lambda: len(bob.heard) >= 3, seconds=SECONDS)
    assert bob.heard == [legacy_json(order) for order in (known, waited, last)]


@pytest.mark.full
async def test_another_bridge_takes_over_when_the_active_one_loses_its_daemon(
    own_daemon: JsIpfs | Kubo,
    swarm: Swarm,
    bob: LegacyClient,
    mesh: Mesh,
    router: EmbeddedRouter,
    topic: str,
    tmp_path: Path,
) -> None:
    await bob.listen(topic)
    await asyncio.to_thread(own_daemon.start)
    await bob.call("swarm/connect", ("arg", own_daemon.swarm_address))
    async with bridging(router.endpoint, own_daemon.api, topic, tmp_path / "one") as first:
        await ready(first, mesh)
        async with bridging(router.endpoint, swarm.a.api, topic, tmp_path / "two") as second:
            await ready(second, mesh)
            await until(lambda: first.relay.others and second.relay.others, seconds=SECONDS)
            assert (first.status().carries, second.status().carries) == (True, False)
            await until_forwarded(own_daemon.api, topic, second)
            mesh.channel.publish(one := demand())
            await until(lambda: second.status().to_ipfs.left == 1, seconds=SECONDS)
            await asyncio.to_thread(own_daemon.kill)
            await until(lambda: second.status().carries, seconds=SECONDS)
            mesh.channel.publish(two := demand())
            await until(lambda: legacy_json(two) in bob.heard, seconds=SECONDS)
            assert [heard for heard in bob.heard if b"tx" not in heard] == [legacy_json(one), legacy_json(two)]
            await until(lambda: second.status().to_ipfs.carried == 1, what="the daemon's answer", seconds=SECONDS)


async def test_messages_from_ipfs_wait_for_the_router(
    swarm: Swarm, bob: LegacyClient, router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    async with bridging(router.endpoint, swarm.a.api, topic, tmp_path / "journal") as bridge:
        await until_found(lambda: bob.peers(topic), seconds=SECONDS)
        await asyncio.to_thread(router.stop)
        await until(lambda: bridge.status().state == "no router", seconds=SECONDS)
        await bob.publish(topic, legacy_json(order := demand()))
        await until(lambda: bridge.status().to_mesh.waiting == 1, seconds=SECONDS)
        await asyncio.to_thread(router.start)
        async with on_mesh(router.endpoint, topic) as mesh:
            await until(lambda: bridge.status().to_mesh.carried == 1, seconds=SECONDS)
            await until_seen(mesh, bridge.address)
            await bob.publish(topic, legacy_json(later := offer()))
            await until(lambda: encode(later) in mesh.payloads, seconds=SECONDS)
        assert bridge.status().to_mesh.accepted == 2
        assert order.signature


async def test_a_full_queue_rejects_messages_and_counts_them(
    own_daemon: JsIpfs | Kubo, mesh: Mesh, router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    async with bridging(router.endpoint, own_daemon.api, topic, tmp_path / "journal", limit=3) as bridge:
        await until_seen(mesh, bridge.address)
        for number in range(5):
            mesh.channel.publish(demand(cost=number))
        await until(lambda: bridge.status().to_ipfs.received == 5, seconds=SECONDS)
        assert bridge.status().to_ipfs.waiting == 3
        assert bridge.status().to_ipfs.dropped == {"no-room": 2}


async def test_a_journal_belongs_to_one_bridge(tmp_path: Path) -> None:
    with (
        RelayJournal(tmp_path / "journal.sqlite"),
        pytest.raises(ConfigurationError) as refused,
        RelayJournal(tmp_path / "journal.sqlite"),
    ):
        pass
    assert "--data-dir" in refused.value.hint


async def until_forwarded(api: str, topic: str, bridge: ChannelBridge) -> None:
    """Return when messages of the daemon at `api` reach `bridge` through other nodes, which takes a heartbeat."""
    async with LegacyClient(api) as client:

        async def comes() -> bool:
            await client.publish(topic, legacy_json(TransactionFeedback(tx=secrets.token_hex(32))))
            await asyncio.sleep(0.1)
            return bridge.status().to_mesh.received > 0

        await until_found(comes, seconds=SECONDS)


async def ready(bridge: ChannelBridge, mesh: Mesh) -> None:
    await until(lambda: bridge.status().state == "connected", seconds=SECONDS)
    await until_seen(mesh, bridge.address)
