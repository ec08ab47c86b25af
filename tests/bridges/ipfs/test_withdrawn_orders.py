"""Withdrawn orders are relayed to neither side; the legacy network has no message for withdrawals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bridges.ipfs._relay import legacy_json
from mesh.market import OrderBook
from mesh.market._services import OrderBookService
from mesh.market.store import MarketStore, Withdrawals
from schemas import encode, verify_message
from tests.support import orders
from tests.support.ipfs_bridge.bridges import bridging, on_mesh, until_seen
from tests.support.orders import LIGHTHOUSE, STRANGER, demand, offer
from tests.support.ports import free_port
from tests.support.waiting import until, until_answered, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.bridges.ipfs.conftest import Swarm
    from tests.support.ipfs_bridge.bridges import Mesh
    from tests.support.ipfs_bridge.legacy import LegacyClient
    from tests.support.routers import EmbeddedRouter

SECONDS = 60.0


@pytest.fixture
async def mesh(router: EmbeddedRouter, topic: str) -> AsyncIterator[Mesh]:
    async with on_mesh(router.endpoint, topic) as mesh:
        yield mesh


async def test_a_withdrawn_order_is_not_relayed(
    swarm: Swarm, bob: LegacyClient, mesh: Mesh, router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    await bob.listen(topic)
    async with bridging(router.endpoint, swarm.a.api, topic, tmp_path / "journal") as bridge:
        await until(lambda: bridge.status().state == "connected", seconds=SECONDS)
        await until_found(lambda: bob.peers(topic), what="the bridge's daemon", seconds=SECONDS)
        await until_seen(mesh, bridge.address)
        one, two, kept = demand(), demand(), demand()
        withdrawals = orders.withdrawal(one), orders.withdrawal(two), orders.withdrawal(kept, signer=STRANGER)
        for withdrawal in withdrawals:
            mesh.channel.publish(withdrawal)
        await until(lambda: len(bridge.withdrawals) == 3, seconds=SECONDS)

        mesh.channel.publish(one)
        mesh.channel.publish(kept)
        await bob.publish(topic, legacy_json(two))
        await bob.publish(topic, legacy_json(last := offer()))
        await until(lambda: len(bob.heard) == 3 and encode(last) in mesh.payloads, seconds=SECONDS)
        assert set(bob.heard) == {legacy_json(message) for message in (kept, two, last)}
        assert encode(two) not in mesh.payloads
        await until(lambda: bridge.status().to_ipfs.invalid == {"withdrawn": 1}, seconds=SECONDS)
        await until(lambda: bridge.status().to_mesh.invalid == {"withdrawn": 1}, seconds=SECONDS)


async def test_an_order_that_waits_is_dropped_when_it_is_withdrawn(
    mesh: Mesh, router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    nowhere, journal = f"http://127.0.0.1:{free_port()}", tmp_path / "journal"
    async with bridging(router.endpoint, nowhere, topic, journal) as bridge:
        await until_seen(mesh, bridge.address)
        one, two = demand(), demand()
        mesh.channel.publish(one)
        mesh.channel.publish(two)
        await until(lambda: bridge.status().to_ipfs.waiting == 2, seconds=SECONDS)
        mesh.channel.publish(orders.withdrawal(one, signer=STRANGER))
        mesh.channel.publish(orders.withdrawal(two))
        await until(lambda: bridge.status().to_ipfs.waiting == 1, seconds=SECONDS)
        assert bridge.status().to_ipfs.invalid == {"withdrawn": 1}
    async with bridging(router.endpoint, nowhere, topic, journal) as bridge:
        assert bridge.status().to_ipfs.waiting == 1


async def test_a_bridge_that_starts_later_learns_withdrawals_from_a_provider(
    mesh: Mesh, router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    known = Withdrawals()
    known.add(verify_message(orders.withdrawal(demand())))
    nowhere = f"http://127.0.0.1:{free_port()}"
    async with OrderBookService(mesh.network.session, topic, OrderBook(LIGHTHOUSE), known):
        await until_answered(mesh.network.session, f"aira/{topic}/withdrawal")
        async with bridging(router.endpoint, nowhere, topic, tmp_path / "journal") as bridge:
            await until(lambda: set(bridge.withdrawals) == set(known), seconds=SECONDS)


async def test_a_bridge_keeps_withdrawals_across_restarts(
    mesh: Mesh, router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    nowhere, path = f"http://127.0.0.1:{free_port()}", tmp_path / "withdrawals"
    withdrawal = verify_message(orders.withdrawal(demand()))
    with Withdrawals(MarketStore(path)) as known:
        async with bridging(router.endpoint, nowhere, topic, tmp_path / "journal", withdrawals=known) as bridge:
            await until_seen(mesh, bridge.address)
            mesh.channel.publish(withdrawal.message)
            await until(lambda: withdrawal in set(bridge.withdrawals), seconds=SECONDS)
    with Withdrawals(MarketStore(path)) as known:
        assert set(known) == {withdrawal}
