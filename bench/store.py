"""The content store, the recorder and the player, compared with what they are built on; exits with 1 below a limit.

- cid: computing the CID of a file, compared with bare sha-256 of the same bytes, alternating.
- transfer: a file from one store to another through a router, in three processes, with hashing and fsync.
- recorder: JSON messages of 100 bytes from another process over Zenoh through `mesh.recording.Recorder` into a file,
  compared with a bare `mcap.Writer` that writes messages from memory, alternating.
- playback: how late messages recorded at 1 kHz are played.
- job: the same as a job, up to the handler, while the recording is synced and the position saved; and how many messages
  a second a job plays at once.

Each is measured three times and the best result counts, as other load on the machine is not ours. Lost messages are
added up.
"""

from __future__ import annotations

import asyncio
import hashlib
import io
import json
import os
import statistics
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from mcap.writer import Writer
from zenoh import CongestionControl

from common import SPAWN, arguments
from common import router as router_process
from mesh.content import Exchange, Store
from mesh.network import Endpoints, Network
from mesh.recording import Recorder, RecordingAbout, open_objective, play
from mesh.settings import Settings
from mesh.work import Ledger
from mesh.work.playbacks import Playbacks
from schemas import ZERO_ADDRESS, Liability, cid_of_bytes
from schemas.payloads import JSON
from schemas.unixfs import cid_of_stream

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from mesh.recording import Played
    from mesh.work.job import Job
    from mesh.work.run import JobRun

MEGABYTE: Final = 1e6
ROUNDS: Final = 3
KEY: Final = "aira/bench/topic"
HERTZ: Final = 1000
LIMITS: Final = {
    "cid ratio": (">=", 0.6),
    "transfer mb_per_s": (">=", 100),
    "recorder ratio": (">=", 0.6),
    "recorder lost": ("<=", 0),
    "playback p99_ms": ("<=", 2),
    "job p99_ms": ("<=", 5),
    "job messages_per_s": (">=", 5000),
}
LIABILITY: Final = Liability(
    address=ZERO_ADDRESS,
    model=cid_of_bytes(b"model"),
    objective=cid_of_bytes(b"objective"),
    result="",
    promisee=ZERO_ADDRESS,
    promisor=ZERO_ADDRESS,
    lighthouse=ZERO_ADDRESS,
    lighthouse_fee=0,
    token=ZERO_ADDRESS,
    cost=0,
    validator=ZERO_ADDRESS,
    validator_fee=0,
    is_success=False,
    is_finalized=False,
)
"""The contract of the measured job; no chain knows it."""

Results = dict[str, dict[str, float]]


def measure_cid(mebibytes: int) -> dict[str, float]:
    """Megabytes per second of computing the CID of a file in memory, and of bare sha-256."""
    data = os.urandom((mebibytes << 20) // 4)
    ours = bare = float("inf")
    for _ in range(4 * ROUNDS):
        bare = min(bare, _seconds(lambda: hashlib.sha256(data)))
        ours = min(ours, _seconds(lambda: cid_of_stream(io.BytesIO(data))))
    size = len(data) / MEGABYTE
    return {"mb_per_s": round(size / ours, 1), "sha256_mb_per_s": round(size / bare, 1), "ratio": round(bare / ours, 3)}


def measure_transfer(folder: Path, mebibytes: int) -> dict[str, float]:
    """Megabytes per second from the store of one process to that of another, through a router in a third."""
    with Store(folder / "holder", limit=mebibytes << 20) as store:
        cid = store.put_stream(_Noise(mebibytes << 20))
    ready, done = SPAWN.Event(), SPAWN.Event()
    with _router() as endpoint, _process(_hold, endpoint, folder / "holder", ready, done):
        ready.wait()
        seconds = min(asyncio.run(_fetch(endpoint, folder / str(number), cid)) for number in range(ROUNDS))
        done.set()
    return {"mb_per_s": round((mebibytes << 20) / MEGABYTE / seconds, 1)}


def measure_recorder(folder: Path, count: int) -> dict[str, float]:
    """Messages per second over Zenoh through the recorder, those of a bare writer, and the number of lost messages."""
    ours = bare = 0.0
    lost = 0
    commands, their_commands = SPAWN.Pipe()
    with _router() as endpoint, _process(_publish, endpoint, count, their_commands):
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
    with _router() as endpoint:
        late, rate = float("inf"), 0.0
        for number in range(ROUNDS):
            times = asyncio.run(_work(endpoint, folder / f"job-{number}", path, "recorded"))
            expected = (moment - times[0] - step / HERTZ for step, moment in enumerate(times))
            late = min(late, statistics.quantiles(expected, n=100)[98])
            times = asyncio.run(_work(endpoint, folder / f"at-once-{number}", path, "at-once"))
            rate = max(rate, count / (times[-1] - times[0]))
    return {"p99_ms": round(late * 1e3, 3), "messages_per_s": round(rate)}


def missed(results: Results) -> list[str]:
    """The limits that are not met."""
    lines = []
    for name, (sense, limit) in LIMITS.items():
        group, _, key = name.partition(" ")
        value = results[group][key]
        if (value < limit) if sense == ">=" else (value > limit):
            lines.append(f"{name} is {value:g}, and the limit is {sense} {limit:g}")
    return lines


def table(results: Results) -> str:
    """The results as a table."""
    lines = []
    for group, values in results.items():
        for name, value in values.items():
            sense, limit = LIMITS.get(f"{group} {name}", ("", ""))
            lines.append(f"{group:10}{name.replace('_', ' '):22}{value:>12,}   {sense} {limit}".rstrip())
    return "\n".join(lines)


def main() -> int:
    """Run from the command line; returns 1 if a limit is not met."""
    options = arguments(__doc__.splitlines()[0], mebibytes=256, messages=200_000, seconds=5)
    with tempfile.TemporaryDirectory(prefix="aira-bench-") as name:
        folder = Path(name)
        results: Results = {
            "cid": measure_cid(options.mebibytes),
            "transfer": measure_transfer(folder, options.mebibytes),
            "recorder": measure_recorder(folder, options.messages),
            "playback": measure_playback(folder, options.seconds),
            "job": measure_job(folder, options.seconds),
        }
    print(json.dumps(results) if options.json else table(results))
    too_low = missed(results)
    for line in too_low:
        print(line, file=sys.stderr)
    return 1 if too_low else 0


def _hold(endpoint: str, folder: Path, ready: Any, done: Any) -> None:
    """The process that holds the file."""
    asyncio.run(_holding(endpoint, folder, ready, done))


async def _holding(endpoint: str, folder: Path, ready: Any, done: Any) -> None:
    with Store(folder) as store:
        async with Network(Endpoints(connect=(endpoint,))) as network, Exchange(network.session, store):
            ready.set()
            await asyncio.to_thread(done.wait)


async def _fetch(endpoint: str, folder: Path, cid: str) -> float:
    with Store(folder) as store:
        async with Network(Endpoints(connect=(endpoint,))) as network, Exchange(network.session, store) as exchange:
            started = time.perf_counter()
            await exchange.fetch(cid)
            return time.perf_counter() - started


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


async def _work(endpoint: str, folder: Path, path: Path, pace: Literal["recorded", "at-once"]) -> list[float]:
    """When the handler of a job got each message of the objective at `path`."""
    times: list[float] = []
    objective = await asyncio.to_thread(open_objective, path)

    async def handle(job: Job, message: Played) -> None:
        times.append(time.perf_counter())

    async with Network(Endpoints(connect=(endpoint,))) as network, Ledger(folder / "ledger.sqlite") as ledger:
        playbacks = Playbacks(network.session, ZERO_ADDRESS, ledger, Settings(playback=pace), folder)
        await ledger.add_job(LIABILITY)
        (job,) = await ledger.jobs()
        async with asyncio.TaskGroup() as tasks:

            async def work(run: JobRun) -> None:
                await playbacks.play_and_save(run, handle)

            await playbacks.begin(job, objective, play=work, tasks=tasks)
        await playbacks.suspend(LIABILITY.address)
    return times


def _message(number: int) -> bytes:
    """A JSON message of 100 bytes."""
    text = json.dumps({"n": number, "x": number / 7, "y": number / 11, "note": ""})
    return (text[:-2] + "." * (100 - len(text)) + '"}').encode()


class _Noise:
    """A stream of `size` random bytes."""

    def __init__(self, size: int) -> None:
        self._left = size

    def read(self, size: int, /) -> bytes:
        data = os.urandom(min(size, self._left))
        self._left -= len(data)
        return data


@contextmanager
def _router() -> Iterator[str]:
    with router_process() as (endpoint, _):
        yield endpoint


@contextmanager
def _process(target: Callable[..., None], *given: Any) -> Iterator[None]:
    process = SPAWN.Process(target=target, args=given, daemon=True)
    process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join()


def _seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


if __name__ == "__main__":
    sys.exit(main())
