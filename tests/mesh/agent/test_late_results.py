"""Results that no provider brings to the chain."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from mesh.agent._runtime import SOON
from mesh.agent.ledger import Phase
from mesh.chain import DeploymentPlan, Reverted
from mesh.chain.liabilities import Liabilities
from mesh.role.following import ChainHead
from mesh.testing import MarketChain
from tests.support.agent.restarts import COST, SAYING, made_by_a_provider_that_leaves, speaking
from tests.support.log_events import logged_facts
from tests.support.market import Place, in_phase, offering
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.agent.agent import Agent
    from mesh.chain import Settled
    from schemas import Result
    from tests.support.routers import EmbeddedRouter

REFUND_DELAY = 200


@pytest.fixture
async def place(router: EmbeddedRouter, tmp_path: Path) -> AsyncIterator[Place]:
    """A market whose liabilities can be refunded soon."""
    plan = DeploymentPlan(timeout_blocks=100, refund_delay=REFUND_DELAY)
    async with MarketChain(plan) as chain, Place(chain, router.endpoint, tmp_path) as place:
        yield place


async def test_a_robot_brings_its_own_result_before_the_refund_if_no_provider_does(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    before = await place.balance("robot")
    async with place.agent("person") as person, speaking(offering(place.agent("robot")), []) as robot:
        contract = await made_by_a_provider_that_leaves(place, person, robot)
        await in_phase(robot, contract, Phase.COMPLETE)
        await _deadline_known(robot, place)
        liabilities = place.chains["person"].liabilities
        refundable = await liabilities.refundable_from(contract.address)
        head = await place.chains["person"].block_number()
        await place.node.mine((refundable - head) // 2)
        await until_found(lambda: _has_read(robot, place), what="half of the time read")
        assert not (await liabilities.get(contract.address)).is_finalized, "a provider may still come"
        await place.node.mine((refundable - head) // 3)
        async with asyncio.timeout(60):
            assert (await contract.outcome()).success
        await in_phase(robot, contract, Phase.FINALIZED)
        assert await place.chains["person"].block_number() < refundable
    assert await place.balance("robot") == before + COST
    assert "late-result-finalized" in [getattr(record, "event", "") for record in caplog.records]


async def test_a_robot_that_begins_after_a_newer_block_than_it_opened_at_waits_for_the_next_one() -> None:
    """Else its loop over late results runs without a pause until that block comes."""
    head = ChainHead(33)
    head.begin_after(34)
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.05):
            await head.reached(head.head + 1)
    head.advance_to(35)
    async with asyncio.timeout(60):
        await head.reached(head.head)


async def _deadline_known(robot: Agent, place: Place) -> None:
    """Mine until the robot has asked the chain when its result is late: some blocks after it has seen the result."""
    asked: list[str] = []
    refundable_from = Liabilities.refundable_from

    async def noted(liabilities: Liabilities, liability: str) -> int:
        block = await refundable_from(liabilities, liability)
        asked.append(liability)
        return block

    async def is_known() -> bool:
        await place.node.mine(1)
        await until_found(lambda: _has_read(robot, place), what="the next block read")
        return bool(asked)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Liabilities, "refundable_from", noted)
        await until_found(is_known, what="the block at which the result is late")


async def _has_read(robot: Agent, place: Place) -> bool:
    return robot.parts.chain_head.head == await place.chains["person"].block_number()


async def test_the_parties_of_a_silent_validator_are_told_and_the_cost_is_refunded(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    async with place.agent("person") as person, speaking(offering(place.agent("robot")), []) as robot:
        async with place.provider():
            silent = place.address("provider")
            contract = await person.demand(SAYING, cost=COST, validator=silent, validator_fee=0)
        await in_phase(robot, contract, Phase.COMPLETE)
        await _deadline_known(robot, place)
        refundable = await place.chains["person"].liabilities.refundable_from(contract.address)
        await place.node.mine(refundable - await place.chains["person"].block_number() - 2)
        await until(lambda: [one["code"] for one in logged_facts(caplog, "verdict-late")] == ["NotTheValidator"])
        await place.node.mine(2)
        await place.chains["person"].liabilities.refund(contract.address)
        outcome = await contract.outcome()
        assert (outcome.success, outcome.code, outcome.reports) == (False, "no-result", ())
        assert "no verdict of the validator" in outcome.reason


async def test_a_result_is_brought_again_if_a_pending_transaction_was_in_its_way(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    finalize, attempts = Liabilities.finalize_without_turn, list[int]()

    async def finalized(liabilities: Liabilities, result: Result) -> Settled:
        attempts.append(await place.chains["person"].block_number())
        if len(attempts) == 1:  # by a provider's transaction, which is dropped later
            raise Reverted("AlreadyFinalized")
        return await finalize(liabilities, result)

    monkeypatch.setattr(Liabilities, "finalize_without_turn", finalized)
    async with place.agent("person") as person, speaking(offering(place.agent("robot")), []) as robot:
        contract = await made_by_a_provider_that_leaves(place, person, robot)
        await in_phase(robot, contract, Phase.COMPLETE)
        await _deadline_known(robot, place)
        refundable = await place.chains["person"].liabilities.refundable_from(contract.address)
        await place.node.mine((refundable - await place.chains["person"].block_number()) * 5 // 6)
        await until(lambda: attempts)
        await place.node.mine(SOON)
        async with asyncio.timeout(60):
            assert (await contract.outcome()).success
    assert len(attempts) == 2
