"""Blink: a board whose lamp blinks for money. `aira edge` connects the board to the mesh."""

from pathlib import Path

from bridges.serial import Device
from mesh import Agent, Demand, Job, Verified, cid_of_file

agent = Agent(cid_of_file(Path(__file__).with_name("model.md")))
board = Device(agent)


@agent.on_demand
async def offer(demand: Verified[Demand]) -> None:
    await agent.offer(demand)


@agent.on("/blink")
async def blink(job: Job, message: object) -> None:
    answer = await board.call("/blink_led", job=job)
    print(f"the lamp has blinked ({answer.status.value})", flush=True)


if __name__ == "__main__":
    agent.run()
