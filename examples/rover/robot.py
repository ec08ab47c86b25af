"""Rover: a robot on wheels, whose model is described for programs. `aira model new robot.py` writes the description."""

import asyncio
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from mesh import Agent, Demand, Job, Verified

agent = Agent(Path(__file__).with_name("model.json"))


class Move(Struct):
    """Drives straight ahead."""

    speed: Annotated[float, Meta(ge=0, le=2, title="Speed", extra_json_schema={"unit": "m/s"})]
    seconds: Annotated[float, Meta(gt=0, le=60, title="Time", extra_json_schema={"unit": "s"})] = 1.0


@agent.on_demand
async def offer(demand: Verified[Demand]) -> None:
    await agent.offer(demand)


@agent.on("/drive")
async def drive(job: Job, move: Move) -> None:
    await asyncio.sleep(move.seconds)
    job.publish("/driven", move.speed * move.seconds)


MODEL = agent.model_description(
    "Rover",
    description="A robot on wheels. It drives straight ahead, once for each message.",
    result={"/driven": Annotated[float, Meta(title="Distance", extra_json_schema={"unit": "m"})]},
    success="It has driven as far as each message says.",
    price="5 XRT",
    seconds=10,
)

if __name__ == "__main__":
    agent.run()
