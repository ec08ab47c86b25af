"""Jobs and orders of the tests of trading, and waiting for their effects."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from schemas import cid_of_bytes
from tests.support.market import Place, offering_unseen
from tests.support.objectives import objective
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.agent import Agent
    from mesh.agent.handlers import Job
    from mesh.agent.ledger import Outgoing

OBJECTIVE = cid_of_bytes(b"something to be done")
JOB = [("/go", "there")]


def doing_nothing(robot: Agent) -> Agent:
    """The same robot, which handles every message."""

    @robot.on("*")
    async def nothing(job: Job, message: Any) -> None:
        pass

    return robot


def working(robot: Agent) -> Agent:
    """The same robot, which offers work for every demand and handles every message."""
    return offering_unseen(doing_nothing(robot))


def job(place: Place) -> Path:
    return place.save(objective(*JOB))


async def unsettled(agent: Agent) -> list[Outgoing]:
    """The messages that an agent sends until their effect is on the chain."""
    return await agent.parts.ledger.outbox(head=agent.parts.chain_head.head)


async def waiting(agent: Agent) -> list[str]:
    """The kinds of those messages."""
    return [message.kind for message in await unsettled(agent)]


async def posted(agent: Agent) -> None:
    """Wait until an agent has something in its outbox."""
    await until_found(lambda: waiting(agent), what="a posted order")


async def known(robot: Agent, address: str) -> None:
    """Wait until a robot has heard of its job: it reads the chain by itself."""
    await until_found(lambda: robot.parts.ledger.job(address), what="a job")


async def all_posted(agent: Agent, count: int) -> bool:
    return len(await waiting(agent)) == count
