"""Readings: what agents publish outside of jobs, and who hears it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh import Agent, Empty, InputError, Reading
from mesh.base.flood import Drops
from mesh.errors import ClosedError, ConfigurationError, InvalidKey
from mesh.network import Endpoints, Network, ReadingSubscription
from mesh.network.readings import LARGEST_READING, READING_LIMITS
from schemas import InvalidPayload, ReadingKey
from tests.support.orders import PERSON, ROBOT
from tests.support.raising import raises_with
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh

    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter


class Pose(msgspec.Struct):
    x: float


async def test_a_handler_and_an_iterator_hear_what_an_agent_publishes(place: Place) -> None:
    seen: list[Reading] = []
    listener = Agent(settings=place.settings("watcher"))

    @listener.on_reading("/battery", agent=place.address("robot"))
    async def low(reading: Reading) -> None:
        seen.append(reading)

    async with place.agent("robot") as robot, place.agent("person") as person, listener:
        async with listener.readings("/pose") as poses:
            for topic in ("/battery", "/pose"):
                await until_heard(robot.network.session, str(ReadingKey(robot.address, topic)))
            person.publish("/battery", 1.0)
            for value in (98.5, "low", Empty(), {"volts": [1, 2]}, b"\x01"):
                robot.publish("/battery", value)
            robot.publish("/pose", Pose(1.5))
            pose = await asyncio.wait_for(anext(poses), 30)
        await until(lambda: len(seen) >= 5, what="the readings of the battery")
    assert [reading.value for reading in seen] == [98.5, "low", None, {"volts": [1, 2]}, b"\x01"]
    assert {(reading.agent, reading.topic, reading.result) for reading in seen} == {
        (place.address("robot"), "/battery", "")
    }
    assert (pose.topic, pose.value, pose.type.schema_name) == ("/pose", {"x": 1.5}, "Pose")


async def test_what_cannot_be_a_reading_is_refused_at_once(place: Place) -> None:
    robot = place.agent("robot")
    with pytest.raises(ClosedError):
        robot.publish("/battery", 1.0)
    with raises_with(ConfigurationError, code="invalid-topic"):
        robot.on_reading("battery")
    async with robot:
        with pytest.raises(InvalidKey):
            robot.publish("battery", 1.0)
        with pytest.raises(InvalidPayload):
            robot.publish("/battery", object())
        with raises_with(InputError, code="reading-too-large", match="/camera"):
            robot.publish("/camera", bytes(LARGEST_READING + 1))
        robot.publish("/camera", bytes(LARGEST_READING))
    async with Agent(settings=place.settings("watcher")) as watcher:
        with pytest.raises(ConfigurationError):
            watcher.publish("/battery", 1.0)


class Listening:
    """A subscription to all readings, and a session that puts anything there."""

    def __init__(self, readings: ReadingSubscription, drops: Drops, session: zenoh.Session) -> None:
        self.readings = readings
        self.drops = drops
        self._session = session

    def put(self, agent: str, payload: bytes, *, encoding: str = "application/json") -> None:
        self._session.put(str(ReadingKey(agent, "/x")), payload, encoding=encoding)

    async def next(self) -> Any:
        return (await asyncio.wait_for(anext(self.readings), 30)).value


@pytest.fixture
async def listening(router: EmbeddedRouter) -> AsyncIterator[Listening]:
    endpoints, drops = Endpoints(connect=(router.endpoint,)), Drops()
    async with (
        Network(endpoints) as writer,
        Network(endpoints) as reader,
        ReadingSubscription(reader.session, drops=drops) as readings,
    ):
        await until_heard(writer.session, str(ReadingKey(ROBOT.address, "/x")))
        yield Listening(readings, drops, writer.session)


async def test_a_reading_that_is_invalid_or_too_large_is_counted_and_left_out(listening: Listening) -> None:
    listening.put(ROBOT.address, b"{")
    listening.put(ROBOT.address, bytes(LARGEST_READING + 1), encoding="")
    listening.put(ROBOT.address, b"1")
    assert await listening.next() == 1
    assert listening.drops.totals() == {"reading-invalid": 1, "too-large": 1}
    assert listening.readings.statistics().invalid == {"reading": 1}


async def test_a_flood_by_one_agent_leaves_the_others_their_turns(listening: Listening) -> None:
    for number in range(2 * READING_LIMITS.of_agent):
        listening.put(ROBOT.address, str(number).encode())
    listening.put(PERSON.address, b'"mine"')
    await until(lambda: listening.readings.statistics().accepted > 2 * READING_LIMITS.of_agent, what="all of them")
    await until(lambda: listening.drops.totals().get("reading-overflow") == READING_LIMITS.of_agent, what="the drops")
    assert await listening.next() == 0
    assert await listening.next() == "mine"
    assert listening.drops.heaviest("reading-overflow")[0] == (ROBOT.address, READING_LIMITS.of_agent)
