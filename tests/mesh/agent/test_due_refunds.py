"""The cost of a job that nobody ends comes back by itself."""

from __future__ import annotations

import asyncio
from itertools import count
from typing import TYPE_CHECKING

import pytest

from mesh.chain import DeploymentPlan, InsufficientFunds, Reverted
from mesh.chain.liabilities import Liabilities
from mesh.dev import EmbeddedChain
from mesh.testing import MarketChain
from tests.mesh.agent.restarts import COST, half_way, words
from tests.support.log_events import logged_facts
from tests.support.market import Place
from tests.support.rollups import ForeignBlocks, seen_in
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.agent.agent import Agent
    from mesh.chain import Settled
    from tests.support.routers import EmbeddedRouter

REFUND_DELAY = 60


@pytest.fixture(params=[EmbeddedChain, ForeignBlocks], ids=["own blocks", "blocks of another chain"])
async def place(request: pytest.FixtureRequest, router: EmbeddedRouter, tmp_path: Path) -> AsyncIterator[Place]:
    plan = DeploymentPlan(timeout_blocks=10, refund_delay=REFUND_DELAY)
    async with MarketChain(plan, node=request.param()) as chain, Place(chain, router.endpoint, tmp_path) as place:
        yield place


async def test_the_cost_of_a_job_that_is_never_finished_comes_back_within_two_blocks_of_its_time(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    before, chain = await place.balance("person"), place.chains["person"]
    async with half_way(place) as (_robot, person, contract):
        assert await place.balance("person") == before - COST
        ended = asyncio.create_task(contract.outcome())
        await _mined_until_due(place, person, contract.address)
        async with asyncio.timeout(60):
            while not ended.done():
                await place.node.mine(1)
                await until_found(lambda: _has_read(person, place), what="the block")
                await asyncio.wait([ended], timeout=1.0)
        outcome, due = await ended, await chain.liabilities.refundable_from(contract.address)
        assert (outcome.success, outcome.code) == (False, "no-result")
        (dated,) = [one for one in await chain.liabilities.history() if one.liability.address == contract.address]
        assert dated.ended is not None
        seen = seen_in if isinstance(place.node, ForeignBlocks) else int
        first = next(block for block in count(dated.created.block_number) if seen(block) >= due)
        assert first <= dated.ended.block_number <= first + 2
    assert await place.balance("person") == before
    assert len(logged_facts(caplog, "refund-taken")) == 1


async def _mined_until_due(place: Place, person: Agent, liability: str) -> None:
    """Mine until a transaction in the next block could refund it at last."""
    liabilities, poll = place.chains["person"].liabilities, place.chains["person"].node.timing.poll_interval
    refundable = await liabilities.refundable_from(liability)
    while (await liabilities.refund_state(liability)).contract_block + 1 < refundable:
        await place.node.mine(1)
        await until_found(lambda: _has_read(person, place), what="the block")
        await asyncio.sleep(poll)


async def _mined_on(place: Place, person: Agent, *, blocks: int) -> None:
    for _ in range(blocks):
        await place.node.mine(1)
        await until_found(lambda: _has_read(person, place), what="the block")
        await asyncio.sleep(place.chains["person"].node.timing.poll_interval)


async def _has_read(agent: Agent, place: Place) -> bool:
    return agent.parts.chain_head.head == await place.chains["person"].block_number()


async def test_it_also_comes_back_when_the_persons_agent_was_away_at_that_time(place: Place) -> None:
    before = await place.balance("person")
    async with half_way(place):
        assert await place.balance("person") == before - COST
    await place.node.mine(10 * REFUND_DELAY)
    async with place.agent("person"):

        async def is_back() -> bool:
            return await place.balance("person") == before

        await until_found(is_back, what="the cost")


@pytest.mark.usefixtures("without_permits")
async def test_a_refund_that_can_not_be_paid_for_is_tried_again(
    place: Place, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    refund, attempts = Liabilities.refund, list[str]()

    async def poor(liabilities: Liabilities, liability: str) -> Settled:
        attempts.append(liability)
        if len(attempts) == 1:
            raise InsufficientFunds(place.address("person"), balance=0, needed=1)
        return await refund(liabilities, liability)

    monkeypatch.setattr(Liabilities, "refund", poor)
    async with half_way(place) as (_robot, person, contract):
        await _mined_until_due(place, person, contract.address)

        async def is_told() -> bool:
            await place.node.mine(1)  # what contracts count is looked at with each block
            return [one["code"] for one in logged_facts(caplog, "refund-waits")] == ["insufficient-funds"]

        await until_found(is_told, what="that the refund waits")
        await place.node.mine(8 * REFUND_DELAY)
        async with asyncio.timeout(60):
            assert not (await contract.outcome()).success
    assert attempts == [contract.address] * 2


@pytest.mark.usefixtures("without_permits")
async def test_a_contract_that_cost_nothing_is_left_alone(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    refund, refunded = Liabilities.refund, list[str]()

    async def noted(liabilities: Liabilities, liability: str) -> Settled:
        refunded.append(liability)
        return await refund(liabilities, liability)

    monkeypatch.setattr(Liabilities, "refund", noted)
    async with half_way(place) as (_robot, person, contract):
        free = await person.demand(words(place), cost=0)
        await _mined_until_due(place, person, free.address)
        await _mined_on(place, person, blocks=8)
        async with asyncio.timeout(60):
            assert not (await contract.outcome()).success
    async with place.agent("person") as person:
        await _mined_on(place, person, blocks=8)
    assert refunded == [contract.address]


@pytest.mark.usefixtures("without_permits")
async def test_a_contract_that_refuses_the_refund_is_asked_again_after_minutes(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts = list[str]()

    async def refused(liabilities: Liabilities, liability: str) -> Settled:
        attempts.append(liability)
        raise Reverted("Blocked")

    monkeypatch.setattr(Liabilities, "refund", refused)
    async with half_way(place) as (_robot, person, contract):
        await _mined_until_due(place, person, contract.address)

        async def is_asked() -> bool:
            await place.node.mine(1)
            return bool(attempts)

        await until_found(is_asked, what="the attempt")
        await _mined_on(place, person, blocks=8)
    assert attempts == [contract.address]
