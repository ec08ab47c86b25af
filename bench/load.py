"""A provider under load: orders per second that it adds to its book, and jobs per minute on two kinds of chain."""

from __future__ import annotations

import asyncio
import logging
import tempfile
import time
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from one_router import TIMEOUT

from common import SPAWN, router, signed_demands
from mesh import Agent
from mesh.background import Background
from mesh.demo.lamp import write_objective
from mesh.devchain import EmbeddedChain
from mesh.devchain.anvil import find_anvil, serve_anvil
from mesh.devchain.development import deploy_market
from mesh.market.provider import Provider
from mesh.network import Channel, Endpoints, Network
from mesh.settings import Settings
from peers.catalog import PeerMissing, locate
from schemas import cid_of_bytes

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.devchain.development import DevelopmentMarket
    from schemas import Demand, Verified

MODEL: Final = cid_of_bytes(b"what the robot of the benchmark can do")
WINDOW: Final = 2000
"""Most orders in flight, so that none is lost."""


def orders_per_second(count: int) -> dict[str, float]:
    """Orders per second for signed demands without an offer, which a provider verifies and adds to its book."""
    with router() as (endpoint, _):
        return asyncio.run(_orders(endpoint, count))


async def _orders(endpoint: str, count: int) -> dict[str, float]:
    async with embedded() as (node, market):
        chain = market.chain(node, "provider")
        ready, added = SPAWN.Event(), SPAWN.Value("l", 0)
        publishing = SPAWN.Process(
            target=publish,
            args=(endpoint, market.deployment.lighthouse_name, market.deployment.lighthouse, count, ready, added),
            daemon=True,
        )
        publishing.start()
        assert await asyncio.to_thread(ready.wait, TIMEOUT)
        async with (
            chain,
            Network(Endpoints(connect=(endpoint,))) as network,
            Provider(network.session, chain, market.deployment.lighthouse_name) as provider,
            Background() as tasks,
        ):
            tasks.start(provider.run(), "provider")
            await asyncio.sleep(0.5)  # the router learns of its subscriptions
            added.value = 1
            while not len(provider.book):
                await asyncio.sleep(0.001)
            started, used = time.perf_counter(), time.process_time()
            deadline = time.monotonic() + TIMEOUT
            while len(provider.book) < count:
                added.value = len(provider.book)
                assert time.monotonic() < deadline, f"{len(provider.book)} of {count} orders were added"
                await asyncio.sleep(0.005)
            seconds, used = time.perf_counter() - started, time.process_time() - used
        publishing.terminate()
        publishing.join()
    return {
        "orders": count,
        "orders_per_second": round(count / seconds),
        "of_a_core_percent": round(used / seconds * 100),
    }


def publish(endpoint: str, lighthouse: str, address: str, count: int, ready: Any, added: Any) -> None:
    """The process that publishes, beginning when `added` is set to 1."""
    asyncio.run(_publish(endpoint, lighthouse, address, count, ready, added))


async def _publish(endpoint: str, lighthouse: str, address: str, count: int, ready: Any, added: Any) -> None:
    demands = signed_demands(count, lighthouse=address)
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, lighthouse, address=address) as channel,
    ):
        ready.set()
        while not added.value:
            await asyncio.sleep(0.001)
        for number, demand in enumerate(demands):
            while number - added.value >= WINDOW:
                await asyncio.sleep(0.001)
            channel.publish(demand)
        await asyncio.sleep(TIMEOUT)


def jobs_per_minute(count: int, at_once: int) -> dict[str, dict[str, float] | str]:
    """Jobs from demand to payment, with one provider and one robot; `at_once` demands are open at a time."""
    results: dict[str, dict[str, float] | str] = {}
    with router() as (endpoint, _):
        results["embedded"] = asyncio.run(_jobs(endpoint, embedded(), count, at_once))
        try:
            program = find_anvil(locate("anvil"))
        except PeerMissing as missing:
            results["anvil"] = str(missing)
        else:
            assert program is not None
            results["anvil"] = asyncio.run(_jobs(endpoint, on_anvil(program), count, at_once))
    return results


@asynccontextmanager
async def embedded() -> AsyncIterator[tuple[Any, DevelopmentMarket]]:
    """A market on an embedded chain, in this process."""
    async with EmbeddedChain() as node:
        yield node.provider, await deploy_market(node.provider, node.funded_keys)


@asynccontextmanager
async def on_anvil(program: Path) -> AsyncIterator[tuple[Any, DevelopmentMarket]]:
    """A market on an anvil that mines each transaction at once."""
    async with serve_anvil(program, host="127.0.0.1", port=0, block_time=None, state=None) as node:
        yield node.url, await deploy_market(node.url, node.funded_keys)


async def _jobs(endpoint: str, opened_market: Any, count: int, at_once: int) -> dict[str, float]:
    async with AsyncExitStack() as stack:
        node, market = await stack.enter_async_context(opened_market)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        network = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
        chain = await stack.enter_async_context(market.chain(node, "provider"))
        provider = await stack.enter_async_context(Provider(network.session, chain, market.deployment.lighthouse_name))
        tasks = await stack.enter_async_context(Background())
        tasks.start(provider.run(), "provider")
        await stack.enter_async_context(_robot(await _agent(stack, endpoint, node, market, "robot", folder)))
        person = await stack.enter_async_context(await _agent(stack, endpoint, node, market, "person", folder))
        write_objective(folder / "objective.mcap")
        await _do_job(person, folder / "objective.mcap")  # the first job also approves allowances
        limit, seconds_each = asyncio.Semaphore(at_once), []

        async def job() -> None:
            async with limit:
                started = time.perf_counter()
                await _do_job(person, folder / "objective.mcap")
                seconds_each.append(time.perf_counter() - started)

        started = time.perf_counter()
        async with asyncio.TaskGroup() as jobs:
            for _ in range(count):
                jobs.create_task(job())
        seconds = time.perf_counter() - started
    return {
        "jobs": count,
        "at_once": at_once,
        "jobs_per_minute": round(count / seconds * 60),
        "a_job_takes_s": round(sum(seconds_each) / count, 2),
    }


async def _agent(
    stack: AsyncExitStack, endpoint: str, node: Any, market: DevelopmentMarket, role: str, folder: Path
) -> Agent:
    settings = Settings(
        connect=(endpoint,),
        data_dir=str(folder / role),
        lighthouse_contract=market.deployment.lighthouse_name,
        ens_contract=market.deployment.ens,
        playback="at-once",
    )
    chain = await stack.enter_async_context(market.chain(node, role))
    return Agent(MODEL, settings=settings, account=market.accounts[role], chain=chain)


def _robot(robot: Agent) -> Agent:
    @robot.on("*")
    async def play(job: Any, message: Any) -> None:
        job.publish("/said", "done")

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand)

    return robot


async def _do_job(person: Agent, objective: Path) -> None:
    async with asyncio.timeout(TIMEOUT):
        contract = await person.demand(objective, cost=1)
        outcome = await contract.outcome()
    assert outcome.success, "a job failed"


logging.getLogger("mesh").setLevel(logging.ERROR)
