"""An honest person's demands on an open market during floods: `--only NAME` runs one flood of `bench/floods.py`.

A router, a chain, a provider, a robot, a person who demands a job every two seconds and an attacker are processes of
their own. Measured are the seconds from a demand to its contract, before, during, and from five seconds after the
flood, and the most memory that provider and robot had. Each flood has a market of its own. The attacker stands for
another machine, so it runs at low priority.

Bars: every honest demand succeeds; during the flood p50 is at most 2 times and p99 at most 4 times that of before, and
after it, too, where less than half a block before counts as half a block; provider and robot stay under 200 MB. The
exit status is 1 if a flood misses one.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import os
import queue
import random
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import bridge_flood
from floods import FLOODS, Attacker

from common import SPAWN, installed_anvil, router

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # `peers` finds anvil

from mesh import Agent
from mesh.dev.demo import write_objective
from mesh.dev.development import serve_chain
from mesh.network import Endpoints, Network
from mesh.settings import Settings
from schemas import cid_of_bytes, cid_of_file

if TYPE_CHECKING:
    from mesh.dev.development import DevelopmentChain
    from schemas import Demand, Verified

MODEL: Final = cid_of_bytes(b"what the robot of the benchmark can do")
INTERVAL: Final = 2.0
"""Seconds between two honest demands, on average: random, because they must not keep time with polls of the chain."""
BEFORE, DURING, AFTER = 24.0, 24.0, 16.0
"""Seconds of each part of a measurement."""
RECOVERY: Final = 5.0
"""Seconds after a flood until the market must be as before."""
PATIENCE: Final = 40.0
"""Seconds after which a demand without a contract has failed."""
DEADLINE: Final = 400
"""Blocks until the deadline of the attacker's orders."""
BRIDGE_FLOOD: Final = "bridge-dead-cids"
"""The flood of `bridge_flood.py`, which has a bridge and IPFS daemons instead of a market."""
P50_BAR, P99_BAR, MEMORY_BAR = 2.0, 4.0, 200.0
BLOCK_TIME: Final = 1.0
"""Seconds between blocks. A demand waits for half of that on average; a dozen demands may have waited less by luck."""
START: Final = 90.0


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where the market is; processes get it as an argument."""

    endpoint: str
    node: str
    ens: str
    lighthouse: str
    keys: str
    folder: str

    def settings(self, role: str) -> Settings:
        return Settings(
            connect=(self.endpoint,),
            web3_http_provider=self.node,
            ens_contract=self.ens,
            lighthouse_contract=self.lighthouse,
            keyfile=f"{self.keys}/{role}.json",
            keyfile_password_file=f"{self.keys}/password",
            data_dir=f"{self.folder}/{role}",
            playback="at-once",
            free_contracts=1_000_000,
        )


def robot(place: Place, ready: Any) -> None:
    """The robot's process."""
    agent = Agent(MODEL, settings=place.settings("robot"))

    @agent.on("*")
    async def play(job: Any, message: Any) -> None:
        job.publish("/said", "done")

    @agent.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await agent.offer(demand)

    async def serve() -> None:
        async with agent:
            ready.set()
            await asyncio.Event().wait()

    logging.getLogger("mesh").setLevel(logging.CRITICAL)
    asyncio.run(serve())


def person(place: Place, ready: Any, taken: Any) -> None:
    """The person's process: puts when each demand began into `taken`, and again with its seconds, -1 if it failed."""
    logging.getLogger("mesh").setLevel(logging.CRITICAL)
    asyncio.run(_demand(place, ready, taken))


async def _demand(place: Place, ready: Any, taken: Any) -> None:
    objective = Path(place.folder) / "objective.mcap"

    async def demand(agent: Agent) -> None:
        began, seconds = time.monotonic(), -1.0
        taken.put((began, None))
        with suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE):
                await agent.demand(objective, cost=1)
                seconds = time.monotonic() - began
        taken.put((began, seconds))

    async with Agent(MODEL, settings=place.settings("person")) as agent:
        await agent.demand(objective, cost=1)  # it also approves allowances
        ready.set()
        async with asyncio.TaskGroup() as demands:
            while True:
                demands.create_task(demand(agent))
                await asyncio.sleep(INTERVAL * random.uniform(0.5, 1.5))


def attack(name: str, facts: dict[str, Any], endpoint: str, ready: Any, begin: Any, done: Any) -> None:
    """The attacker's process."""
    os.nice(10)
    asyncio.run(_attack(name, facts, endpoint, ready, begin, done))


async def _attack(name: str, facts: dict[str, Any], endpoint: str, ready: Any, begin: Any, done: Any) -> None:
    async def wait() -> None:
        ready.set()
        await asyncio.to_thread(begin.wait)

    async with Network(Endpoints(connect=(endpoint,))) as network:
        attacking = asyncio.create_task(FLOODS[name](Attacker(session=network.session, begin=wait, **facts)))
        await asyncio.to_thread(begin.wait)
        _, (finished, _) = await asyncio.gather(asyncio.sleep(DURING), asyncio.wait({attacking}, timeout=DURING))
        attacking.cancel()
        for each in finished:
            each.result()  # raises what went wrong
        done.set()


async def measure(name: str) -> dict[str, Any]:
    """Run one flood on a market of its own."""
    async with AsyncExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        endpoint, pid = stack.enter_context(router())
        served = await stack.enter_async_context(
            serve_chain(
                Settings(data_dir=folder), host="127.0.0.1", port=0, block_time=BLOCK_TIME, anvil=installed_anvil()
            )
        )
        place = Place(
            endpoint=endpoint,
            node=served.url,
            ens=served.market.deployment.ens,
            lighthouse=served.market.deployment.lighthouse_name,
            keys=str(served.keys),
            folder=folder,
        )
        write_objective(Path(folder) / "objective.mcap")
        return await _measure(stack, name, place, served, router_pid=pid)


async def _measure(
    stack: AsyncExitStack, name: str, place: Place, served: DevelopmentChain, *, router_pid: int
) -> dict[str, Any]:
    provider = _start_provider(place)
    stack.callback(_stop, provider)
    ready, taken = {role: SPAWN.Event() for role in ("robot", "person", "attacker")}, SPAWN.Queue()
    processes = {"robot": await _start(stack, robot, (place, ready["robot"]), ready["robot"])}
    await _start(stack, person, (place, ready["person"], taken), ready["person"])
    begin, done = SPAWN.Event(), SPAWN.Event()
    facts = await _facts(place, served)
    await _start(stack, attack, (name, facts, place.endpoint, ready["attacker"], begin, done), ready["attacker"])
    await asyncio.sleep(BEFORE)
    started = time.monotonic()
    begin.set()
    await asyncio.to_thread(done.wait)
    ended = time.monotonic()
    await asyncio.sleep(RECOVERY + AFTER)
    until = time.monotonic()
    demands = await _collect(taken, until)
    pids = {"provider": provider.pid, "robot": processes["robot"].pid, "router": router_pid}
    memory = {f"{who}_mb": _peak(pid) for who, pid in pids.items()}
    parts = {
        "before": [seconds for at, seconds in demands if at < started],
        "during": [seconds for at, seconds in demands if started <= at < ended],
        "after": [seconds for at, seconds in demands if ended + RECOVERY <= at < until],
    }
    return _judged({"success": _success(demands), **{part: _times(parts[part]) for part in parts}, **memory})


async def _facts(place: Place, served: DevelopmentChain) -> dict[str, Any]:
    market = served.market
    async with market.chain(served.url, "person") as chain:
        head = await chain.block_number()
    return {
        "lighthouse": place.lighthouse.lower(),
        "address": market.deployment.lighthouse,
        "xrt": market.deployment.xrt,
        "model": MODEL,
        "objective": cid_of_file(Path(place.folder) / "objective.mcap"),
        "deadline": head + DEADLINE,
        "robot": market.accounts["robot"].address.lower(),
    }


async def _start(stack: AsyncExitStack, target: Any, arguments: tuple[Any, ...], ready: Any) -> Any:
    process = SPAWN.Process(target=target, args=arguments, daemon=True)
    process.start()
    stack.callback(_stop, process)
    assert await asyncio.to_thread(ready.wait, START), f"{target.__name__} is not ready"
    return process


def _start_provider(place: Place) -> subprocess.Popen[bytes]:
    settings = place.settings("provider")
    names = (
        "connect",
        "web3_http_provider",
        "ens_contract",
        "lighthouse_contract",
        "keyfile",
        "keyfile_password_file",
        "free_contracts",
    )
    values = {name: getattr(settings, name) for name in (*names, "data_dir")} | {"connect": place.endpoint}
    options = [word for name, value in values.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    words = [sys.executable, "-m", "mesh", "provider", *options, "--log-level", "error"]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL)


def _stop(process: Any) -> None:
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(10) if isinstance(process, subprocess.Popen) else process.join(10)
    process.kill()


async def _collect(taken: Any, until: float) -> list[tuple[float, float]]:
    """When each demand before `until` began, and its seconds. Waits for those that are open."""
    found: dict[float, float | None] = {}
    while time.monotonic() < until + PATIENCE + INTERVAL:
        with suppress(queue.Empty):
            began, seconds = await asyncio.to_thread(taken.get, True, 0.2)
            found[began] = seconds
            continue
        if all(seconds is not None for began, seconds in found.items() if began < until):
            break
    return [(began, -1.0 if seconds is None else seconds) for began, seconds in found.items() if began < until]


def _success(demands: list[tuple[float, float]]) -> float:
    return round(sum(seconds >= 0 for _, seconds in demands) / max(len(demands), 1), 3)


def _times(seconds: list[float]) -> dict[str, float]:
    """Percentiles; a demand that failed took all the patience."""
    whole = sorted(PATIENCE if one < 0 else one for one in seconds) or [PATIENCE]
    p99 = statistics.quantiles(whole, n=100, method="inclusive")[98] if len(whole) > 1 else whole[0]
    return {"demands": len(seconds), "p50_s": round(statistics.median(whole), 2), "p99_s": round(p99, 2)}


def _peak(pid: int) -> float:
    """The most memory that a process had resident, MB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return round(int(line.split()[1]) * 1024 / 1e6, 1)
    raise ValueError(f"no memory of {pid}")


def _judged(results: dict[str, Any]) -> dict[str, Any]:
    """The results with the bars that they miss."""
    quiet, missed = results["before"], []
    for part in ("during", "after"):
        for name, bar in (("p50_s", P50_BAR), ("p99_s", P99_BAR)):
            if (times := results[part][name] / max(quiet[name], BLOCK_TIME / 2)) > bar:
                missed.append(f"{name} {part} is {times:.1f} times that of before")
    missed += [f"{name} is {results[name]}" for name in ("provider_mb", "robot_mb") if results[name] >= MEMORY_BAR]
    if results["success"] < 1:
        missed.append(f"only {results['success']:.0%} of the demands succeeded")
    return results | {"missed": missed}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description="an open market during floods")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--only", choices=sorted([*FLOODS, BRIDGE_FLOOD]), help="run this flood only")
    options = parser.parse_args()
    results = {}
    for name in [options.only] if options.only else [*FLOODS, BRIDGE_FLOOD]:
        results[name] = asyncio.run(bridge_flood.measure_all() if name == BRIDGE_FLOOD else measure(name))
        if not options.json:
            print(name, json.dumps(results[name]), sep="  ", flush=True)
    if options.json:
        print(json.dumps(results))
    sys.exit(any(result["missed"] for result in results.values()))


if __name__ == "__main__":
    main()
