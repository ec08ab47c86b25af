"""Orders three lifts from the cheapest forklift. If that gives up, another one does them, and one of them is paid."""

from pathlib import Path

from mesh import XRT, Agent, cid_of_file, run_to_end

LIFTS = [("/lift", 1.5), ("/lift", 0.5), ("/lift", 2.0)]


async def order() -> None:
    async with Agent(cid_of_file(Path(__file__).with_name("forklift.py"))) as client:
        names = {robot.address: str(robot) for robot in await client.robots(client.model)}
        for quote in await client.quotes(client.model, LIFTS):
            print(f"{names[quote.agent]} wants {XRT.show(quote.cost)}", flush=True)
        contract = await client.demand(LIFTS, robot="cheapest", max_cost="20 XRT", retry=1)
        outcome = await contract.outcome()
        for attempt in (*outcome.earlier, outcome):
            print(f"{names[attempt.robot]}: {attempt.reason or 'done'}")
        for entry in (await client.statement()).entries:
            print(f"{names[entry.liability.promisor]} was paid {XRT.show(entry.spent)}")


if __name__ == "__main__":
    run_to_end(order)
