"""A provider whose node fails, is away, or does not mine; and one without ETH."""

from __future__ import annotations

import asyncio
import math
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from web3.providers.async_base import AsyncBaseProvider

from mesh.chain import GWEI
from mesh.devchain import JsonRpcServer
from mesh.devchain.development import deploy_market
from mesh.retry import RetryPolicy
from schemas import cid_of_bytes, parse_cid
from tests.mesh.market.floor import QUICK, Floor
from tests.mesh.market.troubles import events, outages, until_read, works_on
from tests.support.ports import free_port
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from web3.types import RPCEndpoint, RPCResponse

    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter


@asynccontextmanager
async def served(floor: Floor, port: int) -> AsyncIterator[str]:
    assert not isinstance(floor.node, str)
    async with JsonRpcServer(floor.node, port=port) as server:
        yield server.url


class Moody(AsyncBaseProvider):
    """The floor's node, whose simulations of what holds some bytes fail so many times as `fails` says."""

    def __init__(self, floor: Floor, data: bytes, *, times: float = math.inf, fails: str = "silence") -> None:
        super().__init__()
        assert not isinstance(floor.node, str)
        self._node, self._data, self._fails = floor.node, data.hex(), fails
        self.left = times

    async def make_request(self, method: RPCEndpoint, params: Any) -> RPCResponse:
        if method == "eth_estimateGas" and self._data in params[0]["data"] and self.left > 0:
            self.left -= 1
            if self._fails == "silence":
                raise ConnectionResetError
            return {"jsonrpc": "2.0", "id": 1, "error": {"code": -32005, "message": "too many requests"}}
        return await self._node.make_request(method, params)


@pytest.mark.parametrize("fails", ["silence", "refusal"])
async def test_a_node_that_fails_now_and_then_costs_no_order_and_no_result(floor: Floor, fails: str) -> None:
    node = Moody(floor, b"", times=3, fails=fails)
    async with floor.provider(endpoint=node) as provider:
        demand = floor.demand()
        floor.publish(demand, floor.offer())
        liability = await floor.liability_of(demand)
        assert node.left == 0

        node.left = 3
        floor.publish(floor.result(liability.address))
        await until(lambda: provider.earnings().finalized == 1)
        assert node.left == 0
    assert floor.rejections == []


@pytest.mark.parametrize("fails", ["silence", "refusal"])
async def test_others_go_first_while_a_transaction_waits_that_the_node_never_takes(floor: Floor, fails: str) -> None:
    objective = cid_of_bytes(fails.encode())
    node, retry = Moody(floor, parse_cid(objective), fails=fails), RetryPolicy(initial=3600.0, ceiling=3600.0)
    async with floor.provider(endpoint=node, retry=retry) as provider:
        guilty, offer = (make(cost=0, objective=objective) for make in (floor.demand, floor.offer))
        floor.publish(guilty, offer)
        assert await works_on(floor, provider)
        assert floor.rejections == []


@pytest.mark.parametrize("fails", ["silence", "refusal"])
async def test_a_transaction_that_the_node_never_takes_is_rejected_after_the_last_attempt(
    floor: Floor, fails: str
) -> None:
    objective = cid_of_bytes(fails.encode())
    async with floor.provider(endpoint=Moody(floor, parse_cid(objective), fails=fails)):
        floor.publish(*(make(cost=0, objective=objective) for make in (floor.demand, floor.offer)))
        await until(lambda: len(floor.rejections) == 2)
        assert {one.reason for one in floor.rejections} == {
            "NodeUnreachable" if fails == "silence" else "RequestRefused"
        }


async def test_a_node_that_is_away_for_a_while_costs_no_order_and_no_result(
    floor: Floor, caplog: pytest.LogCaptureFixture
) -> None:
    port = free_port()
    node = served(floor, port)
    async with floor.provider(endpoint=await node.__aenter__()) as provider:
        first, second = floor.demand(cost=0), floor.demand(cost=0)
        floor.publish(first, floor.offer(cost=0))
        liability = await floor.liability_of(first)
        await until_read(floor, provider)

        await node.__aexit__(None, None, None)
        floor.publish(second, floor.offer(cost=0), floor.result(liability.address))
        await until(lambda: outages(caplog, "transactions") and outages(caplog, "chain"))

        async with served(floor, port):
            await floor.liability_of(second)
            await until(lambda: provider.earnings().finalized == 1)
            last = floor.demand(cost=1, deadline=await floor.chain.block_number() + 2)
            floor.publish(last)
            await until(lambda: len(provider.book) == 1)
            await floor.mine(2)
            await until(lambda: len(provider.book) == 0)
            assert len(outages(caplog, "chain")) == 1
            assert len(outages(caplog, "transactions")) == 1
    assert floor.rejections == []


async def test_a_provider_without_eth_says_so_and_goes_on_when_it_has_some(
    floor: Floor, caplog: pytest.LogCaptureFixture
) -> None:
    await floor.found_lighthouse(timeout_blocks=1000, rival=5)
    async with floor.chain_of("rival") as rival:
        balance, price = await rival.tokens.eth_balance(), await rival.node.gas_price()
        await rival.tokens.send_eth(floor.address("person"), balance - 100_000 * price)
        async with floor.provider("rival"):
            demand = floor.demand()
            floor.publish(demand, floor.offer())
            await until(lambda: outages(caplog, "transactions") == ["insufficient-funds"])

            await floor.chain.tokens.send_eth(floor.address("rival"), balance - 10**18)

            await floor.liability_of(demand)
            assert floor.rejections == []


async def test_a_transaction_that_is_not_mined_for_long_is_waited_for(
    anvil: Anvil, router: EmbeddedRouter, caplog: pytest.LogCaptureFixture
) -> None:
    market = await deploy_market(anvil.url, anvil.private_keys)
    hasty = replace(QUICK, receipt_timeout=0.2)
    floor = Floor(market, router.endpoint, node=anvil.url, keys=anvil.private_keys)
    async with floor, floor.provider(timing=hasty) as provider:
        await floor.request("evm_setAutomine", False)
        demand = floor.demand()
        floor.publish(demand, floor.offer())
        await until(lambda: outages(caplog, "transactions") == ["transaction-timeout"])

        await floor.request("evm_setIntervalMining", 1)

        await floor.liability_of(demand)
        await until(lambda: len(provider.book) == 0)
        assert floor.rejections == []


async def test_gas_that_is_too_dear_is_waited_for_and_said_once(
    anvil: Anvil, router: EmbeddedRouter, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    market = await deploy_market(anvil.url, anvil.private_keys)
    floor = Floor(market, router.endpoint, node=anvil.url, keys=anvil.private_keys)
    async with floor, floor.provider() as provider:
        await base_fee(floor, 900 * GWEI)
        demand = floor.demand()
        floor.publish(demand, floor.offer())
        await until(lambda: outages(caplog, "transactions"))
        await asyncio.sleep(0.5)  # for some more attempts
        assert outages(caplog, "transactions") == ["fee-too-high"]

        await base_fee(floor, GWEI)

        await floor.liability_of(demand)
        await until(lambda: provider.earnings().created == 1)
        assert len(events(caplog, "transactions-recovered")) == 1
        assert floor.rejections == []


async def base_fee(floor: Floor, wei: int) -> None:
    """Have a block in which gas costs so much."""
    await floor.request("anvil_setNextBlockBaseFeePerGas", hex(wei))
    await floor.request("evm_mine")
