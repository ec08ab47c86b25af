"""A person without ether at a command line: every part is a process, and the chain is anvil."""

from __future__ import annotations

import asyncio
import json
import re
import sys
from typing import TYPE_CHECKING

import pytest

from tests.support.cli.site import MODEL, Site
from tests.support.commands import AIRA, Serving, aira

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

COST, FEE = 500_000, 40_000
ROBOT = f"""
from mesh import Agent
agent = Agent("{MODEL}")
@agent.on_demand
async def offer(demand):
    await agent.offer(demand)
@agent.on("/say")
async def say(job, message):
    job.publish("/said", message)
agent.run()
"""


@pytest.mark.parametrize("generation", ["3", "5"])
async def test_a_person_needs_no_ether(anvil: Anvil, router: EmbeddedRouter, tmp_path: Path, generation: str) -> None:
    site = await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path)
    (tmp_path / "robot.py").write_text(ROBOT)
    person = site.address("person")
    async with site.chain("person") as chain:
        await chain.tokens.approve(chain.factory, 0)
        await chain.node.request("anvil_setBalance", person, "0x0")
        first, had = await chain.block_number(), await chain.tokens.balance()
        sent = await chain.node.transaction_count(person, block="latest")
        robot = Serving(sys.executable, tmp_path / "robot.py", says="account 0x", variables=site.variables("robot"))
        paid = ("--cost", f"{COST}wn", "--permit-fee", f"{FEE}wn")
        words = ("demand", "--model", MODEL, "--objective", str(site.job("work")), *paid, "--json")
        variables = site.variables("person", generation=generation)
        async with site.provider() as provider, robot:
            for _ in range(2):
                ordered = await asyncio.to_thread(aira, *words, **variables)
                assert ordered.returncode == 0, (ordered.stderr, provider.log(), robot.log())
                said = [json.loads(line) for line in ordered.stdout.splitlines()]
                assert said[-1]["success"] is True
                assert [one["permitFee"] for one in said if one.get("kind") == "posted"] == [str(FEE)]
        last = await chain.block_number()
        for block in range(first, last + 1):
            assert await chain.node.request("eth_getBalance", person, hex(block)) == "0x0"
        assert await chain.node.transaction_count(person, block="pending") == sent
        assert await chain.tokens.balance() == had - 2 * (COST + FEE)


async def test_who_is_refused_as_unpaid_reads_the_fee_and_the_flag_that_pays_it(
    anvil: Anvil, router: EmbeddedRouter, tmp_path: Path
) -> None:
    site = await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path)
    (tmp_path / "robot.py").write_text(ROBOT)
    async with site.chain("person") as chain:
        await chain.tokens.approve(chain.factory, 0)
        await chain.node.request("anvil_setBalance", site.address("person"), "0x0")
    robot = Serving(sys.executable, tmp_path / "robot.py", says="account 0x", variables=site.variables("robot"))
    words = ("demand", "--model", MODEL, "--objective", str(site.job("work")), "--cost", "5wn", "--existing", "new")
    variables = site.variables("person")
    async with site.provider(free_contracts="0") as provider, robot:
        async with Serving(*AIRA, *words, says="(--permit-fee)", variables=variables) as refused:
            (said,) = re.findall(
                r"can't use the demand now: .* a permit fee of (\S+ XRT) \(--permit-fee\)", refused.log()
            )
        paid = await asyncio.to_thread(aira, *words, "--permit-fee", said, **variables)
        assert paid.returncode == 0, (paid.stdout, paid.stderr, provider.log(), robot.log())
        assert f"; {said} more to the provider with the permit" in paid.stdout
