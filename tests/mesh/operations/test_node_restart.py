"""The node of agents and a provider ends and comes back with its chain: all of them go on by themselves."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh.work import outbox
from tests.mesh.operations.site import FEE, Site
from tests.support.nodes import Anvil
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from schemas import Demand, Verified
    from tests.support.routers import EmbeddedRouter

COST = 500
PATIENCE = 60.0


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "RESEND", 0.3)


@asynccontextmanager
async def lasting_node(state: Path) -> AsyncIterator[Anvil]:
    """An anvil that writes its chain to a file every second and at its end."""
    arguments = ("--state", str(state), "--state-interval", "1", "--preserve-historical-states")
    async with Anvil(arguments=arguments) as node:
        yield node


async def written(state: Path, block: int) -> None:
    """Wait until a block is in the file: what comes after it a sudden end would lose."""

    def holds() -> bool:
        try:
            return int(json.loads(state.read_bytes())["best_block_number"]) >= block
        except (OSError, ValueError):
            return False  # it is being written

    async def look() -> bool:
        return await asyncio.to_thread(holds)

    await until_found(look, what=f"block {block} in {state}", seconds=PATIENCE)


@pytest.mark.parametrize("end", ["stop", "kill"])
async def test_jobs_of_before_and_after_are_done_when_the_node_was_away(
    router: EmbeddedRouter, tmp_path: Path, end: str, caplog: pytest.LogCaptureFixture
) -> None:
    state = tmp_path / "chain.json"
    async with lasting_node(state) as node, asyncio.timeout(3 * PATIENCE):
        site = await Site.found(node.url, node.private_keys, router.endpoint, tmp_path)
        done: list[str] = []
        robot, may_work = site.agent("robot"), asyncio.Event()

        @robot.on_demand
        async def offer(demand: Verified[Demand]) -> None:
            await robot.offer(demand, lighthouse_fee=FEE)

        @robot.on("/say")
        async def say(job: object, message: Any) -> None:
            done.append(message.data)
            await may_work.wait()

        async with site.provider() as provider, robot, site.agent("person") as person:
            before = await person.parts.chain.tokens.balance(site.address("robot"))
            early = await person.demand(site.job("early"), cost=COST)
            await until(lambda: done, what="the early job under way", seconds=PATIENCE)
            await written(state, await person.parts.chain.block_number())

            await asyncio.to_thread(getattr(node, end))
            await until(lambda: "the chain can't be read" in provider.log(), what="the loss", seconds=PATIENCE)
            await until(lambda: caplog.text.count("the chain can't be read") >= 2, what="their loss", seconds=PATIENCE)
            may_work.set()
            await until_found(lambda: robot.parts.ledger.outbox(head=0), what="a Result", seconds=PATIENCE)
            await asyncio.to_thread(node.start)

            assert (await early.outcome()).success
            late = await person.demand(site.job("late"), cost=COST)
            assert (await late.outcome()).success
            assert done == ["early", "late"]
            assert await person.parts.chain.tokens.balance(site.address("robot")) == before + 2 * (COST - FEE)
            log = provider.log()
            assert "the chain can be read again" in log
            assert "Traceback" not in log
