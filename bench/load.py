"""A provider under load: the orders a second that it adds to its book, and the jobs a minute that it settles.

As a program it measures the jobs, and states which process the limit is: `of_a_core_percent`. Where that is not the
provider, `provider_capacity` is what it would settle in a minute with a core of its own.
"""

from __future__ import annotations

import asyncio
import cProfile
import logging
import os
import secrets
import sys
import tempfile
import time
from contextlib import AsyncExitStack, asynccontextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

ROOT: Final = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # `peers` finds anvil

from one_router import TIMEOUT, seconds_of  # noqa: E402

from common import SPAWN, arguments, router, show, signed_demands  # noqa: E402
from mesh import Agent  # noqa: E402
from mesh.base.background import Background  # noqa: E402
from mesh.chain import Account, Node  # noqa: E402
from mesh.dev import EmbeddedChain  # noqa: E402
from mesh.dev.anvil import find_anvil, serve_anvil  # noqa: E402
from mesh.dev.demo import write_objective  # noqa: E402
from mesh.dev.development import deploy_market  # noqa: E402
from mesh.market.provider import Provider, ProviderOptions, provider_of  # noqa: E402
from mesh.market.transactions import QUEUE_LIMITS  # noqa: E402
from mesh.network import Channel, Endpoints, MarketRules, Network  # noqa: E402
from mesh.role.composition import chain_of  # noqa: E402
from mesh.settings import Settings  # noqa: E402
from peers.catalog import locate  # noqa: E402
from schemas import cid_of_bytes  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from mesh.dev.development import DevelopmentMarket
    from schemas import Demand, Verified

PROFILE: Final = "BENCH_PROFILE"
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
        options = ProviderOptions(free_contracts=1_000_000)
        async with (
            chain,
            Network(Endpoints(connect=(endpoint,))) as network,
            Provider(network.session, chain, market.deployment.lighthouse_name, options) as provider,
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
    demands = signed_demands(count, lighthouse=address, cost=0)  # their makers have no money
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, MarketRules(lighthouse, address=address)) as channel,
    ):
        ready.set()
        while not added.value:
            await asyncio.sleep(0.001)
        for number, demand in enumerate(demands):
            while number - added.value >= WINDOW:
                await asyncio.sleep(0.001)
            channel.publish(demand)
        await asyncio.sleep(TIMEOUT)


@asynccontextmanager
async def embedded() -> AsyncIterator[tuple[Any, DevelopmentMarket]]:
    """A market on an embedded chain, in this process."""
    async with EmbeddedChain() as node:
        yield node.provider, await deploy_market(node.provider, node.funded_keys)


def jobs_per_minute(
    jobs: int, *, robots: int, at_once: int, block_time: int = 0, unmined: int = QUEUE_LIMITS.under_way
) -> dict[str, Any]:
    """Jobs from demand to payment: one provider, that many robots, and a person with `at_once` open demands.

    Router, anvil, provider, all robots together and the person are a process each. A block is mined with each
    transaction, or every `block_time` seconds. The provider has at most `unmined` transactions that are not mined.
    """
    with router() as (endpoint, pid), tempfile.TemporaryDirectory() as folder:
        settings = Settings(
            connect=(endpoint,), data_dir=folder, playback="at-once", unmined_limit=unmined, free_contracts=1_000_000
        )
        return asyncio.run(_jobs(settings, pid, jobs=jobs, robots=robots, at_once=at_once, block_time=block_time))


async def _jobs(
    settings: Settings, router_pid: int, *, jobs: int, robots: int, at_once: int, block_time: int
) -> dict[str, Any]:
    program = find_anvil(locate("anvil"))
    assert program is not None
    async with (
        serve_anvil(program, host="127.0.0.1", port=0, block_time=None, state=None) as node,
        AsyncExitStack() as stack,
    ):
        market = await deploy_market(node.url, node.funded_keys)
        if block_time:
            async with Node(node.url) as chain:
                await chain.request("evm_setAutomine", False)
                await chain.request("evm_setIntervalMining", block_time)
        settings = replace(
            settings,
            web3_http_provider=node.url,
            ens_contract=market.deployment.ens,
            lighthouse_contract=market.deployment.lighthouse_name,
        )
        pipes, pids = {}, {"router": router_pid, "anvil": node.pid}
        for role, number in (("provider", 1), ("robots", robots), ("person", 1)):
            pipes[role], theirs = SPAWN.Pipe()
            given = (role, replace(settings, data_dir=f"{settings.data_dir}/{role}"), node.funded_keys, number, theirs)
            process = SPAWN.Process(target=run, args=given, daemon=True)
            process.start()
            stack.callback(process.join, 30)  # seconds; when the jobs fail, nobody tells it to stop
            assert process.pid is not None
            pids[role] = process.pid
        await asyncio.gather(*(_heard(pipe) for pipe in pipes.values()))

        async def do(count: int) -> float:
            pipes["person"].send((count, robots, at_once))
            return float(await _heard(pipes["person"]))

        await do(robots)  # prepares: names, allowances, connections between all
        before = {role: seconds_of(pid) for role, pid in pids.items()}
        seconds = await do(jobs)
        used = {role: seconds_of(pid) - before[role] for role, pid in pids.items()}
        for pipe in pipes.values():
            pipe.send(None)
    return {
        "jobs": jobs,
        "robots": robots,
        "at_once": at_once,
        "block_time": block_time,
        "unmined": settings.unmined_limit,
        "jobs_per_minute": round(jobs / seconds * 60),
        "provider_cpu_ms_a_job": round(used["provider"] / jobs * 1000, 1),
        "provider_capacity": round(60 * jobs / used["provider"]),
        "of_a_core_percent": {role: round(one / seconds * 100) for role, one in used.items()},
    }


async def _heard(pipe: Any) -> Any:
    assert await asyncio.to_thread(pipe.poll, TIMEOUT), "the jobs take too long"
    return pipe.recv()


def run(role: str, settings: Settings, keys: Sequence[bytes], number: int, pipe: Any) -> None:
    """The process of a role. The variable `PROFILE` names a folder for what cProfile says of it."""
    logging.getLogger("mesh").setLevel(logging.ERROR)
    profile = cProfile.Profile() if PROFILE in os.environ else nullcontext()
    main = {"provider": _provide, "robots": _work, "person": _demand}[role]
    with profile:
        asyncio.run(main(settings, keys, number, pipe))
    if isinstance(profile, cProfile.Profile):
        profile.dump_stats(Path(os.environ[PROFILE]) / f"{role}-{os.getpid()}.prof")


async def _provide(settings: Settings, keys: Sequence[bytes], number: int, pipe: Any) -> None:
    async with (
        chain_of(settings, Account(keys[0])) as chain,
        Network(Endpoints(connect=settings.connect)) as network,
        await provider_of(settings, network.session, chain) as provider,
        Background() as tasks,
    ):
        tasks.start(provider.run(), "provider")
        pipe.send("ready")
        await asyncio.to_thread(pipe.recv)


async def _work(settings: Settings, keys: Sequence[bytes], number: int, pipe: Any) -> None:
    async with AsyncExitStack() as stack:
        for which in range(number):
            own = replace(settings, data_dir=f"{settings.data_dir}/{which}")
            robot = Agent(_model(which), settings=own, account=Account(secrets.token_bytes(32)))
            await stack.enter_async_context(_offering(robot))
        pipe.send("ready")
        await asyncio.to_thread(pipe.recv)


def _offering(robot: Agent) -> Agent:
    @robot.on("*")
    async def play(job: Any, message: Any) -> None:
        job.publish("/said", "done")

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand)

    return robot


async def _demand(settings: Settings, keys: Sequence[bytes], number: int, pipe: Any) -> None:
    async with Agent(settings=settings, account=Account(keys[2])) as person:
        objective = Path(settings.data_dir) / "objective.mcap"
        await asyncio.to_thread(write_objective, objective)
        pipe.send("ready")
        while (wanted := await asyncio.to_thread(pipe.recv)) is not None:
            count, robots, at_once = wanted
            limit, started = asyncio.Semaphore(at_once), time.perf_counter()

            async def job(which: int, limit: asyncio.Semaphore = limit) -> None:
                async with limit:
                    contract = await person.demand(objective, cost=1, model=_model(which))
                    assert (await contract.outcome()).success, "a job failed"

            async with asyncio.TaskGroup() as jobs:
                for which in range(count):
                    jobs.create_task(job(which % robots))
            pipe.send(time.perf_counter() - started)


def _model(which: int) -> str:
    return cid_of_bytes(f"model {which}".encode())


def main() -> None:
    """Run the benchmark of jobs."""
    options = arguments(
        "jobs a minute of one provider", jobs=200, robots=20, at_once=40, block_time=0, unmined=QUEUE_LIMITS.under_way
    )
    results = jobs_per_minute(
        options.jobs,
        robots=options.robots,
        at_once=options.at_once,
        block_time=options.block_time,
        unmined=options.unmined,
    )
    show(results, as_json=options.json)


if __name__ == "__main__":
    main()
