"""Asks the air pollution sensor for measurements, and prints them."""

import argparse
from functools import partial
from pathlib import Path

from mesh import Agent, Answer, cid_of_file, pack, run_to_end

GASES = ("dust", "CO", "LPG", "methane", "smoke", "hydrogen")


async def ask(times: int, out: Path | None) -> None:
    answers: list[Answer] = []
    async with Agent(cid_of_file(Path(__file__).with_name("model.md"))) as agent:
        for _ in range(times):
            answers.append(await agent.ask())
            for gas, volts in zip(GASES, answers[-1].value.split(), strict=True):
                print(f"{gas:<10}{volts} V", flush=True)
    if out is not None:
        pack((message for answer in answers for message in answer.messages), out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Ask the air pollution sensor.")
    parser.add_argument("--times", type=int, default=1, help="how often to ask")
    parser.add_argument("--out", type=Path, help="recording of all answers to write, for plot.py")
    given = parser.parse_args()
    run_to_end(partial(ask, given.times, given.out))
