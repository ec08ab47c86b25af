"""The cost of our side of ROS 1, against nodes of rospy: round trips, messages a second, and the bridge's memory.

`ping_ms` is the median time of a text from a rospy node to our echo and back; `rospy_ping_ms` to an echo in rospy.
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bridges.ros1.master import RosMaster
from bridges.ros1.messages import Ros1Type
from bridges.ros1.node import Ros1Graph, Ros1Node
from common import ADDRESS, arguments, router, show
from mesh.base.flood import Drops
from mesh.network import free_endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator

MOST_RATIO: Final = 2.0
MOST_MEMORY: Final = 70.0
PYTHON: Final = "/usr/bin/python3"
ROSPY: Final = Path("/usr/lib/python3/dist-packages/rospy")
TEXT: Final = Ros1Type("std_msgs/String", "string data\n")
SIZE: Final = 100
"""Bytes of a message."""
NODE: Final = """
import json, os, statistics, sys, threading, time
import rospy
from std_msgs.msg import String
role, count = sys.argv[1], int(sys.argv[2])
rospy.init_node(role, anonymous=True)
say = lambda value: print(json.dumps(value), flush=True)
if role == "echo":
    back = rospy.Publisher("/back", String, queue_size=10, tcp_nodelay=True)
    rospy.Subscriber("/back_to_rospy", String, back.publish, tcp_nodelay=True)
    rospy.spin()
elif role == "ping":
    there = rospy.Publisher(sys.argv[3], String, queue_size=10, tcp_nodelay=True)
    back, times = threading.Event(), []
    rospy.Subscriber("/back", String, lambda message: back.set(), tcp_nodelay=True)
    while not times or len(times) < count:
        back.clear()
        begun = time.perf_counter()
        there.publish(String("x" * 16))
        if back.wait(0.5):
            times.append(time.perf_counter() - begun)
    say(statistics.median(times[count // 5:]) * 1000)
elif role == "hear":
    heard = [0]
    def on_message(message):
        heard[0] += 1
        if heard[0] == count:
            say(heard[0])
    rospy.Subscriber("/fast", String, on_message, tcp_nodelay=True)
    rospy.spin()
elif role == "tell":
    told = rospy.Publisher("/told", String, queue_size=count, tcp_nodelay=True)
    while not told.get_num_connections():
        time.sleep(0.01)
    for _ in range(count):
        told.publish(String("x" * 100))
    time.sleep(60)
"""
"""A node of rospy in one of four roles."""


def main() -> None:
    """Measure and print; exit with 1 above a limit."""
    given = arguments(__doc__ or "", pings=1000, messages=20_000)
    if not ROSPY.exists():
        print("rospy is not installed: run `make peers`")
        return
    results = asyncio.run(_measure(given.pings, given.messages))
    results["memory_mb"] = round(_bridge_memory(), 1)
    show(results, as_json=given.json)
    if results["ratio"] > MOST_RATIO or results["memory_mb"] > MOST_MEMORY:
        sys.exit(f"the limits are {MOST_RATIO:g} times the round trip of rospy, and {MOST_MEMORY:g} MB")


async def _measure(pings: int, messages: int) -> dict[str, Any]:
    drops = Drops()
    async with RosMaster("127.0.0.1", 0, drops) as master:
        graph = Ros1Graph(master.uri, drops=drops)
        async with Ros1Node(graph, "/ours") as node:
            back = await node.advertise("/back", TEXT)
            await node.subscribe("/there_and", TEXT.name, lambda payload, _: back.publish(payload))
            ours = float(await _said(graph, "ping", pings, "/there_and"))
            await back.close()
            with _running(graph, "echo", 0):
                theirs = float(await _said(graph, "ping", pings, "/back_to_rospy"))
            out = await _out(graph, node, messages)
            into = await _into(graph, node, messages)
    return {
        "ping_ms": round(ours, 3),
        "rospy_ping_ms": round(theirs, 3),
        "ratio": round(ours / theirs, 2),
        "out_per_s": round(out),
        "in_per_s": round(into),
    }


async def _out(graph: Ros1Graph, node: Ros1Node, count: int) -> float:
    """Messages a second from us to a node of rospy, until it has heard them all."""
    publisher = await node.advertise("/fast", TEXT)
    payload = TEXT.encode({"data": "x" * SIZE})
    with _running(graph, "hear", count) as hearing:
        await publisher.wait_for_subscriber(20)
        await asyncio.sleep(0.2)  # rospy has the connection
        begun = time.perf_counter()
        for _ in range(count):
            publisher.publish(payload)
        await asyncio.to_thread(hearing.stdout.readline)  # type: ignore[union-attr]
        return count / (time.perf_counter() - begun)


async def _into(graph: Ros1Graph, node: Ros1Node, count: int) -> float:
    """Messages a second that we hear of a node of rospy."""
    times = list[float]()
    done = asyncio.Event()

    def received(_payload: bytes, _header: object) -> None:
        times.append(time.perf_counter())
        if len(times) == count:
            done.set()

    await node.subscribe("/told", TEXT.name, received)
    with _running(graph, "tell", count):
        async with asyncio.timeout(120):
            await done.wait()
    return count / (times[-1] - times[0])


async def _said(graph: Ros1Graph, role: str, count: int, *more: str) -> str:
    with _running(graph, role, count, *more) as node:
        async with asyncio.timeout(120):
            assert node.stdout is not None
            return str(await asyncio.to_thread(node.stdout.readline), "utf-8")


@contextmanager
def _running(graph: Ros1Graph, role: str, count: int, *more: str) -> Iterator[subprocess.Popen[bytes]]:
    """A node of rospy."""
    variables = {"PATH": "/usr/bin:/bin", "ROS_MASTER_URI": graph.master, "ROS_IP": "127.0.0.1", "ROS_HOME": "/tmp"}
    command = [PYTHON, "-c", NODE, role, str(count), *more]
    with subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as node:
        try:
            yield node
        finally:
            node.kill()


def _bridge_memory() -> float:
    """Megabytes of `aira bridge ros1` beside an agent."""
    port = free_endpoint().rpartition(":")[2]
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("AIRA_")}
    with ExitStack() as stack:
        endpoint, _ = stack.enter_context(router())
        words = ["--agent", ADDRESS, "--connect", endpoint, "--master", "--ros-master-uri", f"http://127.0.0.1:{port}"]
        command = [sys.executable, "-m", "mesh", "bridge", "ros1", *words]
        bridge = stack.enter_context(subprocess.Popen(command, env=inherited, stdout=subprocess.PIPE))
        stack.callback(bridge.terminate)
        assert bridge.stdout is not None
        bridge.stdout.readline()  # it has started
        time.sleep(2.0)
        status = Path(f"/proc/{bridge.pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024


if __name__ == "__main__":
    main()
