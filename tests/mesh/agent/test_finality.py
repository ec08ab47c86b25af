"""Whole jobs where a block counts some blocks later: the robot begins late, and the customer hears of the end late."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from mesh.agent.contracts import Outcome, WatchedContracts
from mesh.agent.ledger import Phase
from mesh.chain import Node
from mesh.dev import EmbeddedChain
from mesh.dev.development import deploy_market
from mesh.market.book import OrderStage
from mesh.role.following import ChainHead
from mesh.testing._market import TIMING
from schemas import ZERO_ADDRESS, Demand, Offer
from tests.support.agent.trades import job
from tests.support.market import ForeignChain, Place, in_phase, offering
from tests.support.nodes import Anvil
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from mesh.agent.agent import Agent
    from mesh.agent.contracts import Contract
    from mesh.agent.handlers import Job
    from mesh.chain import Dated
    from tests.support.routers import EmbeddedRouter

SLOTS = 4
LATE = {"latest": 4, "safe": SLOTS, "finalized": 2 * SLOTS}
"""Blocks after which one counts, with five confirmations or in epochs of so many slots."""


class Settling:
    """A market on anvil whose blocks count late, by one of the rules."""

    def __init__(self, place: Place, late: int) -> None:
        self.place, self.late = place, late
        self.node = place.chains["provider"].node
        self.played: list[str] = []

    def robot(self) -> Agent:
        robot = offering(self.place.agent("robot"))

        @robot.on("/go")
        async def go(current: Job, message: Any) -> None:
            self.played.append(current.liability.address)

        return robot

    async def mine(self, blocks: int) -> None:
        for _ in range(blocks):
            await self.node.request("evm_mine")
            await asyncio.sleep(2 * TIMING.poll_interval)

    async def mine_until_one_before(self, block: int) -> None:
        """Mine until what happened in a block counts with the next one."""
        await self.mine(block + self.late - 1 - await self.node.block_number())

    async def mine_until(self, condition: Callable[[], object]) -> None:
        """Mine block after block, as chains do: a node is asked for its final block at times only, with a new block."""
        async with asyncio.timeout(30):
            while not condition():
                await self.mine(1)

    async def dated(self, contract: Contract) -> Dated:
        """When it was created, and has ended."""
        found = await self.place.chains["person"].liabilities.history()
        return next(one for one in found if one.liability.address == contract.address)

    async def ended_in(self, contract: Contract) -> int:
        """The block in which it has ended; waits for that."""

        async def ended() -> int:
            end = (await self.dated(contract)).ended
            return 0 if end is None else end.block_number

        return await until_found(ended, what="the contract has ended on the chain")


@pytest.fixture(params=["latest", "safe", "finalized"])
async def market(request: Any, router: EmbeddedRouter, tmp_path: Path) -> AsyncIterator[Settling]:
    finality: Any = request.param
    async with Anvil(arguments=("--slots-in-an-epoch", str(SLOTS))) as anvil:
        made = await deploy_market(anvil.url, anvil.private_keys)
        async with made.chain(anvil.url, "person") as chain:  # nothing mines the confirmations of a demand's own
            await chain.tokens.approve(chain.factory, 10**9)
        timing = replace(TIMING, finality=finality, confirmations=5 if finality == "latest" else 1)
        async with Place(ForeignChain(anvil, made), router.endpoint, tmp_path, node=anvil.url, timing=timing) as place:
            yield Settling(place, LATE[finality])


async def test_a_robot_begins_and_a_customer_hears_of_the_end_when_the_blocks_count(market: Settling) -> None:
    place = market.place
    async with place.provider(seconds=60), market.robot() as robot, place.agent("person") as person:
        contract = await person.demand(job(place), cost=7)
        outcome = asyncio.create_task(contract.outcome())
        await market.mine_until_one_before((await market.dated(contract)).created.block_number)
        await in_phase(robot, contract, Phase.INCOMING)
        assert market.played == []
        await market.mine_until(lambda: market.played == [contract.address])
        ended = await market.ended_in(contract)
        await market.mine_until_one_before(ended)
        assert not outcome.done()
        await market.mine_until(outcome.done)
        assert (await outcome).success


async def test_a_restarted_robot_still_waits_for_the_block(market: Settling) -> None:
    place = market.place
    async with place.provider(seconds=60), place.agent("person") as person:
        async with market.robot() as robot:
            contract = await person.demand(job(place), cost=7)
            await in_phase(robot, contract, Phase.INCOMING)
        async with market.robot() as robot:
            await market.mine_until_one_before((await market.dated(contract)).created.block_number)
            await in_phase(robot, contract, Phase.INCOMING)
            assert market.played == []
            await market.mine_until(lambda: market.played == [contract.address])


async def test_an_end_that_is_taken_back_before_it_counts_is_not_told(market: Settling) -> None:
    place = market.place
    async with market.robot(), place.agent("person") as person:
        async with place.provider(seconds=60):
            contract = await person.demand(job(place), cost=7)
            outcome = asyncio.create_task(contract.outcome())
            await market.mine(market.late + 1)
            ended = await market.ended_in(contract)
        await market.node.request("anvil_reorg", await market.node.block_number() - ended + 1, [])
        await market.mine(2 * market.late)
        assert (await market.dated(contract)).ended is None, "nobody sends it again"
        assert not outcome.done()
        async with place.provider(seconds=60):
            await market.mine_until_one_before(await market.ended_in(contract))
            assert not outcome.done()
            await market.mine_until(outcome.done)
            assert (await outcome).success


async def test_a_provider_is_done_with_orders_when_the_block_of_their_contract_counts(market: Settling) -> None:
    place = market.place
    async with place.provider(seconds=60) as provider, market.robot(), place.agent("person") as person:
        contract = await person.demand(job(place), cost=7)

        def stages() -> set[OrderStage]:
            records = provider.orders._records.values()
            return {one.state for one in records if isinstance(one.verified.message, Demand | Offer)}

        created = (await market.dated(contract)).created.block_number
        await market.mine_until_one_before(created)
        assert OrderStage.CONFIRMED not in stages()
        await market.mine_until(lambda: stages() == {OrderStage.CONFIRMED})


async def test_an_end_counts_only_as_far_as_the_agent_has_read_the_chain() -> None:
    """The node's latest blocks may be of a chain that the agent has not seen yet, on which the contract is open."""
    async with EmbeddedChain() as chain, Node(chain.provider, timing=replace(TIMING, confirmations=3)) as node:
        await chain.mine(20)
        head = ChainHead(5)
        parts: Any = SimpleNamespace(chain=SimpleNamespace(node=node), chain_head=head)
        contracts = WatchedContracts(parts, cast("Any", None))
        ended = contracts._watch(ZERO_ADDRESS).ended
        contracts.finalized(ZERO_ADDRESS, Outcome(success=True, result=""), 5)
        for read in (5, 6):
            head.advance_to(read)
            await contracts.settle()
            assert not ended.done()
        head.advance_to(7)
        await contracts.settle()
        assert ended.result().success
