"""Agents and a provider go on by themselves after their node was restarted."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from tests.support.cli.site import FEE, Site, has_event, has_traceback
from tests.support.nodes import Anvil, written_state
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from schemas import Demand, Verified
    from tests.support.routers import EmbeddedRouter

COST = 500
TIMEOUT = 60.0


@asynccontextmanager
async def lasting_node(state: Path) -> AsyncIterator[Anvil]:
    """An anvil that writes its chain to a file every second and at its end."""
    arguments = ("--state", str(state), "--state-interval", "1", "--preserve-historical-states")
    async with Anvil(arguments=arguments) as node:
        yield node


def outages(caplog: pytest.LogCaptureFixture) -> int:
    """How many outages of the chain this process has logged."""
    return sum(getattr(record, "event", "") == "chain-outage" for record in caplog.records)


@pytest.mark.sample("end")
@pytest.mark.parametrize("end", ["stop", "kill"])
async def test_jobs_from_before_and_after_an_outage_of_the_node_are_done(
    router: EmbeddedRouter, tmp_path: Path, end: str, caplog: pytest.LogCaptureFixture
) -> None:
    state = tmp_path / "chain.json"
    async with lasting_node(state) as node, asyncio.timeout(3 * TIMEOUT):
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
            await until(lambda: done, what="the early job under way", seconds=TIMEOUT)
            head = await person.parts.chain.block_number()
            content = await asyncio.to_thread(written_state, state, head)

            await asyncio.to_thread(getattr(node, end))
            if end == "kill":
                state.write_bytes(content)  # it may have been killed while it wrote
            await until(lambda: has_event(provider, "chain-outage"), what="the provider's outage", seconds=TIMEOUT)
            await until(lambda: outages(caplog) >= 2, what="the agents' outages", seconds=TIMEOUT)
            may_work.set()
            await until_found(lambda: robot.parts.ledger.outbox(head=0), what="a Result", seconds=TIMEOUT)
            await asyncio.to_thread(node.start)

            assert (await early.outcome()).success
            late = await person.demand(site.job("late"), cost=COST)
            assert (await late.outcome()).success
            assert done == ["early", "late"]
            assert await person.parts.chain.tokens.balance(site.address("robot")) == before + 2 * (COST - FEE)
            await until(lambda: has_event(provider, "chain-recovered"), what="the provider's recovery", seconds=TIMEOUT)
            assert not has_traceback(provider)
