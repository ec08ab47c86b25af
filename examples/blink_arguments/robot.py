"""Blink with arguments: the objective names the lamp. A colour without a lamp fails the job."""

from pathlib import Path

from bridges.serial import Device
from mesh import Agent, Demand, Job, JobFailed, String, Verified, cid_of_file

LAMPS = ("red", "blue")

agent = Agent(cid_of_file(Path(__file__).with_name("model.md")))
board = Device(agent)


@agent.on_demand
async def offer(demand: Verified[Demand]) -> None:
    await agent.offer(demand)


@agent.on("/blink", String)
async def blink(job: Job, colour: String) -> None:
    if colour.data not in LAMPS:
        raise JobFailed(f"there is no {colour.data} lamp")
    answer = await board.call("/blink_led", colour, job=job)
    print(f"the {colour.data} lamp has blinked ({answer.status.value})", flush=True)


if __name__ == "__main__":
    agent.run()
