"""What was recorded of a job."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh.recording import open_objective

if TYPE_CHECKING:
    from mesh.agent.agent import Agent
    from mesh.agent.contracts import Contract
    from mesh.agent.handlers import Job
    from mesh.recording import Objective

COST = 1000
"""What a job pays here, wn."""


async def recorded(contract: Contract) -> Objective:
    """The recording of an ended contract."""
    return open_objective(await contract.recording())


def heard(recording: Objective, topic: str) -> list[bytes]:
    return [played.payload for played in recording.messages() if played.topic == topic]


def doing_nothing(robot: Agent) -> Agent:
    """The same robot with a handler for any topic."""

    @robot.on("*")
    async def nothing(job: Job, message: Any) -> None:
        pass

    return robot
