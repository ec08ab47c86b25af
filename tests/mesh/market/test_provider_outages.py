"""A provider whose node fails, is away, or does not mine; and a provider without ETH."""

from __future__ import annotations

import asyncio
import math
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from mesh.base.retry import RetryPolicy
from mesh.chain import GWEI
from mesh.dev import JsonRpcServer
from mesh.dev.development import deploy_market
from schemas import cid_of_bytes, parse_cid
from tests.support.ports import free_port
from tests.support.provider.local_market import QUICK, LocalMarket
from tests.support.provider.observation import events, outages, until_read, works_on
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter


@asynccontextmanager
async def served(local: LocalMarket, port: int) -> AsyncIterator[str]:
    assert not isinstance(local.node, str)
    async with JsonRpcServer(local.node, port=port) as server:
        yield server.url


class FailingNode:
    """The market's node; its gas estimates of calls that contain `data` fail `times` times, as `fails` says."""

    def __init__(self, local: LocalMarket, data: bytes, *, times: float = math.inf, fails: str = "silence") -> None:
        assert not isinstance(local.node, str)
        self._node, self._data, self._fails = local.node, data.hex(), fails
        self.left = times

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_estimateGas" and self._data in params[0]["data"] and self.left > 0:
            self.left -= 1
            if self._fails == "silence":
                raise ConnectionResetError
            return {"jsonrpc": "2.0", "id": 1, "error": {"code": -32600, "message": "not allowed for this customer"}}
        return await self._node.make_request(method, params)


@pytest.mark.parametrize("fails", ["silence", "refusal"])
async def test_temporary_failures_of_the_node_lose_no_order_and_no_result(local: LocalMarket, fails: str) -> None:
    node = FailingNode(local, b"", times=3, fails=fails)
    async with local.provider(endpoint=node) as provider:
        demand = local.demand()
        local.publish(demand, local.offer())
        liability = await local.liability_of(demand)
        assert node.left == 0

        node.left = 3
        local.publish(local.result(liability.address))
        await until(lambda: provider.earnings().finalized == 1)
        assert node.left == 0
    assert local.rejections == []


@pytest.mark.parametrize("fails", ["silence", "refusal"])
async def test_others_go_first_while_a_transaction_waits_that_the_node_refuses(local: LocalMarket, fails: str) -> None:
    objective = cid_of_bytes(fails.encode())
    node, retry = FailingNode(local, parse_cid(objective), fails=fails), RetryPolicy(initial=3600.0, ceiling=3600.0)
    async with local.provider(endpoint=node, retry=retry) as provider:
        bad, offer = (make(cost=0, objective=objective) for make in (local.demand, local.offer))
        local.publish(bad, offer)
        assert await works_on(local, provider)
        assert local.rejections == []


@pytest.mark.parametrize("fails", ["silence", "refusal"])
async def test_a_transaction_that_the_node_refuses_is_rejected_after_the_last_attempt(
    local: LocalMarket, fails: str
) -> None:
    objective = cid_of_bytes(fails.encode())
    async with local.provider(endpoint=FailingNode(local, parse_cid(objective), fails=fails)):
        local.publish(*(make(cost=0, objective=objective) for make in (local.demand, local.offer)))
        await until(lambda: len(local.rejections) == 2)
        assert {one.reason for one in local.rejections} == {
            "NodeUnreachable" if fails == "silence" else "RequestRefused"
        }


async def test_an_outage_of_the_node_loses_no_order_and_no_result(
    local: LocalMarket, caplog: pytest.LogCaptureFixture
) -> None:
    port = free_port()
    node = served(local, port)
    async with local.provider(endpoint=await node.__aenter__()) as provider:
        first, second = local.demand(cost=0), local.demand(cost=0)
        local.publish(first, local.offer(cost=0))
        liability = await local.liability_of(first)
        await until_read(local, provider)

        await node.__aexit__(None, None, None)
        local.publish(second, local.offer(cost=0), local.result(liability.address))
        await until(lambda: outages(caplog, "transactions") and outages(caplog, "chain"))

        async with served(local, port):
            await local.liability_of(second)
            await until(lambda: provider.earnings().finalized == 1)
            last = local.demand(cost=0, deadline=await local.chain.block_number() + 2)
            local.publish(last)
            await until(lambda: len(provider.book) == 1)
            await local.mine(2)
            await until(lambda: len(provider.book) == 0)
            assert len(outages(caplog, "chain")) == 1
            assert len(outages(caplog, "transactions")) == 1
    assert local.rejections == []


async def test_a_provider_without_eth_logs_it_and_goes_on_when_it_has_some(
    local: LocalMarket, caplog: pytest.LogCaptureFixture
) -> None:
    await local.create_lighthouse(timeout_blocks=1000, rival=5)
    async with local.chain_of("rival") as rival:
        balance, price = await rival.tokens.eth_balance(), await rival.node.gas_price()
        await rival.tokens.send_eth(local.address("person"), balance - 100_000 * price)
        async with local.provider("rival"):
            demand = local.demand()
            local.publish(demand, local.offer())
            await until(lambda: outages(caplog, "transactions") == ["insufficient-funds"])

            await local.chain.tokens.send_eth(local.address("rival"), balance - 10**18)

            await local.liability_of(demand)
            assert local.rejections == []


async def test_a_transaction_that_is_not_mined_in_time_is_sent_again(
    anvil: Anvil, router: EmbeddedRouter, caplog: pytest.LogCaptureFixture
) -> None:
    market = await deploy_market(anvil.url, anvil.private_keys)
    hasty = replace(QUICK, receipt_timeout=0.2)
    local = LocalMarket(market, router.endpoint, node=anvil.url, keys=anvil.private_keys)
    async with local, local.provider(timing=hasty) as provider:
        await local.request("evm_setAutomine", False)
        demand = local.demand()
        local.publish(demand, local.offer())
        await until(lambda: outages(caplog, "transactions") == ["transaction-timeout"])

        await local.request("evm_setIntervalMining", 1)

        await local.liability_of(demand)
        await until(lambda: len(provider.book) == 0)
        assert local.rejections == []


async def test_a_transaction_waits_for_cheaper_gas_and_logs_it_once(
    anvil: Anvil, router: EmbeddedRouter, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    market = await deploy_market(anvil.url, anvil.private_keys)
    local = LocalMarket(market, router.endpoint, node=anvil.url, keys=anvil.private_keys)
    async with local, local.provider() as provider:
        await base_fee(local, 900 * GWEI)
        demand = local.demand()
        local.publish(demand, local.offer())
        await until(lambda: "fee-too-high" in outages(caplog, "transactions"))
        await asyncio.sleep(0.5)  # for some more attempts
        assert outages(caplog, "transactions").count("fee-too-high") == 1

        await base_fee(local, GWEI)

        await local.liability_of(demand)
        await until(lambda: provider.earnings().created == 1)
        assert len(events(caplog, "transactions-recovered")) == 1
        assert local.rejections == []


async def base_fee(local: LocalMarket, wei: int) -> None:
    """Mine a block with this base fee."""
    await local.request("anvil_setNextBlockBaseFeePerGas", hex(wei))
    await local.request("evm_mine")
