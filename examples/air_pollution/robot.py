"""Air pollution sensor: answers each Demand that pays nothing with its next measurement, without a contract."""

from pathlib import Path

from bridges.serial import Device
from mesh import Agent, Demand, Verified, cid_of_file

agent = Agent(cid_of_file(Path(__file__).with_name("model.md")))
board = Device(agent)


@agent.on_demand
async def measure(demand: Verified[Demand]) -> None:
    if not demand.message.cost:  # one that pays needs a contract, as in the other examples
        await agent.answer(demand, await board.next("/measurements"), topic="/measurements")
        print(f"answered {demand.signer}", flush=True)


if __name__ == "__main__":
    agent.run()
