"""Many on one router: what the router needs for each session, what reaches subscribers, what a device's process takes.

Memory is the proportional set size (PSS): what processes share is counted once for all of them.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import pty
import subprocess
import sys
import time
from contextlib import AsyncExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace
from zenoh import CongestionControl

from mesh.network import Channel, Endpoints, Network, free_endpoint, message_key
from messages import route
from orders import ADDRESS, LIGHTHOUSE, signed_demands
from schemas import Demand, cid_of_bytes, encode
from schemas.keys import market_selector

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

SPAWN: Final = multiprocessing.get_context("spawn")
A_PROCESS: Final = 50
"""Sessions that one process holds."""
SETTLING: Final = 1.0
"""Seconds until what was declared has got around, and memory is at rest."""
PATIENCE: Final = 120.0
WINDOW: Final = 2000
"""Messages under way at most, so that none is lost."""


def memory(pid: int) -> float:
    """MiB of a process."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) / 1024
    raise ValueError(f"no memory of {pid}")


@contextmanager
def router() -> Iterator[tuple[str, int]]:
    """A router in a process of its own: its endpoint and its process id."""
    endpoint = free_endpoint()
    process = SPAWN.Process(target=route, args=(endpoint,), daemon=True)
    process.start()
    assert process.pid is not None
    try:
        yield endpoint, process.pid
    finally:
        process.terminate()
        process.join()


def sessions(counts: Sequence[int]) -> list[dict[str, float]]:
    """For each number of agents that are there, each a session with a token and a subscription to its model's demands:
    memory of the router, and the seconds in which somebody who asks is told of all of them."""
    found = []
    crowds: list[Any] = []
    with router() as (endpoint, pid):
        empty = None
        try:
            for count in sorted(counts):
                while (missing := count - sum(size for _, size, _ in crowds)) > 0:
                    crowds.append(_gathered(endpoint, min(A_PROCESS, missing), first=sum(one[1] for one in crowds)))
                time.sleep(SETTLING)
                seconds = asyncio.run(_roll_call(endpoint, count))
                now = memory(pid)
                empty = now if empty is None else empty
                found.append({"sessions": count, "router_mib": round(now, 1), "roll_call_ms": round(seconds * 1e3, 1)})
        finally:
            for process, _, leave in crowds:
                leave.set()
                process.join()
    return found


def _gathered(endpoint: str, size: int, *, first: int) -> tuple[Any, int, Any]:
    there, leave = SPAWN.Event(), SPAWN.Event()
    process = SPAWN.Process(target=crowd, args=(endpoint, first, size, there, leave), daemon=True)
    process.start()
    assert there.wait(PATIENCE), "the sessions did not open"
    return process, size, leave


def crowd(endpoint: str, first: int, size: int, there: Any, leave: Any) -> None:
    """A process with many sessions."""
    asyncio.run(_crowd(endpoint, first, size, there, leave))


async def _crowd(endpoint: str, first: int, size: int, there: Any, leave: Any) -> None:
    async with AsyncExitStack() as stack:
        for number in range(first, first + size):
            network = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
            channel = await stack.enter_async_context(Channel(network.session, LIGHTHOUSE, address=ADDRESS))
            await stack.enter_async_context(channel.subscribe(Demand, model=model(number)))
            channel.announce("agent", f"0x{number:040x}")
        there.set()
        await asyncio.to_thread(leave.wait)


async def _roll_call(endpoint: str, count: int) -> float:
    """Seconds until somebody who asks has heard of everybody; a connection to begin with is not counted."""
    async with (
        Network(Endpoints(connect=(endpoint,))) as network,
        Channel(network.session, LIGHTHOUSE, address=ADDRESS) as channel,
    ):
        deadline = time.monotonic() + PATIENCE
        while True:
            started = time.perf_counter()
            present = len(await channel.present())
            if present == count:
                return time.perf_counter() - started
            assert time.monotonic() < deadline, f"{present} of {count} are there"


def model(number: int) -> str:
    """What an agent can do, another thing each."""
    return cid_of_bytes(f"model {number}".encode())


def filtered(counts: Sequence[int], messages: int) -> list[dict[str, float]]:
    """For each number of subscribers, each to its own model: messages a second of all models together that get from
    one publisher through the router to whom they concern."""
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
    """Seconds that the messages took, and those of processor time that the router took for them."""
    heard, ready, leave = SPAWN.Value("l", 0), SPAWN.Event(), SPAWN.Event()
    listening = SPAWN.Process(target=listen, args=(endpoint, count, heard, ready, leave), daemon=True)
    listening.start()
    assert await asyncio.to_thread(ready.wait, PATIENCE)
    (demand,) = signed_demands(1)  # what counts is its size
    wire = [(message_key(LIGHTHOUSE, replace(demand, model=model(number))), encode(demand)) for number in range(count)]
    async with Network(Endpoints(connect=(endpoint,))) as network:
        await asyncio.sleep(SETTLING)
        before, started = _seconds_of(pid), time.perf_counter()
        for number in range(messages):
            while number - heard.value >= WINDOW:
                await asyncio.sleep(0.0005)
            key, payload = wire[number % count]
            network.session.put(key, payload, congestion_control=CongestionControl.BLOCK)
        deadline = time.monotonic() + PATIENCE
        while heard.value < messages:
            assert time.monotonic() < deadline, f"{heard.value} of {messages} came"
            await asyncio.sleep(0.001)
        seconds, used = time.perf_counter() - started, _seconds_of(pid) - before
    leave.set()
    listening.join()
    return seconds, used


def listen(endpoint: str, count: int, heard: Any, ready: Any, leave: Any) -> None:
    """A process with many subscribers, a session each, which count and do nothing else."""
    asyncio.run(_listen(endpoint, count, heard, ready, leave))


async def _listen(endpoint: str, count: int, heard: Any, ready: Any, leave: Any) -> None:
    def hear(_: Any) -> None:
        with heard.get_lock():
            heard.value += 1

    async with AsyncExitStack() as stack:
        for number in range(count):
            network = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
            network.session.declare_subscriber(market_selector(LIGHTHOUSE, "demand", model(number)), hear)
        ready.set()
        await asyncio.to_thread(leave.wait)


def _seconds_of(pid: int) -> float:
    """Processor time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def devices(count: int) -> dict[str, float]:
    """Edge processes on lines on which nobody answers, at rest: memory of each, and how much of a core all take."""
    lines = [pty.openpty() for _ in range(count)]
    with router() as (endpoint, _):
        processes = [_edge(endpoint, number, line) for number, (_, line) in enumerate(lines)]
        try:
            time.sleep(3 + SETTLING * count / 4)
            before, started = sum(_seconds_of(process.pid) for process in processes), time.perf_counter()
            time.sleep(5)
            core = (sum(_seconds_of(process.pid) for process in processes) - before) / (time.perf_counter() - started)
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
