"""The cost of the bridge to ROS 2 at a thousand messages a second each way, and of recording messages of ROS 2.

`cpu_percent` is of one core, `late_ms` the time from the robot to a subscriber in the mesh. `recorder` compares
messages of ROS 2 (CDR, with their definition) with the same bytes without a definition, and with a bare MCAP writer.
"""

from __future__ import annotations

import asyncio
import os
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mcap.writer import Writer

from bridges.ros2 import Robot, RosQos
from common import ADDRESS, SPAWN, arguments, process, router, show
from mesh.network import Endpoints, Network
from mesh.recording import Recorder, RecordingAbout
from mesh.recording.ros import RosTypes
from schemas.keys import DeviceTopicKey
from schemas.payloads import Payload, PayloadType

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

HERTZ: Final = 1000
MOST_CPU: Final = 60.0
MOST_MEMORY: Final = 120.0
LEAST_RATIO: Final = 0.8
ROUNDS: Final = 7
RECORDED: Final = 20_000
TIMEOUT: Final = 30.0
STAMP: Final = struct.Struct("<iI")
STAMP_AT: Final = 4
"""Where a message that begins with a header has its time."""
QOS: Final = RosQos(depth=1000)
ODOMETRY: Final = "nav_msgs/msg/Odometry"
TWIST: Final = "geometry_msgs/msg/Twist"


def main() -> None:
    """Measure and print; exit with 1 above or below a limit."""
    given = arguments(__doc__ or "", seconds=10)
    count = given.seconds * HERTZ
    commands, their_commands = SPAWN.Pipe()
    with (
        router() as (mesh, _),
        router() as (ros, _),
        process(_robot, ros, count, their_commands),
        _bridge(mesh, ros) as bridge,
    ):
        results = asyncio.run(_measure(mesh, count, bridge.pid, commands))
    with tempfile.TemporaryDirectory() as folder:
        results["recorder"] = recorder_ratios(Path(folder))
    show(results, as_json=given.json)
    cpu = max(results[way]["cpu_percent"] for way in ("from_robot", "to_robot"))
    lost = results["from_robot"]["lost"] + results["to_robot"]["lost"]
    if cpu > MOST_CPU or results["memory_mb"] > MOST_MEMORY or lost:
        sys.exit(f"the limits of the bridge are {MOST_CPU:g} % of a core, {MOST_MEMORY:g} MB, and no lost message")
    if results["recorder"]["ratio"] < LEAST_RATIO:
        sys.exit(f"messages of ROS 2 are recorded at less than {LEAST_RATIO:g} of the rate of others")


@contextmanager
def _bridge(mesh: str, ros: str) -> Iterator[subprocess.Popen[bytes]]:
    """`aira bridge ros2` as a process."""
    options = ["--agent", ADDRESS, "--connect", mesh, "--ros2-connect", ros, "--publish", "/cmd_vel"]
    command = [sys.executable, "-m", "mesh", "bridge", "ros2", *options, "--subscribe", "/odom"]
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("AIRA_")}
    with subprocess.Popen(command, env=inherited, stdout=subprocess.DEVNULL) as running:
        try:
            yield running
        finally:
            running.terminate()


async def _measure(mesh: str, count: int, pid: int, commands: Any) -> dict[str, Any]:
    """Both ways, one after the other, and the bridge's memory at the end."""
    async with Network(Endpoints(connect=(mesh,))) as network:
        from_robot = await _from_robot(network.session, count, pid, commands)
        to_robot = await _to_robot(network.session, count, pid, commands)
    return {"from_robot": from_robot, "to_robot": to_robot, "memory_mb": round(_resident_mb(pid), 1)}


async def _from_robot(session: Any, count: int, pid: int, commands: Any) -> dict[str, float]:
    late: list[float] = []

    def receive(sample: Any) -> None:
        seconds, nanoseconds = STAMP.unpack_from(sample.payload.to_bytes(), STAMP_AT)
        late.append(time.time_ns() / 1e6 - seconds * 1e3 - nanoseconds / 1e6)

    subscriber = session.declare_subscriber(str(DeviceTopicKey(ADDRESS, "robot", "/odom")), receive)
    commands.send("odom")
    await _until(lambda: bool(late), "the bridge carries nothing")
    await asyncio.to_thread(commands.recv)  # the robot waits a moment before it counts
    begun, used, before = time.monotonic(), _cpu_seconds(pid), len(late)
    commands.send("go")
    await asyncio.to_thread(commands.recv)
    percent = 100 * (_cpu_seconds(pid) - used) / (time.monotonic() - begun)
    await asyncio.sleep(1.0)
    subscriber.undeclare()
    p50, p99 = statistics.median(late[before:]), statistics.quantiles(late[before:], n=100)[98]
    return {
        "cpu_percent": round(percent, 1),
        "late_ms_p50": round(p50, 2),
        "late_ms_p99": round(p99, 2),
        "lost": before + count - len(late),
    }


async def _to_robot(session: Any, count: int, pid: int, commands: Any) -> dict[str, float]:
    payload = RosTypes("jazzy").message(TWIST, linear={"x": 0.5})
    key = str(DeviceTopicKey(ADDRESS, "robot", "/cmd_vel"))
    publisher = session.declare_publisher(key, encoding=payload.type.zenoh_encoding)
    commands.send("cmd_vel")
    heard = 0
    while not heard:  # the robot says how many messages it has heard
        publisher.put(payload.data)
        await asyncio.sleep(0.5)
        commands.send("count")
        heard = await asyncio.to_thread(commands.recv)
    begun, used = time.monotonic(), _cpu_seconds(pid)
    await asyncio.to_thread(_at_rate, count, lambda: publisher.put(payload.data))
    percent = 100 * (_cpu_seconds(pid) - used) / (time.monotonic() - begun)
    await asyncio.sleep(1.0)
    commands.send("count")
    return {"cpu_percent": round(percent, 1), "lost": heard + count - await asyncio.to_thread(commands.recv)}


def _robot(endpoint: str, count: int, commands: Any) -> None:
    """The process of the robot, which publishes and counts as the commands say."""
    asyncio.run(_be_robot(endpoint, count, commands))


async def _be_robot(endpoint: str, count: int, commands: Any) -> None:
    types = RosTypes("jazzy")
    heard = 0

    async def listen(messages: Any) -> None:
        nonlocal heard
        async for _ in messages:
            heard += 1

    async with Network(Endpoints(connect=(endpoint,))) as network, Robot(network.session, types) as robot:
        odometry = robot.advertise("/odom", ODOMETRY, qos=QOS)
        data = bytearray(types.message(ODOMETRY, child_frame_id="base_link").data)
        kind = types.payload_type(ODOMETRY)

        def publish() -> None:
            STAMP.pack_into(data, STAMP_AT, *divmod(time.time_ns(), 10**9))
            odometry.put(Payload(bytes(data), kind))

        async with robot.subscribe("/cmd_vel", TWIST, qos=QOS) as messages:
            listening = asyncio.create_task(listen(messages))
            while command := await asyncio.to_thread(commands.recv):
                match command:
                    case "odom":
                        await asyncio.to_thread(_at_rate, 3 * HERTZ, publish)
                        await asyncio.sleep(1.0)
                        commands.send("ready")
                    case "go":
                        await asyncio.to_thread(_at_rate, count, publish)
                        commands.send("done")
                    case "count":
                        commands.send(heard)
            listening.cancel()


def _at_rate(count: int, put: Callable[[], object]) -> None:
    """Call `put` so many times, at a thousand a second."""
    started = time.perf_counter()
    for number in range(count):
        put()
        time.sleep(max(0.0, started + (number + 1) / HERTZ - time.perf_counter()))


def _resident_mb(pid: int) -> float:
    """Megabytes of memory of a process."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line)
    return int(status["VmRSS"].split()[0]) / 1024


def _cpu_seconds(pid: int) -> float:
    """Seconds of processor that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def _until(condition: Callable[[], bool], otherwise: str) -> None:
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        if time.monotonic() > deadline:
            sys.exit(otherwise)
        await asyncio.sleep(0.01)


def recorder_ratios(folder: Path) -> dict[str, float]:
    """Messages per second of each kind, the best of several rounds, and the ratios."""
    payload = RosTypes("jazzy").message(ODOMETRY, child_frame_id="base_link")
    plain = PayloadType("application/octet-stream")
    rates = {"cdr": 0.0, "plain": 0.0, "bare": 0.0}
    for number in range(ROUNDS):
        for name, kind in (("cdr", payload.type), ("plain", plain)):
            rates[name] = max(rates[name], RECORDED / _record(folder / f"{name}-{number}", payload.data, kind))
        rates["bare"] = max(rates["bare"], RECORDED / _write_bare(folder / f"bare-{number}", payload))
    return {
        "cdr_per_s": round(rates["cdr"]),
        "plain_per_s": round(rates["plain"]),
        "bare_per_s": round(rates["bare"]),
        "ratio": round(rates["cdr"] / rates["plain"], 3),
        "bare_ratio": round(rates["cdr"] / rates["bare"], 3),
    }


def _record(path: Path, data: bytes, kind: PayloadType) -> float:
    """Seconds from the first message to the finished file."""
    recorder = Recorder(path, RecordingAbout())
    started = time.perf_counter()
    for _ in range(RECORDED):
        recorder.record("/odom", data, kind)
    summary = recorder.close()
    assert summary.messages == RECORDED
    return time.perf_counter() - started


def _write_bare(path: Path, payload: Payload) -> float:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema(ODOMETRY, "ros2msg", payload.type.schema_data)
        channel = writer.register_channel("/odom", "cdr", schema)
        started = time.perf_counter()
        for number in range(RECORDED):
            now = time.time_ns()
            writer.add_message(channel, now, payload.data, now, number)
        writer.finish()  # type: ignore[no-untyped-call]
        stream.flush()
        os.fsync(stream.fileno())
        return time.perf_counter() - started


if __name__ == "__main__":
    main()
