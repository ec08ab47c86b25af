"""Chains whose contracts count another chain's blocks, as Arbitrum's do: deadlines, refunds, whole jobs."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.orders import OrderExpired
from mesh.chain import DeploymentPlan, Node, Reverted
from mesh.chain._node import RUN_NUMBER
from mesh.dev import EmbeddedChain
from mesh.testing import MarketChain
from tests.support.agent.restarts import COST, SAYING, made_by_a_provider_that_leaves, speaking
from tests.support.market import Place, offering
from tests.support.rollups import FIRST, ForeignBlocks, seen_in
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter

REFUND_DELAY = 40


@pytest.fixture
async def place(router: EmbeddedRouter, tmp_path: Path) -> AsyncIterator[Place]:
    plan = DeploymentPlan(timeout_blocks=10, refund_delay=REFUND_DELAY)
    async with MarketChain(plan, node=ForeignBlocks()) as chain, Place(chain, router.endpoint, tmp_path) as place:
        yield place


class Counted:
    """The way to a node, which counts how often NUMBER is asked for."""

    def __init__(self, node: EmbeddedChain) -> None:
        self._node = node
        self.asked: Counter[str] = Counter()

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_call" and params[0].get("data") == "0x" + RUN_NUMBER.hex():
            self.asked["number"] += 1
        return await self._node.provider.make_request(method, params)


async def test_a_chains_own_blocks_are_asked_for_once() -> None:
    async with EmbeddedChain() as chain:
        line = Counted(chain)
        async with Node(line) as node:
            for _ in range(5):
                assert await node.contract_block() == await node.block_number()
                await chain.mine(3)
            assert await node.contract_blocks.last(7) == 7
        assert line.asked["number"] == 1


async def test_the_blocks_of_another_chain_are_as_contracts_see_them_and_a_bit_old_at_most() -> None:
    async with ForeignBlocks() as chain:
        line = Counted(chain)
        async with Node(line) as node:
            assert await node.contract_block() == seen_in(1) - 1
            assert await node.contract_blocks.last(10_000_000) == seen_in(1) - 1
            assert line.asked["number"] == 2, "not again within a poll interval"
            await chain.mine(100)

            async def has_moved() -> bool:
                return await node.contract_block() == seen_in(101) - 1

            await until_found(has_moved, what="the numbers after 100 blocks")
            assert await node.contract_blocks.seconds(100) == 12.0
            assert not await node.contract_blocks.are_own()


@pytest.mark.parametrize("answer", [{"error": {"code": -32602, "message": "missing to"}}, {"result": "0x"}])
async def test_a_node_that_runs_no_such_code_is_taken_to_count_its_own_blocks(answer: dict[str, Any]) -> None:
    async with EmbeddedChain() as chain:

        class Unable(Counted):
            async def make_request(self, method: str, params: Any) -> Any:
                response = await super().make_request(method, params)
                return {"jsonrpc": "2.0", "id": 0} | answer if method == "eth_call" else response

        line = Unable(chain)
        async with Node(line) as node:
            await chain.mine(1)
            for _ in range(3):
                assert await node.contract_block() == 1
        assert line.asked["number"] == 1


async def test_a_whole_job_is_done_and_orders_expire_by_the_blocks_that_contracts_see(place: Place) -> None:
    before, chain = await place.balance("robot"), place.chains["person"]
    async with place.agent("person") as person:
        async with speaking(offering(place.agent("robot")), []) as robot, place.provider():
            contract = await person.demand(SAYING, cost=COST)
            async with asyncio.timeout(60):
                assert (await contract.outcome()).success
            assert robot.parts.chain_head.contract_block > FIRST > robot.parts.chain_head.head
        order = await person.order(SAYING, cost=COST, lifetime=20)
        assert FIRST < order.deadline <= seen_in(await chain.block_number()) + 20
        ended = asyncio.create_task(order.contract())
        while seen_in(await chain.block_number() + 1) <= order.deadline:
            assert not ended.done(), "a provider may still use it"
            await place.node.mine(1)
            await until_found(lambda: _has_read(person, place), what="the block")
        async with asyncio.timeout(60):
            while not ended.done():  # the number that contracts see may be a bit old, until another block comes
                await place.node.mine(1)
                await asyncio.sleep(chain.node.timing.poll_interval)
        with pytest.raises(OrderExpired):
            await ended
    assert await place.balance("robot") == before + COST


async def _has_read(agent: Any, place: Place) -> bool:
    return bool(agent.parts.chain_head.head == await place.chains["person"].block_number())


async def test_a_refund_is_possible_when_the_contracts_say_so(place: Place) -> None:
    before = await place.balance("person")
    async with place.agent("person") as person, speaking(offering(place.agent("robot")), []) as robot:
        contract = await made_by_a_provider_that_leaves(place, person, robot)
        liabilities = place.chains["provider"].liabilities
    refundable = await liabilities.refundable_from(contract.address)
    assert refundable > FIRST
    refused = 0
    while not (await liabilities.refund_state(contract.address)).is_refundable:
        with pytest.raises(Reverted) as early:
            await liabilities.refund(contract.address)
        assert early.value.reason == "RefundTooEarly"
        refused += 1
        await place.node.mine(1)
        await asyncio.sleep(place.chains["provider"].node.timing.poll_interval)
    assert refused > REFUND_DELAY
    await liabilities.refund(contract.address)
    assert await place.balance("person") == before
