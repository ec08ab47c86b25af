"""A robot that works for 5 XRT a job (`greenhouse.py robot`), and a client that demands two jobs at once."""

import sys

from mesh import XRT, Agent, Declined, Demand, Job, JobFailed, Verified, cid_of_file, run_to_end

robot = Agent(cid_of_file(__file__))  # this program is the behaviour


@robot.on_demand
async def offer(demand: Verified[Demand]) -> None:
    if demand.message.cost < XRT.parse("5 XRT"):
        raise Declined("too-cheap", "a job costs 5 XRT")
    await robot.offer(demand)


@robot.on("/water")
def water(job: Job, litres: float) -> None:
    if litres > 10:
        raise JobFailed("the tank has 10 litres")


@robot.on("/lamp")
def lamp(job: Job, on: bool) -> None:
    job.publish("/lit", on)


@robot.every(1.0)
def report() -> None:
    robot.publish("/tank", 10.0)


async def demand_two() -> None:
    async with Agent(robot.model) as client:
        orders = [await client.order([("/lamp", True), ("/water", n)], cost="5 XRT") for n in (2.0, 99.0)]
        print(*[(await (await order.contract()).outcome()).reason or "done" for order in orders], sep="\n")


if __name__ == "__main__":
    robot.run() if "robot" in sys.argv else run_to_end(demand_two)
