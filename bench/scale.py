"""A market of many agents on three linked routers: what a message costs the routers, and whether any is lost.

Each agent has a session, a subscription to demands for its own model and a presence token, and answers each demand with
an offer. People on all three routers send demands; a listener on one of them receives all offers, as a
provider does. The bars: no order lost or misdirected, the routers' processor time per message at the highest number of
agents at most twice that at the lowest, all agents declared within ten seconds.

Besides the jobs, the routers' time is measured for messages on keys that nobody subscribes to: demands for models that
no agent serves, and events of agents.
"""

from __future__ import annotations

import asyncio
import sys
import time
from argparse import ArgumentParser
from contextlib import AsyncExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from zenoh import CongestionControl
from zenoh.handlers import FifoChannel

from common import ADDRESS, LIGHTHOUSE, SPAWN, TOKEN, show
from mesh.network import Channel, Endpoints, MarketRules, Network, free_endpoint
from mesh.network.endpoints import allow_sessions
from schemas import (
    ZERO_ADDRESS,
    Demand,
    EventKey,
    Offer,
    PresenceKey,
    RpcKey,
    Signer,
    cid_of_bytes,
    encode,
    market_selector,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

ROUTERS: Final = 3
AGENTS_PER_PROCESS: Final = 125
MAX_SESSIONS: Final = 10_000
LEASE: Final = 120.0
"""Seconds without processor time that a session survives: thousands of agents start on a few cores at once."""
IN_FLIGHT: Final = 8
"""Jobs at a time: fewer than agents, or messages to one agent would travel together."""
JOB_TIMEOUT: Final = 30.0
"""Seconds after which an order that has no answer counts as lost."""
START_TIMEOUT: Final = 600.0
DECLARED_WITHIN: Final = 10.0
FLAT: Final = 2.0


class Routers(NamedTuple):
    """Three linked routers, each a process: endpoints and process ids."""

    endpoints: tuple[str, ...]
    pids: tuple[int, ...]

    def seconds(self) -> float:
        """Processor time of all, to the nanosecond."""
        return sum(map(seconds_of, self.pids))


@contextmanager
def routers() -> Iterator[Routers]:
    """Start and stop them. Each connects to those before it."""
    endpoints = tuple(free_endpoint() for _ in range(ROUTERS))
    started = [
        SPAWN.Process(target=_route, args=(endpoint, endpoints[:number]), daemon=True)
        for number, endpoint in enumerate(endpoints)
    ]
    for process in started:
        process.start()
    try:
        yield Routers(endpoints, tuple(process.pid for process in started if process.pid is not None))
    finally:
        for process in started:
            process.terminate()
            process.join()


def _route(endpoint: str, others: tuple[str, ...]) -> None:
    async def run() -> None:
        at = Endpoints(listen=(endpoint,), connect=others, mode="router", max_sessions=MAX_SESSIONS, lease=LEASE)
        async with Network(at):
            await asyncio.Event().wait()

    allow_sessions(MAX_SESSIONS)
    asyncio.run(run())


def seconds_of(pid: int) -> float:
    """Processor time of all threads of a process."""
    spent = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            spent += int((task / "schedstat").read_text().split()[0])
        except (OSError, IndexError):
            continue
    return spent / 1e9


def memory(pid: int) -> float:
    """Proportional set size of a process, MiB: it counts shared memory once."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024


def model(number: int) -> str:
    """The model of an agent; each has another one."""
    return cid_of_bytes(f"model {number}".encode())


class Agents:
    """Processes with many agents each, which start at the same moment."""

    def __init__(self, endpoints: Sequence[str], count: int) -> None:
        self.go, self.leave, self.wrong = SPAWN.Event(), SPAWN.Event(), SPAWN.Value("l", 0)
        self._ready = SPAWN.Semaphore(0)
        shares = [range(first, min(first + AGENTS_PER_PROCESS, count)) for first in range(0, count, AGENTS_PER_PROCESS)]
        self.processes = [
            SPAWN.Process(target=run_agents, args=(endpoints, share, self), daemon=True) for share in shares
        ]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "processes"}

    def start(self) -> None:
        """Start the processes; they wait for `go`."""
        for process in self.processes:
            process.start()
        for _ in self.processes:
            assert self._ready.acquire(timeout=START_TIMEOUT), "the processes did not start"

    def is_ready(self) -> None:
        """A process waits for `go`."""
        self._ready.release()

    def memory(self) -> float:
        """MiB of all processes."""
        return sum(memory(process.pid) for process in self.processes if process.pid is not None)

    def stop(self) -> None:
        """End all processes."""
        self.go.set()
        self.leave.set()
        for process in self.processes:
            process.join(60)
            process.kill()


def run_agents(endpoints: Sequence[str], numbers: range, agents: Agents) -> None:
    """A process with an agent for each number."""
    allow_sessions(MAX_SESSIONS)
    agents.is_ready()
    agents.go.wait()
    asyncio.run(_run_agents(endpoints, numbers, agents))


async def _run_agents(endpoints: Sequence[str], numbers: range, agents: Agents) -> None:
    async with AsyncExitStack() as stack, asyncio.TaskGroup() as tasks:
        opening = asyncio.Semaphore(2)  # more at a time would make each other time out

        async def open_agent(number: int) -> None:
            async with opening:
                at = Endpoints(connect=(endpoints[number % ROUTERS],), timeout=START_TIMEOUT, lease=LEASE)
                network = await stack.enter_async_context(Network(at))
            channel = await stack.enter_async_context(
                Channel(network.session, MarketRules(LIGHTHOUSE, address=ADDRESS))
            )
            demands = await stack.enter_async_context(channel.subscribe(Demand, model=model(number)))
            channel.announce("agent", f"0x{number:040x}")
            working.append(tasks.create_task(_work(channel, demands, number, agents)))

        working: list[asyncio.Task[None]] = []
        await asyncio.gather(*(open_agent(number) for number in numbers))
        await asyncio.to_thread(agents.leave.wait)
        for task in working:
            task.cancel()


async def _work(channel: Channel, demands: Any, number: int, agents: Agents) -> None:
    """Answer each demand with a signed offer of the same terms."""
    signer = Signer((number + 1).to_bytes(32, "big"))
    fields = ("model", "objective", "token", "cost", "lighthouse", "validator", "deadline", "nonce")
    async for demand in demands:
        if demand.message.model != model(number):
            with agents.wrong.get_lock():
                agents.wrong.value += 1
        terms = {field: getattr(demand.message, field) for field in fields}
        channel.publish(signer.sign(Offer(**terms, lighthouse_fee=0)))


async def jobs(at: Routers, count: int, number: int) -> dict[str, float]:
    """Exchange `number` demands and offers with `count` agents; the routers' processor time of a message."""
    lost = wrong = 0
    taken: list[float] = []
    person = Signer(b"\2" * 32)
    waiting: dict[str, asyncio.Future[None]] = {}
    async with AsyncExitStack() as stack:
        channels = [await _channel(stack, endpoint) for endpoint in at.endpoints]
        offers = await stack.enter_async_context(channels[1].subscribe(Offer))
        await _spread(channels, count)

        async def listen() -> None:
            nonlocal wrong
            async for offer in offers:
                answered = waiting.get(f"{offer.message.model} {offer.message.objective}")
                if answered is None or answered.done():
                    wrong += 1
                else:
                    answered.set_result(None)

        async def job(index: int) -> None:
            nonlocal lost
            objective = cid_of_bytes(f"{time.time_ns()} {index}".encode())
            demand = person.sign(_demand(model(index * 7919 % count), objective, index))
            answered = waiting[f"{demand.model} {objective}"] = asyncio.get_running_loop().create_future()
            started = time.perf_counter()
            channels[index % ROUTERS].publish(demand)
            try:
                async with asyncio.timeout(JOB_TIMEOUT):
                    await answered
                taken.append(time.perf_counter() - started)
            except TimeoutError:
                lost += 1

        listening = asyncio.create_task(listen())
        await _in_turn(job, min(number // 10, 200))
        taken.clear()
        before = at.seconds()
        await _in_turn(job, number)
        used = at.seconds() - before
        listening.cancel()
    taken.sort()
    return {
        "router_us": used / (2 * number) * 1e6,
        "lost": lost,
        "wrong": wrong,
        "p50_ms": taken[len(taken) // 2] * 1e3 if taken else 0.0,
        "p99_ms": taken[len(taken) * 99 // 100] * 1e3 if taken else 0.0,
    }


async def _in_turn(job: Any, number: int) -> None:
    """Run that many jobs, `IN_FLIGHT` at a time."""
    todo = iter(range(number))

    async def worker() -> None:
        for index in todo:
            await job(index)

    await asyncio.gather(*(worker() for _ in range(IN_FLIGHT)))


def _demand(of: str, objective: str, index: int) -> Demand:
    return Demand(
        model=of,
        objective=objective,
        token=TOKEN,
        cost=1000,
        lighthouse=ADDRESS,
        validator=ZERO_ADDRESS,
        validator_fee=0,
        deadline=2**40,
        nonce=f"{index + 2**200:064x}",
    )


async def _channel(stack: AsyncExitStack, endpoint: str) -> Channel:
    network = await stack.enter_async_context(
        Network(Endpoints(connect=(endpoint,), timeout=START_TIMEOUT, lease=LEASE))
    )
    return await stack.enter_async_context(Channel(network.session, MarketRules(LIGHTHOUSE, address=ADDRESS)))


async def _spread(channels: Sequence[Channel], count: int) -> None:
    """Wait until every router knows all agents."""
    deadline = time.monotonic() + START_TIMEOUT
    known: list[set[PresenceKey]] = [set() for _ in channels]
    for channel, agents in zip(channels, known, strict=True):
        channel.watch_presence(agents.add, gone=agents.discard, role="agent")
    while any(len(agents) != count for agents in known):
        assert time.monotonic() < deadline, f"{[len(agents) for agents in known]} of {count} agents are present"
        await asyncio.sleep(0.05)


async def unheard(at: Routers, count: int, messages: int) -> dict[str, float]:
    """Processor time of the routers for a message whose key nobody has subscribed to as such.

    One session declares a service for each agent meanwhile.
    """
    payload = encode(Signer(b"\2" * 32).sign(_demand(model(0), model(0), 0)))
    keys = {
        "unknown_model": [market_selector(LIGHTHOUSE, "demand", model(-1 - number)) for number in range(64)],
        "event": [str(EventKey(f"0x{number:040x}", f"0x{number:040x}", "ready")) for number in range(1, 65)],
    }
    found = {}
    async with AsyncExitStack() as stack:
        sender = (await _channel(stack, at.endpoints[0]))._session
        watcher = (await _channel(stack, at.endpoints[1]))._session
        for number in range(count):
            watcher.declare_queryable(str(RpcKey(f"0x{number:040x}", "status")), FifoChannel(1))
        passed = asyncio.Event()
        loop = asyncio.get_running_loop()
        watcher.declare_subscriber("aira/bench/passed", lambda _: loop.call_soon_threadsafe(passed.set))
        watcher.declare_subscriber(market_selector(LIGHTHOUSE, "demand"), lambda _: None)
        while not passed.is_set():  # the routers learn of one declaration after another
            sender.put("aira/bench/passed", b"")
            await asyncio.sleep(0.5)
        for name, texts in keys.items():
            passed.clear()
            before = at.seconds()
            for number in range(messages):
                sender.put(texts[number % len(texts)], payload, congestion_control=CongestionControl.BLOCK)
            sender.put("aira/bench/passed", b"", congestion_control=CongestionControl.BLOCK)
            await asyncio.wait_for(passed.wait(), START_TIMEOUT)
            found[f"{name}_us"] = (at.seconds() - before) / messages * 1e6
    return found


def measure(count: int, options: Any) -> dict[str, Any]:
    """All measurements with that many agents."""
    with routers() as at:
        asyncio.run(asyncio.sleep(1))
        empty = sum(map(memory, at.pids))
        agents = Agents(at.endpoints, count)
        agents.start()
        idle = agents.memory()
        try:
            started = time.perf_counter()
            agents.go.set()
            asyncio.run(_until_declared(at, count))
            declared = time.perf_counter() - started
            found: dict[str, Any] = asyncio.run(jobs(at, count, options.jobs))
            found |= asyncio.run(unheard(at, count, options.jobs))
            found["wrong"] += agents.wrong.value
            found["declared_s"] = declared
            found["router_kib_an_agent"] = (sum(map(memory, at.pids)) - empty) / count * 1024
            found["agent_mib"] = (agents.memory() - idle) / count
        finally:
            agents.stop()
    return found


async def _until_declared(at: Routers, count: int) -> None:
    async with AsyncExitStack() as stack:
        await _spread([await _channel(stack, endpoint) for endpoint in at.endpoints], count)


def judged(found: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """The results by number of agents, and which bars are missed."""
    counts = sorted(found)
    few, many = found[counts[0]], found[counts[-1]]
    lost, wrong = (sum(one[name] for one in found.values()) for name in ("lost", "wrong"))
    ratio = many["router_us"] / few["router_us"]
    bars = {
        "an order was lost": lost == 0,
        "an order was misdirected": wrong == 0,
        f"a message costs the routers {ratio:.1f} times as much": ratio <= FLAT,
        f"declaring took {many['declared_s']:.0f} s": many["declared_s"] <= DECLARED_WITHIN or counts[-1] > 1000,
    }
    names = [name for name in few if name not in ("lost", "wrong")]
    by_count = {name: {str(count): round(found[count][name], 2) for count in counts} for name in names}
    return {
        "agents": counts,
        "sessions": counts[-1],
        "lost": lost,
        "wrong": wrong,
        **by_count,
        "ratio": round(ratio, 2),
        "missed": [bar for bar, is_met in bars.items() if not is_met],
    }


def main() -> None:
    """Run the benchmark."""
    parser = ArgumentParser(description="many agents on three linked routers")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--agents", default="10,1000", help="numbers of agents, separated by commas")
    parser.add_argument("--jobs", type=int, default=3000, help="demands that are answered by an offer")
    options = parser.parse_args()
    allow_sessions(MAX_SESSIONS)
    results = judged({count: measure(count, options) for count in sorted(map(int, options.agents.split(",")))})
    show(results, as_json=options.json)
    sys.exit(bool(results["missed"]))


if __name__ == "__main__":
    main()
