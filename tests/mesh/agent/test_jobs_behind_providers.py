"""Whole jobs whose person, provider and robot reach the chain through a provider of nodes."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import pytest
import pytest_asyncio

from mesh.dev._rpc import JsonRpcServer
from mesh.testing import MarketChain
from tests.support.agent.trades import job
from tests.support.market import Place, offering
from tests.support.node_providers import PROVIDERS, ProviderServer, rows

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh import Job
    from tests.support.routers import EmbeddedRouter


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def market_chain() -> AsyncIterator[MarketChain]:
    """One of a few blocks: some of the providers take long for many."""
    async with MarketChain() as chain:
        yield chain


@pytest.mark.in_turn("over")
@pytest.mark.sample("name")
@pytest.mark.parametrize("over", ["http", "websocket"])
@pytest.mark.parametrize("name", rows())
async def test_a_whole_job_is_paid_behind_each_provider(
    name: str, over: str, market_chain: MarketChain, router: EmbeddedRouter, tmp_path: Path
) -> None:
    async with AsyncExitStack() as stack:
        upstream = await stack.enter_async_context(JsonRpcServer(market_chain.node.provider))
        node = await stack.enter_async_context(ProviderServer(PROVIDERS[name], upstream.url).serving())
        url = node.url if over == "http" else node.ws_url
        place = await stack.enter_async_context(Place(market_chain, router.endpoint, tmp_path, node=url))
        direct = await stack.enter_async_context(Place(market_chain, router.endpoint, tmp_path / "direct"))
        before, robot = await direct.balance("robot"), offering(place.agent("robot"))

        @robot.on("/go")
        async def go(work: Job, message: Any) -> None:
            work.publish("/done", "yes")

        async with asyncio.timeout(120), place.at_work(robot) as person:
            contract = await person.demand(job(place), cost=7)
            outcome = await contract.outcome()
        assert outcome.success
        assert await direct.balance("robot") == before + 7
        if PROVIDERS[name].over_quota or PROVIDERS[name].refuses or PROVIDERS[name].no_pending:
            assert node.refused, "the imitation was not met"


@pytest.mark.parametrize("over", ["http", "websocket"])
async def test_roles_end_soon_while_their_node_answers_nothing(
    over: str, market_chain: MarketChain, router: EmbeddedRouter, tmp_path: Path
) -> None:
    async with AsyncExitStack() as stack:
        upstream = await stack.enter_async_context(JsonRpcServer(market_chain.node.provider))
        node = await stack.enter_async_context(ProviderServer(PROVIDERS["hardhat"], upstream.url).serving())
        url = node.url if over == "http" else node.ws_url
        place = await stack.enter_async_context(Place(market_chain, router.endpoint, tmp_path, node=url))
        robot, plays = offering(place.agent("robot")), asyncio.Event()

        @robot.on("/go")
        async def go(work: Job, message: Any) -> None:
            plays.set()
            await asyncio.Event().wait()

        roles = AsyncExitStack()
        person = await roles.enter_async_context(place.at_work(robot))
        async with asyncio.timeout(60):
            await person.demand(job(place), cost=7)
            await plays.wait()
        node.is_stuck = True
        async with asyncio.timeout(10):
            await roles.aclose()
        node.is_stuck = False
