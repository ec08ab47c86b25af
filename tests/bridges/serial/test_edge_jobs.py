"""Jobs that boards do: which messages reach which board, and what the recordings contain."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import zenoh

from bridges.serial._device import Device
from bridges.serial.dialect import CallFailed
from mesh import Agent
from mesh.agent.jobs import JOB_PACE
from mesh.testing import assert_paid, assert_refunded
from schemas import Empty, String, topic_selector
from schemas.keys import PRESENT, DeviceTopicKey
from tests.support.bags import Bag, BagMessage, string
from tests.support.boards import COUNTER, ROSSERIAL_ECHO, board, edge
from tests.support.market import offering
from tests.support.raising import raises_with
from tests.support.routers import client_config
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from pathlib import Path

    from bridges.serial.boards import SimulatedBoard
    from mesh.agent.handlers import Job
    from mesh.network import Pump
    from mesh.testing import Market


LONG = 60.0
BOARD = "/aira/device/board"


def is_working(uno: SimulatedBoard) -> bool:
    """Whether the counter is in /slow."""
    return bool(uno.changes(13)) and uno.changes(13)[-1].high


def counting() -> Agent:
    """A robot whose board counts one, slowly, for each message on /work."""
    robot = offering(Agent())
    device = Device(robot, patience=LONG)

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        await device.call("/slow", 1, job=job)

    return robot


async def test_a_job_continues_after_an_unplugged_cable_and_its_recording_shows_the_gap(market: Market) -> None:
    async with market.robot(counting()) as robot:
        with board(COUNTER) as uno, edge(uno.port, robot.address, market.endpoint):
            contract = await market.demand(robot, [("/work", Empty())] * 3)
            await until(lambda: is_working(uno), what="the job", seconds=LONG)
            await asyncio.to_thread(uno.unplug)
            await asyncio.to_thread(uno.plug)
            assert_paid(outcome := await market.outcome(contract, timeout=LONG))
            assert (await Device(robot).call("/sum")).value == 3
    assert len(outcome.recording.values("/slow")) == 3
    assert outcome.recording.values(BOARD) == ["absent: the line is closed", "present"]


async def test_a_job_whose_board_was_reset_fails_and_never_hangs(market: Market) -> None:
    async with market.robot(counting()) as robot:
        with board(COUNTER) as uno, edge(uno.port, robot.address, market.endpoint) as process:
            contract = await market.demand(robot, [("/work", Empty())] * 5)  # enough to be in time on a slow machine
            await until(lambda: is_working(uno), what="the job", seconds=LONG)
            await asyncio.to_thread(uno.reset)
            assert_refunded(outcome := await market.outcome(contract, timeout=LONG))
            await until(lambda: "restarted" in process.log(), what="the loss in the log", seconds=LONG)
    assert "(doubt)" in outcome.reason
    # The failed command ends the recording, perhaps before the device is reported absent.
    assert outcome.recording.values(BOARD)[:1] in ([], ["absent: the board was restarted"])


async def test_a_ros_bag_is_an_objective_for_a_board(market: Market, tmp_path: Path) -> None:
    robot = offering(Agent())
    device = Device(robot, patience=LONG)

    @robot.on("/work", String)
    async def work(job: Job, number: String) -> None:
        await device.call("/add", int(number.data), job=job)

    bag = Bag([BagMessage("/work", string(str(number)), number * 10**6) for number in (2, 3)], compression="lz4")
    (tmp_path / "objective.bag").write_bytes(bag.encode())
    async with market.robot(robot):
        with board(COUNTER) as uno, edge(uno.port, robot.address, market.endpoint):
            assert_paid(outcome := await market.order(robot, tmp_path / "objective.bag", timeout=LONG))
            assert (await device.call("/sum")).value == 5
    assert [one.value for one in outcome.recording.messages if one.topic == "/work"] == ["2", "3"]
    assert outcome.recording.values("/added") == [2, 3]


async def first_heard(device: Device, heard: Pump[Any]) -> None:
    """Return once `heard` has what the device says: declarations take their time to get around."""
    async with asyncio.timeout(LONG):
        while True:
            await device.call("/add", 0)
            with suppress(TimeoutError):
                async with asyncio.timeout(0.5):
                    assert await anext(heard) == 0
                    return


async def test_a_board_is_heard_in_a_job_and_what_it_answers_to_calls_is_recorded(market: Market) -> None:
    robot = offering(Agent())
    device, namesake = Device(robot, patience=LONG), Device(robot, "other", patience=LONG)
    said: list[Any] = []

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        added = job.listen("/added")
        await device.call("/add", 5, job=job)
        said.append(await asyncio.wait_for(anext(added), LONG))
        await device.call("/sum", job=job)

    async with market.robot(robot), device.listen("/added") as heard, namesake.listen("/added") as never:
        with board(COUNTER) as uno, edge(uno.port, robot.address, market.endpoint):
            await first_heard(device, heard)
            assert_paid(outcome := await market.order(robot, [("/work", Empty())], timeout=LONG))
            async with asyncio.timeout(LONG):
                while (number := await anext(heard)) == 0:
                    """One of those that were called until the board was heard."""
                assert number == 5
            assert never.take_ready() is None
    assert said == [5]
    found = [outcome.recording.values(topic) for topic in ("/add", "/added", "/sum", "/sum/answer", "/add/answer")]
    assert found == [[5], [5], [None], [5], [5]]


async def test_a_call_of_a_topic_that_the_board_lacks_names_those_that_it_has(market: Market) -> None:
    async with market.robot(Agent()) as robot:
        device = Device(robot, patience=LONG, in_doubt="again")
        with board(COUNTER) as uno, edge(uno.port, robot.address, market.endpoint):
            for topic in ("/nosuch", "/added"):
                with raises_with(CallFailed, code="no-such-topic") as caught:
                    await device.call(topic)
                has = str(caught.value).partition(" has ")[2].split(", ")
                assert {"/add", "/sum", "/slow"} <= set(has)
                assert "/added" not in has
                assert (caught.value.reason, caught.value.topic) == ("no-such-topic", topic)
                assert "no-such-topic" not in str(caught.value)  # it is the code, which is shown anyway


async def test_among_devices_with_the_same_topics_a_call_reaches_the_one_it_names(market: Market) -> None:
    robot = offering(Agent())
    left, right = Device(robot, "left", patience=LONG), Device(robot, "right", patience=LONG)

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        await left.call("/add", 5, job=job)
        await right.call("/add", 7, job=job)

    async with market.robot(robot):
        with (
            board(COUNTER) as one,
            board(COUNTER) as other,
            edge(one.port, robot.address, market.endpoint, "--name", "left"),
            edge(other.port, robot.address, market.endpoint, "--name", "right"),
        ):
            assert_paid(outcome := await market.order(robot, [("/work", Empty())], timeout=LONG))
            assert (await left.call("/sum")).value == 5
            assert (await right.call("/sum")).value == 7
    assert outcome.recording.values("/add") == [5, 7]
    assert sorted(outcome.recording.values("/added")) == [5, 7]


async def test_a_command_in_a_job_reaches_only_the_device_with_that_topic_name(market: Market) -> None:
    robot = offering(Agent())
    left, right = Device(robot, "left", patience=LONG), Device(robot, "right", patience=LONG)

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        await left.call("/left/sum", job=job)
        await right.call("/right/sum", job=job)
        job.publish("/left/add", 5)

    async with market.robot(robot):
        with (
            board(COUNTER) as one,
            board(COUNTER) as other,
            edge(one.port, robot.address, market.endpoint, "--name", "left", "--map", "/=/left"),
            edge(other.port, robot.address, market.endpoint, "--name", "right", "--map", "/=/right"),
        ):
            assert_paid(await market.order(robot, [("/work", Empty())], timeout=LONG))
            assert (await left.call("/left/sum")).value == 5
            assert (await right.call("/right/sum")).value == 0


async def test_two_boards_do_jobs_of_one_market_at_the_same_time(market: Market) -> None:
    counting_began, talking_began = asyncio.Event(), asyncio.Event()
    first, second = offering(Agent()), offering(Agent())
    counter, talker = Device(first, patience=LONG), Device(second, patience=LONG)

    @first.on("/work")
    async def work(job: Job, message: object) -> None:
        counting_began.set()
        await talking_began.wait()
        await counter.call("/slow", 1, job=job)

    @second.on("/say", String)
    async def say(job: Job, text: String) -> None:
        talking_began.set()
        await counting_began.wait()
        await talker.call("/hear", text, job=job)

    async with market.robot(first), market.robot(second):
        with (
            board(COUNTER) as uno,
            board(ROSSERIAL_ECHO) as other,
            edge(uno.port, first.address, market.endpoint),
            edge(other.port, second.address, market.endpoint, "--protocol", "rosserial"),
        ):
            counted, heard = await asyncio.gather(
                market.order(first, [("/work", Empty())] * 2, timeout=LONG),
                market.order(second, [("/say", "hello"), ("/say", "world")], timeout=LONG),
            )
    assert (counted.success, heard.success) == (True, True)
    assert (counted.recording.values("/slow"), counted.recording.values("/hear")) == ([1, 1], [])
    assert heard.recording.values("/hear") == heard.recording.values("/said") == ["hello", "world"]
    assert heard.recording.values("/slow") == heard.recording.values("/added") == []


async def test_the_answers_to_commands_that_nobody_waits_for_are_recorded(market: Market) -> None:
    """The handler only publishes; a rosserial board acknowledges nothing, and the job ends after the last message."""
    robot, words = offering(Agent()), [f"word {number}" for number in range(8)]

    @robot.on("/say", String)
    async def say(job: Job, text: String) -> None:
        job.publish("/hear", text)

    async with market.robot(robot):
        with (
            board(ROSSERIAL_ECHO) as uno,
            edge(uno.port, robot.address, market.endpoint, "--protocol", "rosserial"),
        ):
            await Device(robot, patience=LONG).call("/hear", "are you there?")
            for _ in range(3):
                assert_paid(outcome := await market.order(robot, [("/say", word) for word in words], timeout=LONG))
                assert outcome.recording.values("/said") == words


async def test_what_a_board_says_soon_after_its_work_is_recorded(market: Market) -> None:
    """It confirms the command, and answers by itself a moment later, as a measurement does."""
    robot, later = offering(Agent()), threading.Timer

    def answer(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr).removesuffix("/measure") + "/measured"
        later(JOB_PACE.quiet / 2, board_session.put, (key, "7"), {"encoding": "application/json"}).start()

    @robot.on("/work")
    async def work(job: Job, message: object) -> None:
        job.publish("/measure", None)

    async with market.robot(robot):
        with zenoh.open(client_config(market.endpoint)) as board_session:
            declared: list[Any] = [
                board_session.liveliness().declare_token(str(DeviceTopicKey(robot.address, "probe", PRESENT))),
                board_session.declare_subscriber(topic_selector(robot.address, topic="/measure"), answer),
            ]
            await until_heard(robot.network.session, topic_selector(robot.address, robot.address, "/measure"))
            assert_paid(outcome := await market.order(robot, [("/work", Empty())], timeout=LONG))
            assert outcome.recording.values("/measured") == [7]
            assert len(declared) == 2
