"""Asks the air pollution sensor what is in the air, and prints what it says."""

import asyncio
import secrets
from pathlib import Path

from mesh import Agent
from mesh.recording import open_objective
from mesh.running import run_to_end
from schemas import ZERO_ADDRESS, Demand, Result, String, Verified, cid_of_file

GASES = ("dust", "CO", "LPG", "methane", "smoke", "hydrogen")
MODEL = cid_of_file(Path(__file__).with_name("model.md"))

agent = Agent(MODEL)
answers: asyncio.Queue[str] = asyncio.Queue()


@agent.on_result
async def hear(result: Verified[Result]) -> None:
    if result.message.liability == agent.address:
        answers.put_nowait(result.message.result)


async def question() -> Demand:
    """A demand for a measurement, for nothing."""
    chain, settings = agent.parts.chain, agent.settings
    return Demand(
        model=MODEL,
        objective=MODEL,
        token=await chain.resolve(settings.erc20_token),
        cost=0,
        lighthouse=await chain.resolve(settings.lighthouse_contract),
        validator=ZERO_ADDRESS,
        validator_fee=0,
        deadline=await chain.block_number() + 1000,
        nonce=secrets.token_hex(32),
    )


async def ask() -> None:
    async with agent:
        cid = None
        while cid is None:  # a sensor that is not there yet does not hear what was said before
            agent.channel.publish(agent.parts.signer.sign(await question()))
            try:
                cid = await asyncio.wait_for(answers.get(), 5)
            except TimeoutError:
                print("nobody answers yet", flush=True)
        recording = await agent.parts.exchange.fetch(cid, size_limit=1 << 20, timeout=30)
        message = next(iter(open_objective(recording).messages()))
        for gas, volts in zip(GASES, String.decode(message.payload).data.split(), strict=True):
            print(f"{gas:<10}{volts} V")


if __name__ == "__main__":
    run_to_end(ask)
