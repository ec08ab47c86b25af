"""What the market costs at an EVM node: calls a job and in an idle minute; exits with 1 above a limit.

Router, provider, robot and person are processes of their own. Each of the last three reaches anvil through a proxy that
counts calls: each request of JSON-RPC, and each member of a batch, since nodes bill calls. What a node pushes (new
heads over WebSocket) is counted apart.

- `per_job`: the calls of all three in a job, from the demand to the payment that the person sees, with a block every
  12 s. The jobs follow one another; the first one, which prepares a little (names, an allowance), is not counted.
  With quicker blocks a job takes more of them, and is not bound: `cases` has it.
- `idle_minute`: the calls of one process in a minute without orders, in which blocks are mined; `idle_block` the same
  for one block. The process with the most counts.

Chains: a block every 12 s and every second over HTTP, every 12 s over WebSocket, all at the same time. With `--chain`
it is that chain instead, by its profile: anvil with its number and the pace of its blocks, the roles with its settings;
no limit holds there. What an underlying chain adds (numbers of blocks, a fee oracle) is not imitated.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
import sys
import tempfile
import time
from collections import Counter
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from aiohttp import ClientSession, WSMsgType, web
from mcap.writer import Writer

ROOT: Final = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # `peers` finds anvil

from common import SPAWN, arguments, router  # noqa: E402
from mesh import Agent  # noqa: E402
from mesh.chain import Account, Chain  # noqa: E402
from mesh.dev.anvil import find_anvil, serve_anvil  # noqa: E402
from mesh.dev.development import ROLES, deploy_market  # noqa: E402
from mesh.market.provider import provider_of  # noqa: E402
from mesh.network import Endpoints, Network  # noqa: E402
from mesh.role.composition import chain_of  # noqa: E402
from mesh.settings import Settings  # noqa: E402
from mesh.settings.chains import CHAINS  # noqa: E402
from peers.catalog import locate  # noqa: E402
from schemas import cid_of_bytes  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from schemas import Demand, Verified

MODEL: Final = cid_of_bytes(b"what the robot of the benchmark can do")
TIMEOUT: Final = 180.0
SETTLE_SECONDS: Final = 3.0
"""After the last block of a job, until all have read it."""
PACE_BLOCKS: Final = 8
"""Blocks at the pace of a case that its chain has when the processes start."""
CALLS_PER_JOB: Final = 30
"""With a block every 12 s."""
IDLE_MINUTE: Final = 6
"""With a block every 12 s."""
IDLE_BLOCK: Final = 2
"""With other blocks."""


@dataclass(frozen=True)
class Case:
    """A chain: the seconds between two blocks, how the roles reach it, and its profile, if it has one."""

    name: str
    block_time: float
    scheme: str
    chain: str = ""


CASES: Final = (Case("12s", 12, "http"), Case("12s-websocket", 12, "ws"), Case("1s", 1, "http"))


@dataclass
class Calls:
    """What was counted, by role and method, and how many requests and pushed messages that were by role."""

    calls: Counter[tuple[str, str]] = field(default_factory=Counter)
    requests: Counter[str] = field(default_factory=Counter)
    pushed: Counter[str] = field(default_factory=Counter)

    def clear(self) -> None:
        """Count from zero."""
        for counter in (self.calls, self.requests, self.pushed):
            counter.clear()

    def of(self, role: str) -> int:
        """The calls of a role."""
        return sum(count for (who, _), count in self.calls.items() if who == role)

    def by_role(self, share: float) -> dict[str, Any]:
        """The calls by role and method, multiplied by `share`."""
        return {
            role: {
                "calls": round(self.of(role) * share, 2),
                "requests": round(self.requests[role] * share, 2),
                "pushed": round(self.pushed[role] * share, 2),
                "methods": {
                    method: round(count * share, 2) for (who, method), count in self.calls.most_common() if who == role
                },
            }
            for role in ROLES
        }


class CountingProxy:
    """Passes JSON-RPC on to the node at `url`, and counts it: the path is the role (`http://…/robot`)."""

    def __init__(self, url: str) -> None:
        self.seen: Final = Calls()
        self._url = url

    @asynccontextmanager
    async def serve(self) -> AsyncIterator[int]:
        """Serve on loopback; yields the port."""
        application = web.Application(client_max_size=64 << 20)
        application.router.add_post("/{role}", self._request)
        application.router.add_get("/{role}", self._socket)
        runner = web.AppRunner(application)
        await runner.setup()
        async with ClientSession() as self._session:
            site = web.TCPSite(runner, "127.0.0.1", 0, shutdown_timeout=0.1)
            await site.start()
            try:
                yield runner.addresses[0][1]
            finally:
                await runner.cleanup()

    def _count(self, role: str, text: str | bytes) -> None:
        asked = json.loads(text)
        self.seen.requests[role] += 1
        self.seen.calls.update((role, member["method"]) for member in (asked if isinstance(asked, list) else [asked]))

    async def _request(self, request: web.Request) -> web.Response:
        body = await request.read()
        self._count(request.match_info["role"], body)
        async with self._session.post(self._url, data=body, headers={"Content-Type": "application/json"}) as answer:
            return web.Response(body=await answer.read(), status=answer.status, content_type="application/json")

    async def _socket(self, request: web.Request) -> web.WebSocketResponse:
        role, client = request.match_info["role"], web.WebSocketResponse(max_msg_size=64 << 20)
        await client.prepare(request)
        async with self._session.ws_connect(self._url, max_msg_size=64 << 20) as node:

            async def answer() -> None:
                async for message in node:
                    self.seen.pushed[role] += message.type == WSMsgType.TEXT and '"eth_subscription"' in message.data
                    await client.send_str(message.data)

            answering = asyncio.create_task(answer())
            async for message in client:
                self._count(role, message.data)
                await node.send_str(message.data if isinstance(message.data, str) else message.data.decode())
            answering.cancel()
        return client


async def run_provider(settings: Settings, key: bytes, pipe: Any) -> None:
    """The provider's process."""
    async with (
        chain_of(settings, Account(key)) as chain,
        Network(Endpoints(connect=settings.connect)) as network,
        await provider_of(settings, network.session, chain) as provider,
    ):
        pipe.send("ready")
        await provider.run()


async def run_robot(settings: Settings, key: bytes, pipe: Any) -> None:
    """The robot's process: it offers to do what is demanded."""
    robot = Agent(MODEL, settings=settings, account=Account(key))

    @robot.on("*")
    async def play(job: Any, message: Any) -> None:
        job.publish("/said", "done")

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand)

    async with robot:
        pipe.send("ready")
        await asyncio.Event().wait()


async def run_person(settings: Settings, key: bytes, pipe: Any) -> None:
    """The person's process: it demands a job on request, and waits for its end."""
    objective = Path(settings.data_dir) / "objective.mcap"
    async with Agent(MODEL, settings=settings, account=Account(key)) as person, asyncio.timeout(None):
        pipe.send("ready")
        while await asyncio.to_thread(pipe.recv):
            write_objective(objective)
            contract = await person.demand(objective, cost=1)
            outcome = await contract.outcome()
            await contract.recording()
            pipe.send(outcome.success)


def write_objective(path: Path) -> None:
    """Write an objective with one message, another one each time, as a job's mostly is."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/do", "json", 0)
        writer.add_message(channel, log_time=0, publish_time=0, data=json.dumps(secrets.token_hex()).encode())
        writer.finish()  # type: ignore[no-untyped-call]


def run(role: str, settings: Settings, key: bytes, pipe: Any) -> None:
    """A process of one role."""
    logging.getLogger("mesh").setLevel(logging.ERROR)
    main = {"provider": run_provider, "robot": run_robot, "person": run_person}[role]
    asyncio.run(main(settings, key, pipe))


class Market:
    """The processes of one market by role, and the proxy that counts."""

    def __init__(self, seen: Calls, person: Any, processes: dict[str, int]) -> None:
        self.seen = seen
        self.processes = processes
        self._person = person

    async def job(self) -> None:
        """One job, to the payment."""
        self._person.send(True)
        assert await asyncio.to_thread(self._person.poll, TIMEOUT), "the job takes too long"
        assert self._person.recv(), "the job failed"


@asynccontextmanager
async def market_of(case: Case) -> AsyncIterator[tuple[Market, Chain]]:
    """The market of a case, ready, and the chain to look at without being counted."""
    async with AsyncExitStack() as stack:
        program, is_quick = find_anvil(locate("anvil")), case.block_time < 1
        assert program is not None
        node = await stack.enter_async_context(
            serve_anvil(program, host="127.0.0.1", port=0, block_time=case.block_time if is_quick else None, state=None)
        )
        market = await deploy_market(node.url, node.funded_keys)
        endpoint, _ = stack.enter_context(router())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        chain = await stack.enter_async_context(market.chain(node.url, "person"))
        if case.chain:
            await chain.node.request("anvil_setChainId", CHAINS[case.chain].chain_id)
        await chain.node.request("evm_setAutomine", False)
        if not is_quick:
            # As on a chain that is older than the market: its deployment came at another pace.
            await chain.node.request("anvil_mine", PACE_BLOCKS, int(case.block_time))
            await chain.node.request("evm_setIntervalMining", int(case.block_time))
        proxy = CountingProxy(node.url)
        port = await stack.enter_async_context(proxy.serve())
        pipes, processes = {}, {}
        for role, key in zip(ROLES, node.funded_keys, strict=False):
            settings = Settings(
                chain=case.chain,  # type: ignore[arg-type]  # a name of CHAINS
                connect=(endpoint,),
                data_dir=str(folder / role),
                web3_http_provider=f"{case.scheme}://127.0.0.1:{port}/{role}",
                ens_contract=market.deployment.ens,
                lighthouse_contract=market.deployment.lighthouse_name,
                playback="at-once",
                free_contracts=1_000_000,
            )
            await asyncio.to_thread(Path(settings.data_dir).mkdir)
            pipes[role], theirs = SPAWN.Pipe()
            process = SPAWN.Process(target=run, args=(role, settings, key, theirs), daemon=True)
            process.start()
            assert process.pid is not None
            processes[role] = process.pid
            stack.callback(process.join)
            stack.callback(process.terminate)
        for role, pipe in pipes.items():
            assert await asyncio.to_thread(pipe.poll, TIMEOUT), f"{role} does not start"
            pipe.recv()
        yield Market(proxy.seen, pipes["person"], processes), chain


async def measure(case: Case, jobs: int, idle: int) -> dict[str, Any]:
    """The calls of `jobs` jobs, and of `idle` seconds without any."""
    async with market_of(case) as (market, chain):
        await market.job()
        await asyncio.sleep(SETTLE_SECONDS)
        market.seen.clear()
        began, first = time.monotonic(), await chain.block_number()
        for _ in range(jobs):
            await market.job()
        seconds, blocks = time.monotonic() - began, await chain.block_number() - first
        of_jobs = market.seen.by_role(1 / jobs)
        await asyncio.sleep(SETTLE_SECONDS)
        market.seen.clear()
        began, first = time.monotonic(), await chain.block_number()
        await asyncio.sleep(idle)
        minutes, idle_blocks = (time.monotonic() - began) / 60, await chain.block_number() - first
        most = max(market.seen.of(role) for role in ROLES)
        return {
            "per_job": round(sum(role["calls"] for role in of_jobs.values()), 2),
            "blocks_a_job": round(blocks / jobs, 2),
            "seconds_a_job": round(seconds / jobs, 2),
            "idle_minute": round(most / minutes, 2),
            "idle_block": round(most / max(idle_blocks, 1), 2),
            "job": of_jobs,
            "idle": market.seen.by_role(1 / minutes),
        }


async def measure_all(options: Any) -> dict[str, Any]:
    """All cases at the same time, and the worst of each figure."""
    chosen = [case for case in CASES if options.case in ("all", case.name)]
    if options.chain != "none":
        chosen = [Case(options.chain, CHAINS[options.chain].block_seconds, "http", options.chain)]
    found = await asyncio.gather(*(measure(case, options.jobs, options.idle) for case in chosen))
    jobs = [result["per_job"] for case, result in zip(chosen, found, strict=True) if case.block_time == 12]
    slow = [result["idle_minute"] for case, result in zip(chosen, found, strict=True) if case.block_time == 12]
    fast = [result["idle_block"] for case, result in zip(chosen, found, strict=True) if case.block_time != 12]
    return {
        "per_job": max(jobs, default=0.0),
        "idle_minute": max(slow, default=0.0),
        "idle_block": max(fast, default=0.0),
        "cases": {case.name: result for case, result in zip(chosen, found, strict=True)},
    }


def main() -> None:
    """Run the benchmark."""
    names = tuple(case.name for case in CASES)
    options = arguments(
        "calls to the node, a job and an idle minute", jobs=4, idle=60, case=("all", *names), chain=("none", *CHAINS)
    )
    logging.getLogger("aiohttp.server").setLevel(logging.CRITICAL)  # it complains of processes that end
    results = asyncio.run(measure_all(options))
    if options.json:
        print(json.dumps(results))
    else:
        for name, found in results["cases"].items():
            print(f"{name:<14} {found['per_job']:6} a job  {found['idle_minute']:6} a minute and process when idle")
    limits = {"per_job": CALLS_PER_JOB, "idle_minute": IDLE_MINUTE, "idle_block": IDLE_BLOCK}
    if options.chain != "none":
        return
    missed = [f"{name} {results[name]} (at most {limit})" for name, limit in limits.items() if results[name] > limit]
    if missed:
        sys.exit(f"above the limit: {', '.join(missed)}")


if __name__ == "__main__":
    main()
