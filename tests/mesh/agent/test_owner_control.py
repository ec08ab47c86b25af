"""What an owner changes while the robot runs: price, customers, whether it takes jobs; and stops and releases."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.errors import DemandDeclined
from mesh.amounts import InvalidAmount
from mesh.errors import AiraError
from mesh.network import call
from mesh.role.local_stop import control_here, hold_all, release, stop_folder
from schemas.errors import InvalidAddress
from schemas.records import ControlRobot, RobotControl
from tests.mesh.agent.restarts import half_way
from tests.mesh.agent.test_own_model import DRIVE, Move, driving
from tests.support.market import Place, offering
from tests.support.raising import raises_with
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from mesh.agent.agent import Agent

STRANGER = "0x000000000000000000000000000000000000bEEF"
WORK = [("/drive", Move(1.0))]


def robot_at(place: Place, **options: Any) -> Agent:
    """A robot that takes all jobs, for the price 5 XRT by its model's description."""
    return driving(offering(place.agent("robot", place.save(DRIVE.encode(), "model.json"), **options)))


async def declined(robot: Agent, person: Agent, **terms: Any) -> str:
    """Why a robot declines a demand that is for it alone."""
    with pytest.raises(DemandDeclined) as caught:
        await person.demand(WORK, model=DRIVE.cid, robot=robot.address, **terms)
    return str(caught.value)


async def test_what_an_owner_changes_decides_at_once_and_after_a_restart(place: Place) -> None:
    async with place.provider(), place.agent("person") as person:
        async with robot_at(place, refuse=(STRANGER,)) as robot:
            before = RobotControl(price="5 XRT", paused=False, refuse=(STRANGER,), least_price="", held=False)
            assert await robot.control() == before
            changed = await robot.control(price="6.50", least_price="2", refuse=(person.address.lower(),))
            assert (changed.price, changed.least_price, changed.refuse) == ("6.5 XRT", "2 XRT", (person.address,))
            assert "this customer" in await declined(robot, person, cost="2")
        async with robot_at(place, refuse=(STRANGER,)) as robot:
            assert await robot.control() == changed
            assert (await robot.runtime.profile.present()).price == "6.5 XRT"
            await robot.control(refuse=())
            assert "at least 2 XRT" in await declined(robot, person, cost=1)
            (quote,) = await person.quotes(DRIVE.cid, WORK, timeout=20)
            assert (quote.cost, quote.code) == (6_500_000_000, "")
            assert (await robot.control(price="")).price == "5 XRT"
            contract = await person.demand(WORK, model=DRIVE.cid, robot=robot.address, cost="2")
            assert (await contract.outcome()).success


async def test_a_paused_robot_takes_no_job_until_it_takes_jobs_again(place: Place) -> None:
    async with place.at_work(robot := robot_at(place)) as person:
        objective = await robot.add(place.save(b"anything"))
        offer = await robot.offer(objective=objective, cost=1)
        assert [order.hash for order in robot.orders()] == [offer]
        await robot.control(paused=True)
        assert not robot.orders(), "its open offers are withdrawn"
        assert "paused" in await declined(robot, person, cost=1)
        with raises_with(AiraError, code="declined", match="paused"):
            await robot.offer(objective=objective, cost=1)
        (quote,) = await person.quotes(DRIVE.cid, WORK, timeout=20)
        assert quote.code == "paused"
        waits = asyncio.create_task(person.demand(WORK, model=DRIVE.cid, cost=1, wait=True))
        await robot.control(paused=False)
        assert (await (await waits).outcome()).success


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"price": "a lot"}, InvalidAmount),
        ({"least_price": "1e9"}, InvalidAmount),
        ({"refuse": ("Bob",)}, InvalidAddress),
    ],
)
async def test_a_change_that_is_none_changes_nothing(place: Place, wrong: Any, error: type[AiraError]) -> None:
    async with robot_at(place) as robot:
        before = await robot.control()
        with pytest.raises(error):
            await robot.control(paused=True, **wrong)
        assert await robot.control() == before


async def test_a_robot_that_its_owner_stops_ends_its_job_and_begins_none_until_it_is_released(place: Place) -> None:
    async with half_way(place) as (robot, _, contract):
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


async def test_owners_who_are_not_on_its_machine_reach_it_by_its_service_if_it_is_open(place: Place) -> None:
    async with robot_at(place, open_services=True) as robot, place.agent("person") as person:
        session = person.network.session

        async def answers() -> bool:
            try:
                return bool(await call(session, robot.address, "control", ControlRobot(paused=True), timeout=2))
            except AiraError:
                return False

        await until_found(answers, what="an answer")
        assert (await robot.control()).paused


async def test_who_asks_for_a_robot_that_does_not_run_here_is_told_so(place: Place) -> None:
    async with robot_at(place) as robot:
        folder, address = stop_folder(robot.settings), robot.address
        assert control_here(folder, STRANGER, ControlRobot()) is None
        with raises_with(AiraError, code="invalid-amount"):
            await asyncio.to_thread(control_here, folder, address, ControlRobot(price="much"))
    assert control_here(folder, address, ControlRobot()) is None
