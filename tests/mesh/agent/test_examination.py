"""Objectives are examined before anything is offered for them."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

import pytest
from msgspec import Struct

from mesh import Agent, Settings
from mesh.agent.objectives import ObjectiveUnfit
from mesh.content import ContentUnavailable
from mesh.testing import Market, assert_paid
from schemas import Empty, cid_of_bytes
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from mesh.agent.handlers import Job


MISSING = cid_of_bytes(b"nobody has this objective")


def refused_offers(caplog: pytest.LogCaptureFixture) -> list[ObjectiveUnfit]:
    """The errors with which the robot's handler refused to offer because the objective is unfit."""
    failures = [vars(record) for record in caplog.records if vars(record).get("event") == "handler-failed"]
    return [error for record in failures for error in record["args"] if isinstance(error, ObjectiveUnfit)]


class Speed(Struct):
    """The messages of a robot that drives."""

    metres_per_second: float


def going(robot: Agent) -> Agent:
    """The same robot, which takes the topic `/go` and no other."""

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        pass

    return robot


async def test_no_offer_is_made_for_an_objective_that_can_not_be_played(
    market: Market, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    robot = going(offering(Agent(MODEL)))
    async with market.robot(robot):
        person = await market.person()
        unfit = asyncio.create_task(person.demand([("/fly", Empty())], model=MODEL, wait=True))
        await until(lambda: refused_offers(caplog), seconds=30)
        assert {error.reason for error in refused_offers(caplog)} == {"unknown-topic"}
        assert "/fly" in str(refused_offers(caplog)[0])
        assert_paid(await market.order(MODEL, [("/go", Empty())]))
        assert not unfit.done()
        unfit.cancel()


async def test_no_offer_is_made_for_a_message_that_its_handler_can_not_take(
    market: Market, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    robot = offering(Agent(MODEL))
    speeds: list[Speed] = []

    @robot.on("/go", Speed)
    async def go(job: Job, speed: Speed) -> None:
        speeds.append(speed)

    async with market.robot(robot):
        said = [("/go", Speed(1.0)), ("/go", {"metres_per_second": "fast"})]
        person = await market.person()
        unfit = asyncio.create_task(person.demand(said, model=MODEL, wait=True))
        await until(lambda: refused_offers(caplog), seconds=30)
        assert {error.reason for error in refused_offers(caplog)} == {"unfit-message"}
        assert "not a Speed" in str(refused_offers(caplog)[0])
        assert_paid(await market.order(MODEL, [("/go", Speed(2.0))]))
        assert speeds == [Speed(2.0)]
        assert not unfit.done()
        unfit.cancel()


async def test_demands_with_unavailable_objectives_do_not_delay_others(market: Market) -> None:
    robot = going(offering(Agent(MODEL, settings=Settings(fetch_timeout=60.0))))
    async with market.robot(robot), asyncio.timeout(50):
        person = await market.person()
        missing = [
            asyncio.create_task(person.demand(cid_of_bytes(b"nobody has objective %d" % number), model=MODEL))
            for number in range(5)
        ]
        await until(lambda: len(person.orders()) == 5, seconds=30)
        assert_paid(await market.order(MODEL, [("/go", Empty())], by=person))
        for task in missing:
            assert not task.done()
            task.cancel()


async def test_an_objective_may_be_examined_by_hand(market: Market) -> None:
    store = (await market.person()).parts.store
    fit, unfit = (store.put_bytes(objective((topic, Empty()))) for topic in ("/go", "/fly"))
    async with market.robot(going(Agent())) as robot:
        assert (await robot.examine(fit)).count == 1
        with raises_with(ObjectiveUnfit, cid=unfit, reason="unknown-topic", code="objective-unfit"):
            await robot.examine(unfit)
    async with market.robot(going(Agent(settings=Settings(fetch_timeout=0.2)))) as robot:
        with pytest.raises(ContentUnavailable):
            await robot.examine(MISSING)


async def test_an_objective_damaged_in_the_store_is_fetched_again(market: Market) -> None:
    content = objective(("/a", Empty()))
    (await market.person()).parts.store.put_bytes(content)
    async with market.robot(Agent()) as robot:
        held = robot.parts.store.path(cid := robot.parts.store.put_bytes(content))
        assert held is not None
        held.chmod(0o600)
        held.write_bytes(content.replace(b"/a", b"/b"))
        found = await robot.examine(cid)
    assert [topic.name for topic in found.topics] == ["/a"]
