"""A robot that does the job: it offers its work for each Demand of its model, and blinks as the objective says."""

import asyncio
from pathlib import Path

from mesh import Agent, Demand, Job, Verified, cid_of_file

agent = Agent(cid_of_file(Path(__file__).with_name("model.md")))


@agent.on_demand
async def offer(demand: Verified[Demand]) -> None:
    await agent.offer(demand)


@agent.on("/blink")
async def blink(job: Job, message: object) -> None:
    print("the lamp is on", flush=True)
    job.publish("/led", "on")
    await asyncio.sleep(0.2)
    job.publish("/led", "off")


if __name__ == "__main__":
    agent.run()
