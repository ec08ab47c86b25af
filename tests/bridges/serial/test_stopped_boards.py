"""What a board hears when a job is stopped, and its edge agent when the agent is silent or the router is down."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

from bridges.serial._device import Device
from bridges.serial.dialect import CallFailed
from mesh.recording import open_objective
from schemas import Empty, String
from schemas.payloads import decode_value
from tests.support.boards import COUNTER, STOPPABLE, board, edge
from tests.support.commands import aira
from tests.support.market import offering
from tests.support.objectives import objective
from tests.support.waiting import until

if TYPE_CHECKING:
    from bridges.serial.boards import SimulatedBoard
    from mesh.agent.agent import Agent
    from mesh.agent.handlers import Job
    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter


LONG = 60.0


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


async def test_a_board_stops_and_its_recording_says_that_it_was_told(place: Place) -> None:
    robot = place.agent("robot")
    begun = moving(robot)
    device = Device(robot, patience=LONG)

    @robot.on_stop
    async def make_safe(job: Job, why: str) -> None:
        await device.call("/home", job=job)

    source = place.save(objective(("/work", Empty()), ("/work", Empty())))
    with board(STOPPABLE) as uno, edge(uno.port, place.address("robot"), place.endpoint):
        async with place.at_work(robot) as person:
            contract = await person.demand(source, cost=1)
            await begun.wait()
            await until(lambda: is_moving(uno), what="the job", seconds=LONG)
            [heard] = (await contract.stop("it smokes")).devices
            assert (heard.device, heard.heard) == ("board", True)
            assert not is_moving(uno), "it has stopped before the request is answered"
            assert (await contract.outcome()).code == "stopped"
            assert (await device.call("/reason")).value == "it smokes"
            recording = open_objective(await contract.recording())
    told = [
        (message.topic, decode_value(message.payload, message.type))
        for message in recording.messages()
        if message.topic in ("/move", "/stop", "/home", "/aira/note")
    ]
    note = String("stopped by the customer: it smokes [stopped]")
    assert told == [("/move", Empty()), ("/stop", String("it smokes")), ("/home", Empty()), ("/aira/note", note)]


async def test_commands_that_wait_for_the_board_are_not_sent_after_a_stop(place: Place) -> None:
    robot = offering(place.agent("robot"))
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

    source = place.save(objective(("/work", Empty())))
    with board(STOPPABLE) as uno, edge(uno.port, place.address("robot"), place.endpoint) as process:
        async with place.at_work(robot) as person:
            await device.call("/reason")
            contract = await person.demand(source, cost=1)
            async with asyncio.timeout(LONG):
                await waits.wait()
            await asyncio.sleep(0.3)  # the calls are on their way; /slow takes longer
            await contract.stop("no")
            assert (await contract.outcome()).code == "stopped"
            assert (await device.call("/reason")).value == "no"
        assert not uno.changes(13)
        assert "(stopped)" in process.log()


async def test_a_board_that_has_no_topic_for_it_hears_no_stop_and_the_answer_says_so(place: Place) -> None:
    robot = offering(place.agent("robot"))
    device, begun = Device(robot, patience=LONG), asyncio.Event()

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        await device.call("/add", 1, job=job)
        begun.set()
        await asyncio.Event().wait()

    source = place.save(objective(("/work", Empty())))
    with board(COUNTER) as uno, edge(uno.port, place.address("robot"), place.endpoint):
        async with place.at_work(robot) as person:
            contract = await person.demand(source, cost=1)
            await begun.wait()
            [unheard] = (await contract.stop()).devices
            assert (unheard.heard, unheard.detail) == (False, "its firmware has no topic /stop")
            assert (await contract.outcome()).code == "stopped"


async def test_the_owner_stops_a_robot_whose_router_is_down(place: Place, router: EmbeddedRouter) -> None:
    robot, source = place.agent("robot"), place.save(objective(("/work", Empty())))
    begun, folder = moving(robot), place.settings("robot").data_dir
    with board(STOPPABLE) as uno, edge(uno.port, place.address("robot"), place.endpoint, "--data-dir", folder):
        async with place.at_work(robot) as person:
            contract = await person.demand(source, cost=1)
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


async def test_a_robot_that_its_owner_has_stopped_begins_no_job_before_it_is_released(place: Place) -> None:
    said: list[Any] = []
    robot = offering(place.agent("robot"))

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        said.append(message)

    source = place.save(objective(("/work", Empty())))
    folder = place.settings("robot").data_dir
    async with place.at_work(robot) as person:
        done = await asyncio.to_thread(aira, "stop", "--data-dir", folder)
        assert (done.returncode, "stopped 0 jobs" in done.stdout) == (0, True)
        order = await person.order(source, cost=1)
        declined: list[str] = []
        waiting = asyncio.create_task(order.contract(on_progress=lambda seen: declined.append(seen.code)))
        await until(lambda: "stopped" in declined, what="the decline", seconds=LONG)
        assert (await asyncio.to_thread(aira, "stop", "--release", "--data-dir", folder)).stdout == "released\n"
        contract = await waiting
        assert (await contract.outcome()).success
    assert len(said) == 1


async def test_a_board_is_stopped_when_its_agent_is_silent_in_a_job(place: Place) -> None:
    robot, source = place.agent("robot"), place.save(objective(("/work", Empty())))
    begun, address, silent = moving(robot), place.address("robot"), ("--agent-silence", "2")
    with board(STOPPABLE) as uno, edge(uno.port, address, place.endpoint, *silent) as process:
        async with place.at_work(robot) as person:
            await person.demand(source, cost=1)
            await begun.wait()
            await until(lambda: is_moving(uno), what="the job", seconds=LONG)
            await asyncio.sleep(3)
            assert is_moving(uno), "the agent answers"
        # The agent has ended without the job: nothing answers any more.
        await until(lambda: not is_moving(uno), what="the stop", seconds=LONG)
        assert "silent for 2 s" in process.log()
