"""Hello mesh: greets everyone who publishes a Demand for its model. It needs a router, but no account and no chain."""

from pathlib import Path

from mesh import Agent, Demand, Verified, cid_of_file

agent = Agent(cid_of_file(Path(__file__).with_name("model.md")))


@agent.on_demand
async def greet(demand: Verified[Demand]) -> None:
    print(f"Hello {demand.signer}, you would pay {demand.message.cost} for {demand.message.objective}.", flush=True)


if __name__ == "__main__":
    agent.run()
