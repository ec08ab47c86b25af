"""A robot that is stopped in the middle, and whether it is paid."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from schemas import ZERO_ADDRESS
from tests.support.market import offering
from tests.support.objectives import objective
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.agent.agent import Agent
    from mesh.agent.contracts import Contract
    from mesh.agent.handlers import Job
    from tests.support.market import Place

COST = 1000
WORDS = [str(number) for number in range(6)]


def words(place: Place) -> Path:
    """An objective of six words."""
    return place.save(objective(*(("/say", word) for word in WORDS)))


def speaking(robot: Agent, said: list[str], *, stuck_at: str = "") -> Agent:
    """The same robot, which takes note of what it plays and never gets over `stuck_at`."""

    @robot.on("/say")
    async def say(job: Job, message: str) -> None:
        if message == stuck_at:
            await asyncio.Event().wait()
        said.append(message)
        job.publish("/said", message)

    return robot


@asynccontextmanager
async def half_way(place: Place, **settings: Any) -> AsyncIterator[tuple[Agent, Agent, Contract]]:
    """A robot, with these settings, that has said three of six words and is stuck: it, the person, their contract."""
    said: list[str] = []
    robot = speaking(offering(place.agent("robot", **settings)), said, stuck_at="3")
    async with place.at_work(robot) as person:
        contract = await person.demand(words(place), cost=COST)
        await until(lambda: len(said) == 3)
        yield robot, person, contract


class Paying:
    """Compares what a robot has with what it should have got."""

    def __init__(self, place: Place, before: int) -> None:
        self._place = place
        self._before = before

    async def once(self) -> bool:
        return await self._place.balance("robot") == self._before + COST


@pytest.fixture
async def paid(place: Place) -> Paying:
    return Paying(place, await place.balance("robot"))


async def made_by_a_provider_that_leaves(place: Place, person: Agent, robot: Agent) -> Contract:
    """A contract whose provider is gone when its result is sent: the robot does no job before."""
    async with robot.runtime.executor.halted(ZERO_ADDRESS), place.provider():
        return await person.demand(words(place), cost=COST)
