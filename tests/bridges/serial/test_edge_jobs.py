"""Jobs that boards do: which messages reach which board, and what the recordings contain."""

from __future__ import annotations

import asyncio
import threading
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

import zenoh

from bridges.serial._device import Device
from bridges.serial.dialect import CallFailed
from mesh.agent.agent import Agent
from mesh.agent.jobs import QUIET_SECONDS
from mesh.chain import Account, Chain
from mesh.recording import open_objective
from mesh.testing._market import TIMING
from schemas import Empty, String, cid_of_bytes, topic_selector
from schemas.keys import PRESENT, DeviceTopicKey
from schemas.payloads import decode_value
from tests.support.bags import Bag, BagMessage, string
from tests.support.boards import COUNTER, ROSSERIAL_ECHO, board, edge
from tests.support.market import offering
from tests.support.objectives import objective
from tests.support.raising import raises_with
from tests.support.routers import client_config
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from bridges.serial.boards import SimulatedBoard
    from mesh.agent.handlers import Job
    from mesh.network import Pump
    from tests.support.market import Place


LONG = 60.0
OTHER_MODEL = cid_of_bytes(b"what the second robot of the test can do")


def is_working(uno: SimulatedBoard) -> bool:
    """Whether the counter is in /slow."""
    return bool(uno.changes(13)) and uno.changes(13)[-1].high


def counting(robot: Agent) -> Agent:
    """A robot whose board counts one, slowly, for each message on /work."""
    device = Device(robot, patience=LONG)

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        await device.call("/slow", 1, job=job)

    return offering(robot)


def recorded(recording: Path, topic: str) -> list[Any]:
    """The values on a topic of a recording."""
    messages = open_objective(recording).messages()
    return [decode_value(message.payload, message.type) for message in messages if message.topic == topic]


async def test_a_job_continues_after_an_unplugged_cable_and_its_recording_shows_the_gap(place: Place) -> None:
    robot = counting(place.agent("robot"))
    source = place.save(objective(("/work", Empty()), ("/work", Empty()), ("/work", Empty())))
    with board(COUNTER) as uno, edge(uno.port, place.address("robot"), place.endpoint):
        async with place.at_work(robot) as person:
            contract = await person.demand(source, cost=1)
            await until(lambda: is_working(uno), what="the job", seconds=LONG)
            await asyncio.to_thread(uno.unplug)
            await asyncio.to_thread(uno.plug)
            assert (await contract.outcome()).success
            recording = await contract.recording()
            assert (await Device(robot).call("/sum")).value == 3
    assert len(recorded(recording, "/slow")) == 3
    assert recorded(recording, "/aira/device/board") == [String("absent: the line is closed"), String("present")]


async def test_a_job_whose_board_was_reset_fails_and_never_hangs(place: Place) -> None:
    robot = counting(place.agent("robot"))
    source = place.save(objective(*[("/work", Empty())] * 5))  # enough to be in time on a slow machine
    with board(COUNTER) as uno, edge(uno.port, place.address("robot"), place.endpoint) as process:
        async with place.at_work(robot) as person:
            contract = await person.demand(source, cost=1)
            await until(lambda: is_working(uno), what="the job", seconds=LONG)
            await asyncio.to_thread(uno.reset)
            assert not (await contract.outcome()).success
            recording = await contract.recording()
        await until(lambda: "restarted" in process.log(), what="the loss in the log", seconds=LONG)
    [note] = recorded(recording, "/aira/note")
    assert "(doubt)" in note.data
    # The failed command ends the recording, perhaps before the device is reported absent.
    assert recorded(recording, "/aira/device/board")[:1] in ([], [String("absent: the board was restarted")])


async def test_a_ros_bag_is_an_objective_for_a_board(place: Place) -> None:
    robot = offering(place.agent("robot"))
    device = Device(robot, patience=LONG)

    @robot.on("/work", String)
    async def work(job: Job, number: String) -> None:
        await device.call("/add", int(number.data), job=job)

    bag = Bag([BagMessage("/work", string(str(number)), number * 10**6) for number in (2, 3)], compression="lz4")
    source = place.save(bag.encode(), "objective.bag")
    with board(COUNTER) as uno, edge(uno.port, place.address("robot"), place.endpoint):
        async with place.at_work(robot) as person:
            contract = await person.demand(source, cost=1)
            assert (await contract.outcome()).success
            recording = await contract.recording()
            assert (await device.call("/sum")).value == 5
    assert recorded(recording, "/work") == [String("2"), String("3")]
    assert recorded(recording, "/added") == [2, 3]


async def first_heard(device: Device, heard: Pump[Any]) -> None:
    """Return once `heard` has what the device says: declarations take their time to get around."""
    async with asyncio.timeout(LONG):
        while True:
            await device.call("/add", 0)
            with suppress(TimeoutError):
                async with asyncio.timeout(0.5):
                    assert await anext(heard) == 0
                    return


async def test_a_board_is_heard_in_a_job_and_what_it_answers_to_calls_is_recorded(place: Place) -> None:
    robot = offering(place.agent("robot"))
    device, namesake = Device(robot, patience=LONG), Device(robot, "other", patience=LONG)
    said: list[Any] = []

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        added = job.listen("/added")
        await device.call("/add", 5, job=job)
        said.append(await asyncio.wait_for(anext(added), LONG))
        await device.call("/sum", job=job)

    source = place.save(objective(("/work", Empty())))
    with board(COUNTER) as uno, edge(uno.port, place.address("robot"), place.endpoint):
        async with (
            place.at_work(robot) as person,
            device.listen("/added") as heard,
            namesake.listen("/added") as never,
        ):
            await first_heard(device, heard)
            contract = await person.demand(source, cost=1)
            assert (await contract.outcome()).success
            recording = await contract.recording()
            async with asyncio.timeout(LONG):
                while (number := await anext(heard)) == 0:
                    """One of those that were called until the board was heard."""
                assert number == 5
            assert never.take_ready() is None
    assert said == [5]
    assert (recorded(recording, "/add"), recorded(recording, "/added")) == ([5], [5])
    assert (recorded(recording, "/sum"), recorded(recording, "/sum/answer")) == ([Empty()], [5])
    assert recorded(recording, "/add/answer") == [5]


async def test_a_call_of_a_topic_that_the_board_lacks_names_those_that_it_has(place: Place) -> None:
    async with place.agent("robot") as robot:
        device = Device(robot, patience=LONG, in_doubt="again")
        with board(COUNTER) as uno, edge(uno.port, robot.address, place.endpoint):
            for topic in ("/nosuch", "/added"):
                with raises_with(CallFailed, code="no-such-topic") as caught:
                    await device.call(topic)
                has = str(caught.value).partition(" has ")[2].split(", ")
                assert {"/add", "/sum", "/slow"} <= set(has)
                assert "/added" not in has
                assert (caught.value.reason, caught.value.topic) == ("no-such-topic", topic)
                assert "no-such-topic" not in str(caught.value)  # it is the code, which is shown anyway


async def test_among_devices_with_the_same_topics_a_call_reaches_the_one_it_names(place: Place) -> None:
    robot = offering(place.agent("robot"))
    left, right = Device(robot, "left", patience=LONG), Device(robot, "right", patience=LONG)
    address = place.address("robot")

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        await left.call("/add", 5, job=job)
        await right.call("/add", 7, job=job)

    source = place.save(objective(("/work", Empty())))
    with (
        board(COUNTER) as one,
        board(COUNTER) as other,
        edge(one.port, address, place.endpoint, "--name", "left"),
        edge(other.port, address, place.endpoint, "--name", "right"),
    ):
        async with place.at_work(robot) as person:
            contract = await person.demand(source, cost=1)
            assert (await contract.outcome()).success
            recording = await contract.recording()
            assert (await left.call("/sum")).value == 5
            assert (await right.call("/sum")).value == 7
    assert recorded(recording, "/add") == [5, 7]
    assert sorted(recorded(recording, "/added")) == [5, 7]


async def test_a_command_in_a_job_reaches_only_the_device_with_that_topic_name(place: Place) -> None:
    robot = offering(place.agent("robot"))
    left, right = Device(robot, "left", patience=LONG), Device(robot, "right", patience=LONG)
    address = place.address("robot")

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        await left.call("/left/sum", job=job)
        await right.call("/right/sum", job=job)
        job.publish("/left/add", 5)

    source = place.save(objective(("/work", Empty())))
    with (
        board(COUNTER) as one,
        board(COUNTER) as other,
        edge(one.port, address, place.endpoint, "--name", "left", "--map", "/=/left"),
        edge(other.port, address, place.endpoint, "--name", "right", "--map", "/=/right"),
    ):
        async with place.at_work(robot) as person:
            contract = await person.demand(source, cost=1)
            assert (await contract.outcome()).success
            assert (await left.call("/left/sum")).value == 5
            assert (await right.call("/right/sum")).value == 0


@asynccontextmanager
async def second_robot(place: Place, account: Account, model: str) -> AsyncIterator[Agent]:
    """A robot beside the market's own, not yet running."""
    settings = place.settings("second")
    async with Chain(place.node.provider, account=account, ens=place.market.deployment.ens, timing=TIMING) as chain:
        yield Agent(model, settings=settings, account=account, chain=chain)


async def test_two_boards_do_jobs_of_one_market_at_the_same_time(place: Place) -> None:
    counting_began, talking_began = asyncio.Event(), asyncio.Event()
    first = offering(place.agent("robot"))
    counter = Device(first, patience=LONG)

    @first.on("/work")
    async def work(job: Job, message: object) -> None:
        counting_began.set()
        await talking_began.wait()
        await counter.call("/slow", 1, job=job)

    account = Account(place.node.funded_keys[4])
    async with second_robot(place, account, OTHER_MODEL) as second:
        talker = Device(second, patience=LONG)

        @second.on("/say", String)
        async def say(job: Job, text: String) -> None:
            talking_began.set()
            await counting_began.wait()
            await talker.call("/hear", text, job=job)

        offering(second)
        numbers = place.save(objective(("/work", Empty()), ("/work", Empty())), "numbers.mcap")
        words = place.save(objective(("/say", String("hello")), ("/say", String("world"))), "words.mcap")
        with (
            board(COUNTER) as uno,
            board(ROSSERIAL_ECHO) as other,
            edge(uno.port, place.address("robot"), place.endpoint),
            edge(other.port, account.address, place.endpoint, "--protocol", "rosserial"),
        ):
            async with place.at_work(first, second) as person:
                contracts = await asyncio.gather(
                    person.demand(numbers, cost=1), person.demand(words, cost=1, model=OTHER_MODEL)
                )
                outcomes = await asyncio.gather(*(contract.outcome() for contract in contracts))
                assert all(outcome.success for outcome in outcomes)
                counted, heard = [await contract.recording() for contract in contracts]
    assert (recorded(counted, "/slow"), recorded(counted, "/hear")) == ([1, 1], [])
    assert recorded(heard, "/hear") == recorded(heard, "/said") == [String("hello"), String("world")]
    assert recorded(heard, "/slow") == recorded(heard, "/added") == []


async def test_the_answers_to_commands_that_nobody_waits_for_are_recorded(place: Place) -> None:
    """The handler only publishes; a rosserial board acknowledges nothing, and the job ends after the last message."""
    robot = offering(place.agent("robot"))

    @robot.on("/say", String)
    async def say(job: Job, text: String) -> None:
        job.publish("/hear", text)

    words = [String(f"word {number}") for number in range(8)]
    source = place.save(objective(*(("/say", word) for word in words)))
    address = place.address("robot")
    with board(ROSSERIAL_ECHO) as uno, edge(uno.port, address, place.endpoint, "--protocol", "rosserial"):
        async with place.at_work(robot) as person:
            await Device(robot, patience=LONG).call("/hear", "are you there?")
            for _ in range(3):
                contract = await person.demand(source, cost=1)
                assert (await contract.outcome()).success
                assert recorded(await contract.recording(), "/said") == words


async def test_what_a_board_says_soon_after_its_work_is_recorded(place: Place) -> None:
    """It confirms the command, and answers by itself a moment later, as a measurement does."""
    robot, board_session = offering(place.agent("robot")), zenoh.open(client_config(place.endpoint))
    address, later = place.address("robot"), threading.Timer

    def answer(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr).removesuffix("/measure") + "/measured"
        later(QUIET_SECONDS / 2, board_session.put, (key, "7"), {"encoding": "application/json"}).start()

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        job.publish("/measure", None)

    source = place.save(objective(("/work", Empty())))
    with board_session:
        declared: list[Any] = [
            board_session.liveliness().declare_token(str(DeviceTopicKey(address, "probe", PRESENT))),
            board_session.declare_subscriber(topic_selector(address, topic="/measure"), answer),
        ]
        async with place.at_work(robot) as person:
            await until_heard(robot.network.session, topic_selector(address, address, "/measure"))
            contract = await person.demand(source, cost=1)
            assert (await contract.outcome()).success
            assert recorded(await contract.recording(), "/measured") == [7]
        assert len(declared) == 2
