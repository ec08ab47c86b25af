"""Demands whose numbers older legacy nodes can't hold: the bridge tells their maker that they don't get them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from bridges.ipfs.service import IpfsBridge
from mesh.base.background import Background
from mesh.network import Endpoints, Network
from schemas import parse_address
from tests.support.ipfs_bridge.replays import OldDaemon
from tests.support.market import MODEL
from tests.support.waiting import until

if TYPE_CHECKING:
    from mesh.agent.contracts import Progress
    from mesh.testing import Market


async def test_the_maker_of_a_demand_that_is_not_passed_on_is_told(market: Market) -> None:
    person = await market.person()
    heard: list[Progress] = []
    async with (
        OldDaemon() as daemon,
        Network(Endpoints(connect=(market.endpoint,))) as network,
        IpfsBridge(network, market.settings("bridge", ipfs_http_provider=daemon.api)) as bridge,
        Background() as tasks,
    ):
        tasks.start(bridge.run(), "bridge of the test")
        (channel,) = bridge.channels
        await until(lambda: channel.status().carries, seconds=60)
        demands = [
            asyncio.create_task(person.demand([("/go", "x")], model=MODEL, cost=cost, on_progress=heard.append))
            for cost in ((1 << 32) - 1, 1 << 32)
        ]
        await until(lambda: any(said.kind == "declined" for said in heard), seconds=60)
        for demand in demands:
            demand.cancel()
        await asyncio.wait(demands)
        (said,) = [said for said in heard if said.kind == "declined"]
        assert (said.agent, said.code) == (parse_address(channel.address), "too-large")
        assert "IPFS" in said.detail
        assert f"{(1 << 32) - 1:,}" in said.detail
        assert set(channel.status().to_ipfs.invalid) == {"too-large"}, "it may be sent again meanwhile"
