"""A live view in Foxglove: messages of a job from a robot's session to a client of the view, as many a second as said.

Robot, router, view and client are a process each. `p50_ms` and `p99_ms` are from the robot's `put` to the client's
frame; `lost` is the part of the messages that did not come between the first and last that did; `view_cores` is what
the view needed of one core, front and SDK included. For each encoding.
"""

from __future__ import annotations

import asyncio
import json
import os
import struct
import time
from typing import Any, Final

import websockets

from bridges.foxglove.server import FoxgloveFront, FoxgloveOptions, FoxgloveServer
from bridges.foxglove.sources import show_job
from common import SPAWN, arguments, process, router, show
from mesh.base.flood import Drops
from mesh.network import Endpoints, Network
from schemas.keys import LiabilityTopicKey

ROBOT: Final = "0x" + "11" * 20
JOB: Final = "0x" + "22" * 20
KEY: Final = str(LiabilityTopicKey(ROBOT, JOB, "/value"))
ENCODINGS: Final = {"ros1": "ros1;geometry_msgs/Point", "json": "application/json"}
TICK: Final = 0.002
"""Seconds between two groups of messages."""
MOST_P99: Final = 50.0
WARM: Final = 1.0
"""Seconds before the measurement."""


def main() -> None:
    """Measure and print; exit with 1 above a limit."""
    given = arguments(__doc__ or "", rate=10_000, seconds=5)
    results = {"rate": given.rate, "seconds": given.seconds}
    with router() as (endpoint, _):
        measured = {name: measure(endpoint, name, given.rate, given.seconds) for name in ENCODINGS}
    results |= {f"{name}_{what}": value for name, found in measured.items() for what, value in found.items()}
    show(results, as_json=given.json)
    slow = {name: found["p99_ms"] for name, found in measured.items() if found["p99_ms"] > MOST_P99}
    if slow:
        raise SystemExit(f"p99 above {MOST_P99} ms: {slow}")


def measure(endpoint: str, encoding: str, rate: int, seconds: int) -> dict[str, Any]:
    """The delays of the messages in one encoding, and what the view needed for them."""
    urls: Any = SPAWN.Queue()
    view = SPAWN.Process(target=serve, args=(endpoint, urls), daemon=True)
    view.start()
    assert view.pid is not None
    try:
        url = urls.get(timeout=60)
        with process(drive, endpoint, encoding, rate):
            return asyncio.run(watch(url, encoding, seconds, view.pid))
    finally:
        view.terminate()
        view.join()


def drive(endpoint: str, encoding: str, rate: int) -> None:
    """The robot: publish the time, `rate` times a second."""
    asyncio.run(_drive(endpoint, encoding, rate))


async def _drive(endpoint: str, encoding: str, rate: int) -> None:
    async with Network(Endpoints(connect=(endpoint,))) as network:
        publisher = network.session.declare_publisher(KEY, encoding=ENCODINGS[encoding])
        start, sent = time.monotonic(), 0
        while True:
            due = int((time.monotonic() - start) * rate)
            for number in range(sent, due):
                at = time.time()
                json_text = b'{"sent":%.7f,"number":%d}' % (at, number)
                publisher.put(struct.pack("<ddd", at, number, 0) if encoding == "ros1" else json_text)
            sent = due
            await asyncio.sleep(TICK)


def serve(endpoint: str, urls: Any) -> None:
    """The view."""
    asyncio.run(_serve(endpoint, urls))


async def _serve(endpoint: str, urls: Any) -> None:
    front = FoxgloveFront(FoxgloveOptions(port=0), Drops())
    network = Network(Endpoints(connect=(endpoint,)))
    async with network, front, FoxgloveServer(front, "bench") as server:
        urls.put(front.url)
        await show_job(server, network.session, ROBOT, JOB)


async def watch(url: str, encoding: str, seconds: int, view: int) -> dict[str, Any]:
    """The client: subscribe to the topic, and measure."""
    delays: list[float] = []
    numbers: list[int] = []
    async with websockets.connect(url, subprotocols=[websockets.Subprotocol("foxglove.sdk.v1")]) as socket:
        await _subscribe(socket)
        until = time.monotonic() + WARM
        while time.monotonic() < until:
            await socket.recv()
        began, before = time.monotonic(), _cpu_seconds(view)
        while (now := time.monotonic()) < began + seconds:
            frame = await socket.recv()
            if isinstance(frame, bytes) and frame[0] == 1:
                at, number = _content(frame[13:], encoding)
                delays.append(time.time() - at)
                numbers.append(number)
        used = (_cpu_seconds(view) - before) / (now - began)
    delays.sort()
    return {
        "received_per_second": round(len(delays) / seconds),
        "lost": round(1 - len(numbers) / (numbers[-1] - numbers[0] + 1), 4),
        "p50_ms": round(delays[len(delays) // 2] * 1000, 2),
        "p99_ms": round(delays[len(delays) * 99 // 100] * 1000, 2),
        "view_cores": round(used, 2),
        "view_megabytes": _megabytes(view),
    }


async def _subscribe(socket: Any) -> None:
    async for frame in socket:
        message = json.loads(frame) if isinstance(frame, str) else {}
        for channel in message.get("channels", ()):
            if channel["topic"] == "/value":
                wanted = [{"id": 1, "channelId": channel["id"]}]
                await socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
                return


def _content(payload: bytes, encoding: str) -> tuple[float, int]:
    """When a message was sent, and its number."""
    if encoding == "ros1":
        at, number, _ = struct.unpack("<ddd", payload)
        return at, int(number)
    message = json.loads(payload)
    return message["sent"], message["number"]


def _cpu_seconds(pid: int) -> float:
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _megabytes(pid: int) -> int:
    with open(f"/proc/{pid}/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") >> 20


if __name__ == "__main__":
    main()
