"""What an owner changes while the robot runs: price, customers, whether it takes jobs; and stops and releases."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh import Agent, Settings
from mesh.agent.hiring import DemandDeclined
from mesh.amounts import InvalidAmount
from mesh.errors import AiraError
from mesh.network import call
from mesh.role.local_stop import control_here, hold_all, release, stop_folder
from mesh.testing import assert_paid
from schemas import cid_of_bytes
from schemas.errors import InvalidAddress
from schemas.records import ControlRobot, RobotControl
from tests.mesh.agent.test_own_model import Move, driving, file
from tests.support.agent.restarts import half_way
from tests.support.market import MODEL, offering
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.testing import Market

__all__ = ["file"]

STRANGER = "0x000000000000000000000000000000000000bEEF"
WORK = [("/drive", Move(1.0))]


def robot_at(model: Path | str = MODEL, **options: Any) -> Agent:
    """A robot that takes all jobs."""
    return driving(offering(Agent(model, settings=Settings(**options))))


async def declined(market: Market, robot: Agent, **terms: Any) -> str:
    """Why a robot declines a demand that is for it alone."""
    with pytest.raises(DemandDeclined) as caught:
        await market.demand(robot, WORK, **terms)
    return str(caught.value)


async def test_what_an_owner_changes_decides_at_once_and_after_a_restart(market: Market, file: Path) -> None:
    person = await market.person()
    async with market.robot(robot_at(file, refuse=(STRANGER,))) as robot:
        before = RobotControl(price="5 XRT", paused=False, refuse=(STRANGER,), least_price="", held=False)
        assert await robot.control() == before
        changed = await robot.control(price="6.50", least_price="2", refuse=(person.address.lower(),))
        assert (changed.price, changed.least_price, changed.refuse) == ("6.5 XRT", "2 XRT", (person.address,))
        assert "this customer" in await declined(market, robot, by=person, cost="2")
        await market.restart(robot)
        assert await robot.control() == changed
        assert (await robot.runtime.profile.present()).price == "6.5 XRT"
        await robot.control(refuse=())
        assert "at least 2 XRT" in await declined(market, robot, by=person, cost=1)
        (quote,) = await person.quotes(robot.model, WORK, timeout=20)
        assert (quote.cost, quote.code) == (6_500_000_000, "")
        assert (await robot.control(price="")).price == "5 XRT"
        assert_paid(await market.order(robot, WORK, by=person, cost="2"))


async def test_a_paused_robot_takes_no_job_until_it_takes_jobs_again(market: Market) -> None:
    person, objective = await market.person(), cid_of_bytes(b"anything")
    async with market.robot(robot_at()) as robot:
        offer = await robot.offer(objective=objective, cost=1)
        assert [order.hash for order in robot.orders()] == [offer]
        await robot.control(paused=True)
        assert not robot.orders(), "its open offers are withdrawn"
        assert "paused" in await declined(market, robot, cost=1)
        with raises_with(AiraError, code="declined", match="paused"):
            await robot.offer(objective=objective, cost=1)
        (quote,) = await person.quotes(robot.model, WORK, timeout=20)
        assert quote.code == "paused"
        waits = asyncio.create_task(person.demand(WORK, model=robot.model, cost=1, wait=True))
        await robot.control(paused=False)
        assert_paid(await market.outcome(await waits))


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"price": "a lot"}, InvalidAmount),
        ({"least_price": "1e9"}, InvalidAmount),
        ({"refuse": ("Bob",)}, InvalidAddress),
    ],
)
async def test_a_change_that_is_none_changes_nothing(market: Market, wrong: Any, error: type[AiraError]) -> None:
    async with market.robot(robot_at()) as robot:
        before = await robot.control()
        with pytest.raises(error):
            await robot.control(paused=True, **wrong)
        assert await robot.control() == before


async def test_a_robot_that_its_owner_stops_ends_its_job_and_begins_none_until_it_is_released(market: Market) -> None:
    async with half_way(market) as (robot, contract):
        folder = stop_folder(robot.settings)
        stopped = await asyncio.to_thread(control_here, folder, robot.address, ControlRobot(stop="smoke"))
        assert stopped is not None
        assert (stopped.held, stopped.stopped) == (True, "stopped 1 job")
        assert (await contract.outcome()).reason == "stopped by the robot's side: smoke"
        hold_all(folder, "a person is in the way")
        with raises_with(AiraError, code="held-on-machine", match="all robots of its machine"):
            await robot.control(release=True)
        assert release(folder) == 1
        assert not (await robot.control()).held


async def test_owners_who_are_not_on_its_machine_reach_it_by_its_service_if_it_is_open(market: Market) -> None:
    session = (await market.person()).network.session
    async with market.robot(robot_at(open_services=True)) as robot:
        assert await call(session, robot.address, "control", ControlRobot(paused=True))
        assert (await robot.control()).paused


async def test_who_asks_for_a_robot_that_does_not_run_here_is_told_so(market: Market) -> None:
    async with market.robot(robot_at()) as robot:
        folder, address = stop_folder(robot.settings), robot.address
        assert control_here(folder, STRANGER, ControlRobot()) is None
        with raises_with(AiraError, code="invalid-amount"):
            await asyncio.to_thread(control_here, folder, address, ControlRobot(price="much"))
    assert control_here(folder, address, ControlRobot()) is None
