"""The cost of a job that nobody ends comes back by itself."""

from __future__ import annotations

import asyncio
from itertools import count
from typing import TYPE_CHECKING

import pytest

from mesh import Agent
from mesh.chain import DeploymentPlan, InsufficientFunds, Reverted
from mesh.chain.liabilities import Liabilities
from mesh.dev import EmbeddedChain
from mesh.testing import Market, MarketChain, assert_refunded
from tests.support.agent.restarts import COST, SAYING, half_way
from tests.support.log_events import logged_facts
from tests.support.market import MODEL
from tests.support.rollups import ForeignBlocks, seen_in
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.chain import Settled

REFUND_DELAY = 60

pytestmark = pytest.mark.sample("market")


@pytest.fixture(params=[EmbeddedChain, ForeignBlocks], ids=["own blocks", "blocks of another chain"])
async def market(request: pytest.FixtureRequest) -> AsyncIterator[Market]:
    plan = DeploymentPlan(timeout_blocks=10, refund_delay=REFUND_DELAY)
    async with MarketChain(plan, node=request.param()) as chain, Market(chain) as market:
        yield market


async def test_the_cost_of_a_job_that_is_never_finished_comes_back_within_two_blocks_of_its_time(
    market: Market, caplog: pytest.LogCaptureFixture
) -> None:
    person = await market.person()
    before, liabilities = await market.balance(person), person.chain.liabilities
    async with half_way(market, by=person) as (_, contract):
        assert await market.balance(person) == before - COST
        ended = asyncio.create_task(contract.outcome())
        await _mined_until_due(market, person, contract.address)
        async with asyncio.timeout(60):
            while not ended.done():
                await _mined_on(market, person)
                await asyncio.wait([ended], timeout=1.0)
        assert_refunded(await ended, code="no-result")
        due = await liabilities.refundable_from(contract.address)
        (dated,) = [one for one in await liabilities.history() if one.liability.address == contract.address]
        assert dated.ended is not None
        seen = seen_in if isinstance(market.chain.node, ForeignBlocks) else int
        first = next(block for block in count(dated.created.block_number) if seen(block) >= due)
        assert first <= dated.ended.block_number <= first + 2
    assert await market.balance(person) == before
    assert len(logged_facts(caplog, "refund-taken")) == 1


async def _mined_until_due(market: Market, person: Agent, liability: str) -> None:
    """Mine until a transaction in the next block could refund it at last."""
    liabilities = person.chain.liabilities
    refundable = await liabilities.refundable_from(liability)
    while (await liabilities.refund_state(liability)).contract_block + 1 < refundable:
        await _mined_on(market, person)


async def _mined_on(market: Market, person: Agent, *, blocks: int = 1) -> None:
    """Mine blocks one by one, each as soon as the person's agent has looked at the one before."""

    async def has_read() -> bool:
        return person.parts.chain_head.head == await person.chain.block_number()

    for _ in range(blocks):
        await market.mine()
        await until_found(has_read, what="the block")
        await asyncio.sleep(person.chain.node.timing.poll_interval)


async def test_it_also_comes_back_when_the_persons_agent_was_away_at_that_time(market: Market) -> None:
    async with market.robot(person := Agent()):
        before = await market.balance(person)
        async with half_way(market, by=person):
            assert await market.balance(person) == before - COST
    await market.mine(10 * REFUND_DELAY)
    async with market.robot(person):

        async def is_back() -> bool:
            return await market.balance(person) == before

        await until_found(is_back, what="the cost")


@pytest.mark.usefixtures("without_permits")
async def test_a_refund_that_can_not_be_paid_for_is_tried_again(
    market: Market, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    person = await market.person()
    refund, attempts = Liabilities.refund, list[str]()

    async def poor(liabilities: Liabilities, liability: str) -> Settled:
        attempts.append(liability)
        if len(attempts) == 1:
            raise InsufficientFunds(person.address, balance=0, needed=1)
        return await refund(liabilities, liability)

    monkeypatch.setattr(Liabilities, "refund", poor)
    async with half_way(market, by=person) as (_, contract):
        await _mined_until_due(market, person, contract.address)

        async def is_told() -> bool:
            await market.mine()  # what contracts count is looked at with each block
            return [one["code"] for one in logged_facts(caplog, "refund-waits")] == ["insufficient-funds"]

        await until_found(is_told, what="that the refund waits")
        await market.mine(8 * REFUND_DELAY)
        assert_refunded(await market.outcome(contract))
    assert attempts == [contract.address] * 2


@pytest.mark.usefixtures("without_permits")
async def test_a_contract_that_cost_nothing_is_left_alone(market: Market, monkeypatch: pytest.MonkeyPatch) -> None:
    refund, refunded = Liabilities.refund, list[str]()

    async def noted(liabilities: Liabilities, liability: str) -> Settled:
        refunded.append(liability)
        return await refund(liabilities, liability)

    monkeypatch.setattr(Liabilities, "refund", noted)
    async with market.robot(person := Agent()):
        async with half_way(market, by=person) as (_, contract):
            free = await market.demand(MODEL, SAYING, by=person)
            await _mined_until_due(market, person, free.address)
            await _mined_on(market, person, blocks=8)
            assert_refunded(await market.outcome(contract))
        await market.restart(person)
        await _mined_on(market, person, blocks=8)
    assert refunded == [contract.address]


@pytest.mark.usefixtures("without_permits")
async def test_a_contract_that_refuses_the_refund_is_asked_again_after_minutes(
    market: Market, monkeypatch: pytest.MonkeyPatch
) -> None:
    person, attempts = await market.person(), list[str]()

    async def refused(liabilities: Liabilities, liability: str) -> Settled:
        attempts.append(liability)
        raise Reverted("Blocked")

    monkeypatch.setattr(Liabilities, "refund", refused)
    async with half_way(market, by=person) as (_, contract):
        await _mined_until_due(market, person, contract.address)

        async def is_asked() -> bool:
            await market.mine()
            return bool(attempts)

        await until_found(is_asked, what="the attempt")
        await _mined_on(market, person, blocks=8)
    assert attempts == [contract.address]
