"""A forklift that wants a price for each metre, and gives a job back when its battery is empty."""

import argparse
import asyncio

from mesh import XRT, Agent, Declined, Demand, Job, JobFailed, QuoteRequest, Verified, cid_of_file


def forklift(price: str = "2 XRT", battery: float = 100.0) -> Agent:
    """A forklift with what a metre costs, and the metres for which its battery lasts."""
    robot = Agent(cid_of_file(__file__))  # this program is the behaviour

    async def price_of(wanted: Verified[Demand] | QuoteRequest) -> int:
        """What a job costs: it depends on what is to be lifted how high."""
        messages = await robot.examine(wanted)
        return round(sum(messages.of(float)) * XRT.parse(price))

    @robot.on_quote
    async def quote(request: QuoteRequest) -> int:
        return await price_of(request)

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        cost = await price_of(demand)
        if demand.message.cost < cost:
            raise Declined("too-cheap", f"that costs {XRT.show(cost)}")
        await robot.offer(demand)

    @robot.on("/lift")
    async def lift(job: Job, metres: float) -> None:
        nonlocal battery
        if metres > battery:
            raise JobFailed("the battery is empty", code="battery-empty")
        battery -= metres
        await asyncio.sleep(metres / 2)
        job.publish("/height", metres)

    return robot


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="A forklift that works for a price.")
    parser.add_argument("--price", default="2 XRT", help="what a metre costs")
    parser.add_argument("--battery", type=float, default=100.0, help="for how many metres its battery lasts")
    options = parser.parse_args()
    forklift(options.price, options.battery).run()
