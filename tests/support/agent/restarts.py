"""A robot that is stopped in the middle, and whether it is paid."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh import Agent, Settings
from mesh.recording import NOTE_TOPIC
from schemas import ZERO_ADDRESS
from tests.support.market import MODEL, offering
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Container

    from mesh.agent.contracts import Contract
    from mesh.agent.handlers import Job
    from mesh.testing import Market, RecordedOutcome
    from tests.support.market import Place

COST = 1000
WORDS = [str(number) for number in range(6)]
SAYING = [("/say", word) for word in WORDS]
"""An objective of six words."""


def speaking(robot: Agent, said: list[str], *, stuck_at: Container[str] = "") -> Agent:
    """The same robot, which takes note of what it plays and never gets over a word of `stuck_at`."""

    @robot.on("/say")
    async def say(job: Job, message: str) -> None:
        if message in stuck_at:
            await asyncio.Event().wait()
        said.append(message)
        job.publish("/said", message)

    return robot


def parking(robot: Agent, parked: list[str]) -> Agent:
    """The same robot, which parks when it is stopped, and takes note of why."""

    @robot.on_stop
    def make_safe(job: Job, why: str) -> None:
        parked.append(why)
        job.publish("/parked", True)

    return robot


@asynccontextmanager
async def half_way(
    market: Market, *, by: Agent | None = None, parked: list[str] | None = None, **settings: Any
) -> AsyncIterator[tuple[Agent, Contract]]:
    """A robot, with these settings, that has said three of six words and is stuck, and its contract.

    With `parked` it parks when it is stopped.
    """
    said: list[str] = []
    robot = speaking(offering(Agent(MODEL, settings=Settings(**settings))), said, stuck_at="3")
    async with market.robot(robot if parked is None else parking(robot, parked)):
        contract = await market.demand(MODEL, SAYING, by=by, cost=COST)
        await until(lambda: len(said) == 3)
        yield robot, contract


def notes(outcome: RecordedOutcome) -> list[str]:
    """What the robot itself says in a recording: why it did not do the job."""
    return [message.value for message in outcome.recording.messages if message.topic == NOTE_TOPIC]


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
        return await person.demand(SAYING, cost=COST)
