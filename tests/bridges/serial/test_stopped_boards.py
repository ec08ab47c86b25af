"""What a board hears when a job is stopped, and its edge agent when the agent is silent or the router is down."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

from bridges.serial._device import Device
from bridges.serial.dialect import CallFailed
from mesh import Agent
from mesh.testing import assert_paid, assert_refunded
from schemas import Empty
from tests.support.agent.restarts import notes
from tests.support.boards import COUNTER, STOPPABLE, board, edge
from tests.support.commands import aira
from tests.support.market import MODEL, offering
from tests.support.waiting import until

if TYPE_CHECKING:
    from bridges.serial.boards import SimulatedBoard
    from mesh.agent.handlers import Job
    from mesh.testing import Market
    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter


LONG = 60.0
WORK = [("/work", Empty())]


def is_moving(uno: SimulatedBoard) -> bool:
    return bool(uno.changes(13)) and uno.changes(13)[-1].high


def moving(robot: Agent) -> asyncio.Event:
    """Give a robot a board that moves until the job is stopped; returns the event that it has begun to."""
    device, begun = Device(robot, patience=LONG), asyncio.Event()

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        await device.call("/move", job=job)
        begun.set()
        await asyncio.Event().wait()

    offering(robot)
    return begun


async def test_a_board_stops_and_its_recording_says_that_it_was_told(market: Market) -> None:
    begun = moving(robot := Agent())
    device = Device(robot, patience=LONG)

    @robot.on_stop
    async def make_safe(job: Job, why: str) -> None:
        await device.call("/home", job=job)

    async with market.robot(robot):
        with board(STOPPABLE) as uno, edge(uno.port, robot.address, market.endpoint):
            contract = await market.demand(robot, [*WORK, *WORK])
            await begun.wait()
            await until(lambda: is_moving(uno), what="the job", seconds=LONG)
            [heard] = (await contract.stop("it smokes")).devices
            assert (heard.device, heard.heard) == ("board", True)
            assert not is_moving(uno), "it has stopped before the request is answered"
            assert_refunded(outcome := await market.outcome(contract), code="stopped")
            assert (await device.call("/reason")).value == "it smokes"
    told = [said for said in outcome.recording.published if said[0] in ("/move", "/stop", "/home")]
    assert told == [("/move", None), ("/stop", "it smokes"), ("/home", None)]
    assert notes(outcome) == ["stopped by the customer: it smokes [stopped]"]


async def test_commands_that_wait_for_the_board_are_not_sent_after_a_stop(market: Market) -> None:
    robot = offering(Agent())
    device, failed, waits = Device(robot, patience=LONG), [], asyncio.Event()

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        job.publish("/slow", 5000)
        await until(lambda: uno.changes(11), what="the slow call", seconds=LONG)
        job.publish("/move", None)
        waits.set()
        try:
            await device.call("/move")
        except CallFailed as error:
            failed.append(error.code)
            raise

    async with market.robot(robot):
        with board(STOPPABLE) as uno, edge(uno.port, robot.address, market.endpoint) as process:
            await device.call("/reason")
            contract = await market.demand(robot, WORK)
            async with asyncio.timeout(LONG):
                await waits.wait()
            await asyncio.sleep(0.3)  # the calls are on their way; /slow takes longer
            await contract.stop("no")
            assert_refunded(await market.outcome(contract), code="stopped")
            assert (await device.call("/reason")).value == "no"
            assert not uno.changes(13)
            assert "(stopped)" in process.log()


async def test_a_board_that_has_no_topic_for_it_hears_no_stop_and_the_answer_says_so(market: Market) -> None:
    robot = offering(Agent())
    device, begun = Device(robot, patience=LONG), asyncio.Event()

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        await device.call("/add", 1, job=job)
        begun.set()
        await asyncio.Event().wait()

    async with market.robot(robot):
        with board(COUNTER) as uno, edge(uno.port, robot.address, market.endpoint):
            contract = await market.demand(robot, WORK)
            await begun.wait()
            [unheard] = (await contract.stop()).devices
            assert (unheard.heard, unheard.detail) == (False, "its firmware has no topic /stop")
            assert_refunded(await market.outcome(contract), code="stopped")


async def test_the_owner_stops_a_robot_whose_router_is_down(place: Place, router: EmbeddedRouter) -> None:
    robot, folder = place.agent("robot"), place.settings("robot").data_dir
    begun = moving(robot)
    with board(STOPPABLE) as uno, edge(uno.port, place.address("robot"), place.endpoint, "--data-dir", folder):
        async with place.at_work(robot) as person:
            contract = await person.demand(WORK)
            await begun.wait()
            await until(lambda: is_moving(uno), what="the job", seconds=LONG)
            router.stop()
            done = await asyncio.to_thread(aira, "stop", "a person fell", "--json", "--data-dir", folder)
            answers = {one["who"].split()[0]: one for one in json.loads(done.stdout)["answers"]}
            assert (done.returncode, answers["device"]["heard"], answers["agent"]["heard"]) == (0, True, True)
            assert not is_moving(uno)
            await until(lambda: not robot.runtime.executor.runs, what="the end of the job", seconds=LONG)
            job = await robot.parts.ledger.job(contract.address)
            assert job is not None
            assert (job.success, job.note) == (False, "stopped by the robot's side: a person fell [robot-stopped]")
            router.start()


async def test_a_robot_that_its_owner_has_stopped_begins_no_job_before_it_is_released(market: Market) -> None:
    said: list[Any] = []
    robot, person = offering(Agent(MODEL)), await market.person()

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        said.append(message)

    async with market.robot(robot):
        folder = robot.settings.data_dir
        done = await asyncio.to_thread(aira, "stop", "--data-dir", folder)
        assert (done.returncode, "stopped 0 jobs" in done.stdout) == (0, True)
        order = await person.order(WORK, model=MODEL, cost=1)
        declined: list[str] = []
        waiting = asyncio.create_task(order.contract(on_progress=lambda seen: declined.append(seen.code)))
        await until(lambda: "stopped" in declined, what="the decline", seconds=LONG)
        assert (await asyncio.to_thread(aira, "stop", "--release", "--data-dir", folder)).stdout == "released\n"
        assert_paid(await market.outcome(await waiting))
    assert len(said) == 1


async def test_a_board_is_stopped_when_its_agent_is_silent_in_a_job(market: Market) -> None:
    begun = moving(robot := Agent())
    async with market.robot(robot):
        with board(STOPPABLE) as uno, edge(uno.port, robot.address, market.endpoint, "--agent-silence", "2") as process:
            await market.demand(robot, WORK)
            await begun.wait()
            await until(lambda: is_moving(uno), what="the job", seconds=LONG)
            await asyncio.sleep(3)
            assert is_moving(uno), "the agent answers"
            await market.kill(robot)
            await until(lambda: not is_moving(uno), what="the stop", seconds=LONG)
            assert "silent for 2 s" in process.log()
