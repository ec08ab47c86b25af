"""Whole jobs while a real node's answers are spoiled: provider and robot live, and each job is paid once."""

from __future__ import annotations

from collections import Counter
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import pytest
import pytest_asyncio

from mesh.chain import Chain, Finalized, NewLiability
from mesh.dev.development import deploy_market
from mesh.testing._market import TIMING
from schemas import Empty
from tests.mesh.chain.conftest import events_of, read_to
from tests.support.market import ForeignChain, Place, offering
from tests.support.nodes import Anvil
from tests.support.objectives import objective
from tests.support.spoiling import SpoilingProxy

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh import Agent
    from mesh.agent.handlers import Job
    from tests.support.routers import EmbeddedRouter

COST = 1_000
JOBS = range(3, 30)
"""How many jobs are done: at least the first, and more until an answer was spoiled."""


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def anvil() -> AsyncIterator[Anvil]:
    async with Anvil() as anvil:
        yield anvil


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def founded(anvil: Anvil) -> ForeignChain:
    """A market on anvil; its tests reach the node by `_SpoiledPlace.chain` only."""
    return ForeignChain(anvil, await deploy_market(anvil.url, anvil.private_keys))


class _SpoiledPlace(Place):
    """A place whose agents reach the node through these proxies."""

    urls: tuple[str, ...] = ()

    def chain(self, role: str) -> Chain:
        return Chain(
            self.urls,
            account=self.market.accounts[role],
            contracts=self.market.deployment.contracts,
            timing=TIMING,
        )


def _going(robot: Agent) -> Agent:
    """The same robot, which takes the topic `/go`."""

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        pass

    return robot


@pytest.mark.sample("seed")
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("nodes", "rate"), [(1, 0.03), (2, 0.1)])
async def test_jobs_are_done_and_paid_once(
    founded: ForeignChain, anvil: Anvil, router: EmbeddedRouter, tmp_path: Path, nodes: int, rate: float, seed: int
) -> None:
    await _do_jobs(founded, anvil, router, tmp_path, nodes=nodes, seed=seed, rate=rate)


@pytest.mark.sample("seed")
@pytest.mark.parametrize("seed", range(3))
async def test_jobs_survive_a_node_that_at_times_lacks_the_contracts(
    founded: ForeignChain, anvil: Anvil, router: EmbeddedRouter, tmp_path: Path, seed: int
) -> None:
    lacking: dict[str, Any] = {"methods": frozenset({"eth_call"}), "kinds": ("emptied",), "rate": 0.1}
    await _do_jobs(founded, anvil, router, tmp_path, nodes=1, seed=seed, **lacking)


async def _do_jobs(
    founded: ForeignChain,
    anvil: Anvil,
    router: EmbeddedRouter,
    tmp_path: Path,
    *,
    nodes: int,
    seed: int,
    **spoiling: Any,
) -> None:
    """Do some jobs over proxies with these options, one after another."""
    async with Chain(anvil.url, contracts=founded.market.deployment.contracts, timing=TIMING) as chain:
        first = await chain.block_number() + 1
        robot_account = founded.market.accounts["robot"].address
        before = await chain.tokens.balance(robot_account)
        async with AsyncExitStack() as stack:
            proxies = [
                await stack.enter_async_context(SpoilingProxy(anvil.url, seed=100 * seed + number, **spoiling))
                for number in range(nodes)
            ]
            place = _SpoiledPlace(founded, router.endpoint, tmp_path)
            place.urls = tuple(proxy.url for proxy in proxies)
            await stack.enter_async_context(place)
            person = await stack.enter_async_context(place.at_work(_going(offering(place.agent("robot")))))
            done = 0
            while done < JOBS.start or (done < JOBS.stop and not any(proxy.spoiled for proxy in proxies)):
                path = place.save(objective(("/go", Empty())), f"{done}.mcap")
                contract = await person.demand(path, cost=COST)
                assert (await contract.outcome()).success
                done += 1
        events = Counter(type(event) for event in events_of(await read_to(chain, first, await chain.block_number())))
        assert (events[NewLiability], events[Finalized]) == (done, done)
        assert await chain.tokens.balance(robot_account) == before + done * COST
    spoiled = sum((proxy.spoiled for proxy in proxies), Counter[tuple[str, str]]())
    assert spoiled.total() > 0, spoiled
