"""Recorder, player and jobs, measured for `store.py`."""

from __future__ import annotations

import asyncio
import json
import os
import statistics
import threading
import time
from typing import TYPE_CHECKING, Any, Final

from mcap.writer import Writer
from zenoh import CongestionControl

from common import SPAWN, process, router
from mesh.agent.jobs import JobRecordings, JobRun
from mesh.agent.ledger import Ledger
from mesh.network import Endpoints, Network
from mesh.recording import AT_ONCE, Recorder, RecordingAbout, open_objective, play
from schemas import ZERO_ADDRESS, Liability, cid_of_bytes
from schemas.payloads import JSON

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.handlers import Job
    from mesh.recording import Played

ROUNDS: Final = 3
KEY: Final = "aira/bench/topic"
HERTZ: Final = 1000
LIABILITY: Final = Liability.of_nobody(
    model=cid_of_bytes(b"model"),
    objective=cid_of_bytes(b"objective"),
)
"""The contract of the measured job; no chain knows it."""


def measure_recorder(folder: Path, count: int) -> dict[str, float]:
    """Messages per second over Zenoh through the recorder, those of a bare writer, and the number of lost messages."""
    ours = bare = 0.0
    lost = 0
    commands, their_commands = SPAWN.Pipe()
    with router() as (endpoint, _), process(_publish, endpoint, count, their_commands):
        commands.recv()
        for number in range(ROUNDS):
            bare = max(bare, count / _write_bare(folder / f"bare-{number}.mcap", count))
            seconds, missing = asyncio.run(_record(endpoint, folder / f"ours-{number}.mcap", count, commands))
            ours, lost = max(ours, count / seconds), lost + missing
        commands.send("enough")
    return {
        "messages_per_s": round(ours),
        "bare_messages_per_s": round(bare),
        "ratio": round(ours / bare, 3),
        "lost": lost,
    }


def measure_playback(folder: Path, seconds: int) -> dict[str, float]:
    """How many milliseconds late messages are played at a thousand per second: the 99th percentile."""
    path = folder / "played.mcap"
    with Recorder(path, RecordingAbout()) as recorder:
        for number in range(seconds * HERTZ):
            recorder.record("/pose", _message(number), JSON, log_time_ns=10**18 + number * 10**9 // HERTZ)
    p99 = min(statistics.quantiles(asyncio.run(_play(path)), n=100)[98] for _ in range(ROUNDS))
    return {"p99_ms": round(p99 * 1e3, 3)}


def measure_job(folder: Path, seconds: int) -> dict[str, float]:
    """How late the handler of a job gets messages at a thousand per second, and how many per second at once."""
    path, count = folder / "job.mcap", seconds * HERTZ
    with Recorder(path, RecordingAbout()) as recorder:
        for number in range(count):
            recorder.record("/pose", _message(number), JSON, log_time_ns=10**18 + number * 10**9 // HERTZ)
    with router() as (endpoint, _):
        late, rate = float("inf"), 0.0
        for number in range(ROUNDS):
            times = asyncio.run(_work(endpoint, folder / f"job-{number}", path, 1.0))
            expected = (moment - times[0] - step / HERTZ for step, moment in enumerate(times))
            late = min(late, statistics.quantiles(expected, n=100)[98])
            times = asyncio.run(_work(endpoint, folder / f"at-once-{number}", path, AT_ONCE))
            rate = max(rate, count / (times[-1] - times[0]))
    return {"p99_ms": round(late * 1e3, 3), "messages_per_s": round(rate)}


def _publish(endpoint: str, count: int, commands: Any) -> None:
    """The process that publishes what is recorded, once per command."""
    asyncio.run(_publishing(endpoint, count, commands))


async def _publishing(endpoint: str, count: int, commands: Any) -> None:
    payloads = [_message(number) for number in range(count)]
    async with Network(Endpoints(connect=(endpoint,))) as network:
        # A full queue must slow the publisher down, not drop messages.
        block = CongestionControl.BLOCK
        publisher = network.session.declare_publisher(KEY, encoding=JSON.zenoh_encoding, congestion_control=block)
        commands.send("ready")
        while commands.recv() == "go":
            await asyncio.to_thread(_until_matching, publisher)
            for payload in payloads:
                publisher.put(payload)


def _until_matching(publisher: Any) -> None:
    while not publisher.matching_status.matching:
        time.sleep(0.01)


async def _record(endpoint: str, path: Path, count: int, commands: Any) -> tuple[float, int]:
    """Seconds from the first message to the finished file, and how many messages are not in it."""
    async with Network(Endpoints(connect=(endpoint,))) as network:
        receiver = _Receiver(Recorder(path, RecordingAbout()), count)
        subscriber: Any = network.session.declare_subscriber(KEY, receiver.receive)
        commands.send("go")
        await asyncio.to_thread(receiver.all_received.wait, 60)  # what has not arrived then is lost
        summary = await asyncio.to_thread(receiver.recorder.close)
        seconds = time.perf_counter() - receiver.started
        subscriber.undeclare()
    return seconds, count - summary.messages


class _Receiver:
    """Records what a subscriber receives, in Zenoh's thread, as an agent does."""

    def __init__(self, recorder: Recorder, count: int) -> None:
        self.recorder = recorder
        self.started = 0.0
        self.all_received = threading.Event()
        self._missing = count

    def receive(self, sample: Any) -> None:
        self.started = self.started or time.perf_counter()
        self.recorder.record("/topic", sample.payload.to_bytes(), JSON)
        self._missing -= 1
        if not self._missing:
            self.all_received.set()


def _write_bare(path: Path, count: int) -> float:
    """Seconds that a bare writer takes from the first message to the end of the file."""
    payloads = [_message(number) for number in range(count)]
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("", "jsonschema", b'{"type":"object"}')
        channel = writer.register_channel("/topic", "json", schema)
        started = time.perf_counter()
        for number, payload in enumerate(payloads):
            now = time.time_ns()
            writer.add_message(channel, now, payload, now, number)
        writer.finish()  # type: ignore[no-untyped-call]
        stream.flush()
        os.fsync(stream.fileno())
        return time.perf_counter() - started


async def _play(path: Path) -> list[float]:
    """Seconds by which each message was late."""
    late: list[float] = []
    started = None
    async for step in play(await asyncio.to_thread(open_objective, path)):
        now = time.monotonic_ns()
        started = now if started is None else started
        late.append((now - started - step.due_ns) / 1e9)
    return late


async def _work(endpoint: str, folder: Path, path: Path, speed: float) -> list[float]:
    """When the handler of a job got each message of the objective at `path`."""
    times: list[float] = []
    objective = await asyncio.to_thread(open_objective, path)

    async def handle(job: Job, message: Played) -> None:
        times.append(time.perf_counter())

    async with Network(Endpoints(connect=(endpoint,))) as network, Ledger(folder / "ledger.sqlite") as ledger:
        await ledger.add_job(LIABILITY)
        (job,) = await ledger.jobs()
        recorder = await JobRecordings(folder, ZERO_ADDRESS).open(LIABILITY)
        run = JobRun(network.session, ZERO_ADDRESS, job, recorder, objective=objective, speed=speed)
        run.open()
        await run.play_and_save(handle, ledger)
        await run.suspend(ledger)
    return times


def _message(number: int) -> bytes:
    """A JSON message of 100 bytes."""
    text = json.dumps({"n": number, "x": number / 7, "y": number / 11, "note": ""})
    return (text[:-2] + "." * (100 - len(text)) + '"}').encode()
