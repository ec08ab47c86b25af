"""Whole jobs with a validator on the original contracts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

import pytest

from mesh.chain import XRT, Account, Node
from mesh.dev import EmbeddedChain
from mesh.dev.development import ROLES, DevelopmentMarket
from mesh.testing._market import TIMING
from tests.support.log_events import logged_facts
from tests.support.market import ForeignChain, Place
from tests.support.objectives import objective
from tests.support.originals import NEEDS_ORIGINALS, Originals
from tests.support.validator.courts import FEE, PRICE, Court, claim, liar, reports_on
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.agent.agent import Agent
    from mesh.agent.contracts import Contract
    from mesh.validator.validator import Validator
    from tests.support.routers import EmbeddedRouter

EACH: Final = 100 * XRT
"""What person and robot start with, and the provider stakes, wn."""
TIMEOUT: Final = 100
"""Of the lighthouse's turns, blocks."""

pytestmark = NEEDS_ORIGINALS


async def found(node: EmbeddedChain, generation: Literal[3, 5]) -> ForeignChain:
    """The original contracts with a market on them."""
    accounts = dict(zip(ROLES, map(Account, node.funded_keys), strict=False))
    async with Node(node.provider, timing=TIMING) as open_node:
        originals = Originals(open_node, accounts["provider"], generation)
        await originals.deploy(timeout_blocks=TIMEOUT)
    market = DevelopmentMarket(deployment=originals.deployment, accounts=accounts)
    return ForeignChain(node, market, "original", generation)


async def supply(place: Place) -> None:
    """Give the roles their tokens and the provider its stake."""
    chain, lighthouse = place.chains["provider"], place.market.deployment.lighthouse
    for role in ("robot", "person"):
        await chain.tokens.transfer(place.address(role), EACH)
    await chain.tokens.approve(lighthouse, EACH)
    await chain.lighthouses.refill(lighthouse, EACH)
    await place.node.mine(TIMEOUT + 1)  # the first turn begins after the lighthouse's first silence


@pytest.fixture(params=[3, 5])
async def court(request: pytest.FixtureRequest, router: EmbeddedRouter, tmp_path: Path) -> AsyncIterator[Court]:
    generation = request.param
    async with (
        EmbeddedChain() as node,
        Place(await found(node, generation), router.endpoint, tmp_path) as place,
        Court(place, generation) as open_court,
    ):
        await supply(place)
        yield open_court


async def judge(court: Court) -> tuple[Validator, str]:
    """A validator, and the address by which orders name it."""
    if court.generation == 5:
        jury = await court.jury(0)
        return await court.validator(0, jury), jury
    validator = await court.validator()
    await (await court.chain(court.account())).tokens.approve(court.place.address("person"), 0)  # known to the chain
    return validator, court.account().address


async def hand_in_undone_work(court: Court, person: Agent, robot: Agent, validator: str) -> Contract:
    """A contract for which the robot hands in a recording that does not show the work."""
    contract = await court.demand(person, validator)
    await claim(robot, contract, await robot.add(court.place.save(objective(("/go", "nowhere")), "lie.mcap")))
    return contract


async def test_a_validated_job_is_paid(court: Court) -> None:
    place = court.place
    (validator, named), robot = await judge(court), await court.robot()
    async with court.at_work(validator, robot) as person:
        tokens = place.chains["person"].tokens
        before, earned = await place.balance("robot"), await tokens.balance(named)
        contract = await court.demand(person, named)
        assert (await contract.outcome()).success
        assert await place.balance("robot") == before + PRICE
        assert await tokens.balance(named) >= earned + FEE  # generation 3 mints the finalizer's reward, too
        assert [report.success for report in await reports_on(person, contract)] == [True]


@pytest.mark.parametrize("court", [5], indirect=True)
async def test_undone_work_is_refunded(court: Court) -> None:
    (validator, named), robot = await judge(court), await liar(court)
    async with court.at_work(validator, robot) as person:
        before = await court.place.balance("person")
        contract = await hand_in_undone_work(court, person, robot, named)
        assert not (await contract.outcome()).success
        assert await court.place.balance("person") == before - FEE


@pytest.mark.parametrize("court", [3], indirect=True)
async def test_undone_work_is_not_paid_where_a_refusal_would_pay_it(
    court: Court, caplog: pytest.LogCaptureFixture
) -> None:
    """These contracts pay by the robot's word, whatever their validator says: it says nothing to them."""
    (validator, named), robot = await judge(court), await liar(court)
    async with court.at_work(validator, robot) as person:
        before = await court.place.balance("robot")
        contract = await hand_in_undone_work(court, person, robot, named)
        (report,) = await until_found(lambda: reports_on(person, contract), what="the report")
        assert not report.success

        async def waits() -> bool:
            return any(facts["code"] == "not-offered" for facts in logged_facts(caplog, "verdict-waits"))

        await until_found(waits, what="the log of the withheld verdict")
        assert not (await court.place.chains["person"].liabilities.get(contract.address)).is_finalized
        assert await court.place.balance("robot") == before


@pytest.mark.parametrize("court", [3], indirect=True)
async def test_a_claim_of_failure_is_refunded(court: Court) -> None:
    (validator, named), robot = await judge(court), await liar(court)
    async with court.at_work(validator, robot) as person:
        before = await court.place.balance("person")
        contract = await court.demand(person, named)
        await claim(robot, contract, contract.liability.objective, success=False)
        assert not (await contract.outcome()).success
        assert await court.place.balance("person") == before - FEE
