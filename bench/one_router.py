"""Many sessions on one router: memory per session, messages to subscribers, and the cost of edge processes.

Memory is the proportional set size (PSS), which counts shared memory once.
"""

from __future__ import annotations

import asyncio
import os
import pty
import subprocess
import sys
import time
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace
from zenoh import CongestionControl

from common import ADDRESS, LIGHTHOUSE, SPAWN, router, signed_demands
from mesh.network import Channel, Endpoints, MarketRules, Network, message_key
from schemas import Demand, cid_of_bytes, encode
from schemas.keys import market_selector

if TYPE_CHECKING:
    from collections.abc import Sequence

SESSIONS_PER_PROCESS: Final = 50
SETTLE_TIME: Final = 1.0
"""Seconds until declarations have spread, and memory is stable."""
TIMEOUT: Final = 120.0
WINDOW: Final = 2000
"""Most messages in flight, so that none is lost."""


def memory(pid: int) -> float:
    """MiB of a process."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) / 1024
    raise ValueError(f"no memory of {pid}")


def sessions(counts: Sequence[int]) -> list[dict[str, float]]:
    """For each number of agents: memory of the router, and the time of a query for all agents that are present.

    Each agent is a session with a presence token and a subscription to the demands for its model.
    """
    found = []
    processes: list[Any] = []
    with router() as (endpoint, pid):
        empty = None
        try:
            for count in sorted(counts):
                while (missing := count - sum(size for _, size, _ in processes)) > 0:
                    processes.append(
                        _agents(endpoint, min(SESSIONS_PER_PROCESS, missing), first=sum(one[1] for one in processes))
                    )
                time.sleep(SETTLE_TIME)
                seconds = asyncio.run(_query_presence(endpoint, count))
                now = memory(pid)
                empty = now if empty is None else empty
                found.append({"sessions": count, "router_mib": round(now, 1), "roll_call_ms": round(seconds * 1e3, 1)})
        finally:
            for process, _, leave in processes:
                leave.set()
                process.join()
    return found


def _agents(endpoint: str, size: int, *, first: int) -> tuple[Any, int, Any]:
    ready, leave = SPAWN.Event(), SPAWN.Event()
    process = SPAWN.Process(target=run_agents, args=(endpoint, first, size, ready, leave), daemon=True)
    process.start()
    assert ready.wait(TIMEOUT), "the sessions did not open"
    return process, size, leave


def run_agents(endpoint: str, first: int, size: int, ready: Any, leave: Any) -> None:
    """A process with many sessions."""
    asyncio.run(_run_agents(endpoint, first, size, ready, leave))


async def _run_agents(endpoint: str, first: int, size: int, ready: Any, leave: Any) -> None:
    async with AsyncExitStack() as stack:
        for number in range(first, first + size):
            network = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
            channel = await stack.enter_async_context(
                Channel(network.session, MarketRules(LIGHTHOUSE, address=ADDRESS))
            )
            await stack.enter_async_context(channel.subscribe(Demand, model=model(number)))
            channel.announce("agent", f"0x{number:040x}")
        ready.set()
        await asyncio.to_thread(leave.wait)


async def _query_presence(endpoint: str, count: int) -> float:
    """Seconds of a query that is answered with all agents; connecting is not counted."""
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, MarketRules(LIGHTHOUSE, address=ADDRESS)) as channel,
    ):
        deadline = time.monotonic() + TIMEOUT
        while True:
            started = time.perf_counter()
            present = len(await channel.present())
            if present == count:
                return time.perf_counter() - started
            assert time.monotonic() < deadline, f"{present} of {count} are present"


def model(number: int) -> str:
    """The model of an agent; each has another one."""
    return cid_of_bytes(f"model {number}".encode())


def filtered(counts: Sequence[int], messages: int) -> list[dict[str, float]]:
    """For each number of subscribers, each to its own model: messages per second from one publisher to all of them."""
    found = []
    for count in counts:
        with router() as (endpoint, pid):
            seconds, used = asyncio.run(_through(endpoint, pid, count, messages))
            found.append(
                {
                    "subscribers": count,
                    "messages_per_second": round(messages / seconds),
                    "router_us_a_message": round(used / messages * 1e6, 1),
                }
            )
    return found


async def _through(endpoint: str, pid: int, count: int, messages: int) -> tuple[float, float]:
    """Seconds that the messages took, and the router's processor time in seconds."""
    received, ready, leave = SPAWN.Value("l", 0), SPAWN.Event(), SPAWN.Event()
    subscribers = SPAWN.Process(target=subscribe, args=(endpoint, count, received, ready, leave), daemon=True)
    subscribers.start()
    assert await asyncio.to_thread(ready.wait, TIMEOUT)
    (demand,) = signed_demands(1)  # only its size matters
    wire = [(message_key(LIGHTHOUSE, replace(demand, model=model(number))), encode(demand)) for number in range(count)]
    async with Network(Endpoints(connect=(endpoint,))) as network:
        await asyncio.sleep(SETTLE_TIME)
        before, started = seconds_of(pid), time.perf_counter()
        for number in range(messages):
            while number - received.value >= WINDOW:
                await asyncio.sleep(0.0005)
            key, payload = wire[number % count]
            network.session.put(key, payload, congestion_control=CongestionControl.BLOCK)
        deadline = time.monotonic() + TIMEOUT
        while received.value < messages:
            assert time.monotonic() < deadline, f"{received.value} of {messages} arrived"
            await asyncio.sleep(0.001)
        seconds, used = time.perf_counter() - started, seconds_of(pid) - before
    leave.set()
    subscribers.join()
    return seconds, used


def subscribe(endpoint: str, count: int, received: Any, ready: Any, leave: Any) -> None:
    """A process with many subscribers, each with its own session, that only count."""
    asyncio.run(_subscribe(endpoint, count, received, ready, leave))


async def _subscribe(endpoint: str, count: int, received: Any, ready: Any, leave: Any) -> None:
    def count_one(_: Any) -> None:
        with received.get_lock():
            received.value += 1

    async with AsyncExitStack() as stack:
        for number in range(count):
            network = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
            network.session.declare_subscriber(market_selector(LIGHTHOUSE, "demand", model(number)), count_one)
        ready.set()
        await asyncio.to_thread(leave.wait)


def seconds_of(pid: int) -> float:
    """Processor time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def devices(count: int) -> dict[str, float]:
    """Idle edge processes on lines without a board: memory of each, and the processor time of all."""
    lines = [pty.openpty() for _ in range(count)]
    with router() as (endpoint, _):
        processes = [_edge(endpoint, number, line) for number, (_, line) in enumerate(lines)]
        try:
            time.sleep(3 + SETTLE_TIME * count / 4)
            before, started = sum(seconds_of(process.pid) for process in processes), time.perf_counter()
            time.sleep(5)
            core = (sum(seconds_of(process.pid) for process in processes) - before) / (time.perf_counter() - started)
            used = [memory(process.pid) for process in processes]
        finally:
            for process in processes:
                process.terminate()
                process.wait()
    return {
        "devices": count,
        "edge_mib": round(sum(used) / count, 1),
        "of_a_core_each_percent": round(core / count * 100, 2),
        "devices_a_gib": int(1024 / (sum(used) / count)),
    }


def _edge(endpoint: str, number: int, line: int) -> subprocess.Popen[bytes]:
    words = ["edge", os.ttyname(line), "--agent", ADDRESS, "--name", f"d{number}", "--connect", endpoint]
    return subprocess.Popen(
        [sys.executable, "-m", "mesh", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
