"""`python -m tests.crashes.process ROLE`: one role of the crash matrix, which stops at a point if it is given one."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mesh.agent.agent import Agent
from mesh.base.retry import RetryPolicy
from schemas import cid_of_bytes
from tests.crashes.points import Point

if TYPE_CHECKING:
    from mesh.agent.contracts import Contract
    from schemas import Demand, Verified

MODEL: Final = cid_of_bytes(b"what the robots of the crash matrix can do")
COST: Final = 1_000
WORDS: Final = ("one", "two", "three", "four", "five", "six")
RESEND: Final = RetryPolicy(initial=0.3, ceiling=1.0)
POINT: Final = "CRASH_POINT"
CONTROL: Final = "CRASH_CONTROL"
OBJECTIVE: Final = "CRASH_OBJECTIVE"
VALIDATOR: Final = "CRASH_VALIDATOR"
"""The validator that the person's demand names, if any."""


def provider() -> None:
    """`aira provider`."""
    from mesh.cli import main

    main(["provider"])


def validator() -> None:
    """`aira validator`, for its own account and the jury that the settings name."""
    from mesh.cli import main

    main(["validator"])


def robot() -> None:
    """Offers its work for every demand, and says what objectives tell it to."""
    agent = Agent(MODEL, resend=RESEND)

    @agent.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await agent.offer(demand)

    @agent.on("/say")
    async def say(job: Any, message: Any) -> None:
        job.publish("/said", message.data)
        await asyncio.sleep(0.1)

    agent.run()


def person() -> None:
    """Demands one job, unless that was done before it was restarted, and fetches the recording."""
    asyncio.run(_demand(Path(os.environ[OBJECTIVE])))


async def _demand(objective: Path) -> None:
    async with Agent(MODEL, resend=RESEND) as agent:
        print("person-started", flush=True)
        cid = await agent.add(objective)
        contract = await _demanded(agent, cid) or await agent.demand(
            cid, cost=COST, validator=os.environ.get(VALIDATOR, "")
        )
        outcome = await contract.outcome()
        if outcome.success:
            await contract.recording()
        print("person-done", flush=True)


async def _demanded(agent: Agent, objective: str) -> Contract | None:
    """The contract that was demanded before a restart, once it is made; None if the ledger has no demand."""
    for order in agent.orders():
        return await order.contract()
    for liability in await agent.parts.chain.liabilities.list(promisee=agent.address):
        if liability.objective == objective:
            return await agent.contract(liability.address)
    return None


ROLES: Final = {"provider": provider, "validator": validator, "robot": robot, "person": person}


if __name__ == "__main__":
    if os.environ.get(POINT):
        Point.parse(os.environ[POINT]).install(Path(os.environ[CONTROL]))
    ROLES[sys.argv[1]]()
