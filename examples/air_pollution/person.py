"""Asks the air pollution sensor for measurements, and prints them."""

import argparse
import asyncio
import secrets
from functools import partial
from pathlib import Path

from mesh import (
    ZERO_ADDRESS,
    Agent,
    Demand,
    Played,
    Result,
    String,
    Verified,
    cid_of_file,
    open_objective,
    pack,
    run_to_end,
)

GASES = ("dust", "CO", "LPG", "methane", "smoke", "hydrogen")
MODEL = cid_of_file(Path(__file__).with_name("model.md"))

agent = Agent(MODEL)
answers: asyncio.Queue[str] = asyncio.Queue()


@agent.on_result
async def receive(result: Verified[Result]) -> None:
    if result.message.liability == agent.address:
        answers.put_nowait(result.message.result)


async def question() -> Demand:
    """A demand for a measurement that pays nothing."""
    chain, settings = agent.parts.chain, agent.settings
    return Demand(
        model=MODEL,
        objective=MODEL,
        token=await chain.names.address(settings.erc20_token),
        cost=0,
        lighthouse=await chain.names.address(settings.lighthouse_contract),
        validator=ZERO_ADDRESS,
        validator_fee=0,
        deadline=await chain.block_number() + 1000,
        nonce=secrets.token_hex(32),
    )


async def answer() -> Played:
    """Ask until the sensor answers; returns the measurement in the recording that its Result names."""
    cid = None
    while cid is None:  # a sensor that starts later does not receive earlier demands
        agent.send(await question())
        try:
            cid = await asyncio.wait_for(answers.get(), 5)
        except TimeoutError:
            print("no answer yet", flush=True)
    return next(iter(open_objective(await agent.fetch(cid)).messages()))


async def ask(times: int, out: Path | None) -> None:
    said = []
    async with agent:
        for _ in range(times):
            said.append(await answer())
            for gas, volts in zip(GASES, String.decode(said[-1].payload).data.split(), strict=True):
                print(f"{gas:<10}{volts} V", flush=True)
    if out is not None:
        pack(said, out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Ask the air pollution sensor.")
    parser.add_argument("--times", type=int, default=1, help="how often to ask")
    parser.add_argument("--out", type=Path, help="recording of all answers to write, for plot.py")
    given = parser.parse_args()
    run_to_end(partial(ask, given.times, given.out))
