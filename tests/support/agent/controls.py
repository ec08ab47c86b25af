"""A robot that is driven over Zenoh, and the session that drives it."""

from __future__ import annotations

from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.ledger import Phase
from mesh.network import Endpoints, Network, call
from schemas import String
from schemas.keys import LiabilityTopicKey
from schemas.rpc import Done, FinishLiability, LiabilityRead, LiabilityRequest, Nothing
from tests.support.market import in_phase, offering
from tests.support.objectives import objective
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh

    from mesh.agent.agent import Agent
    from mesh.agent.contracts import Contract
    from schemas import Record
    from tests.support.market import Place

WORDS = ["a", "b", "c"]


@dataclass
class Control:
    """A program elsewhere in the mesh that drives a robot and is its device."""

    session: zenoh.Session
    robot: Agent

    async def ask(self, service: str, request: Record) -> Any:
        return await call(self.session, self.robot.address, service, request)

    async def start(self, address: str) -> Done:
        done: Done = await self.ask("start", LiabilityRequest(address))
        return done

    async def finish(self, address: str, *, success: bool = True) -> None:
        assert await self.ask("finish", FinishLiability(address, success)) == Nothing()

    async def read(self, address: str) -> LiabilityRead:
        read: LiabilityRead = await self.ask("read", LiabilityRequest(address))
        return read

    async def say(self, address: str, topic: str, word: str) -> None:
        """Publish on a topic of the job, as a device does."""
        key = str(LiabilityTopicKey(self.robot.address, address, topic))
        await until_heard(self.session, key)
        self.session.put(key, String(word).encode(), encoding="ros1;std_msgs/String")

    async def played(self, address: str) -> None:
        """Wait until the robot has played the whole objective."""
        await self.position(address, len(WORDS))

    async def position(self, address: str, count: int) -> None:
        """Wait until the robot has played that many messages of the objective."""

        def reached() -> bool:
            run = self.robot.runtime.executor.runs.get(address)
            return run is not None and run.position == count

        await until(reached)


@pytest.fixture
async def control(place: Place) -> AsyncIterator[Control]:
    """A robot without handlers, a provider, and a session that drives the robot."""
    async with controlled(place, offering(place.agent("robot"))) as control:
        yield control


@asynccontextmanager
async def controlled(place: Place, robot: Agent) -> AsyncIterator[Control]:
    async with place.provider(), robot, Network(Endpoints(connect=(place.endpoint,))) as network:
        yield Control(network.session, robot)


async def ready(control: Control, person: Agent, place: Place, *, step_ns: int = 0, cost: int = 0) -> Contract:
    """A contract whose objective the robot has examined."""
    path = place.save(objective(*(("/say", word) for word in WORDS), step_ns=step_ns))
    contract = await person.demand(path, cost=cost)
    await in_phase(control.robot, contract, Phase.READY)
    return contract
