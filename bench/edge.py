"""The cost of an edge agent, and how fast a device answers: memory, start time, round trips on a simulated Uno.

`wire_ms` is the time that the bytes of a round trip take on the line; `ratio` is the round trip divided by that.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final

import zenoh

from bridges.serial import frames, rosserial
from bridges.serial.boards import SimulatedBoard
from bridges.serial.dialect import BoardReady, Command, CommandFinished, LineEvent, MessageReceived, load_dialect
from bridges.serial.firmware import compile_sketch
from bridges.serial.line import PortName, SerialLine
from common import arguments, show
from mesh.errors import AiraError
from mesh.network import Endpoints, free_endpoint
from mesh.role.running import fail
from schemas.payloads import String

if TYPE_CHECKING:
    from collections.abc import Iterator


LIBRARIES: Final = Path(__file__).parents[1] / "examples" / "firmware"
SKETCHES: Final[dict[str, Path]] = {
    "frames": LIBRARIES / "AiraFrames" / "examples" / "Echo",
    "rosserial": LIBRARIES / "MiniRosserial" / "examples" / "Echo",
}
BAUDS: Final = (57_600, 115_200)
AGENT: Final = "0x" + "11" * 20
MOST_MEMORY: Final = 40.0
MOST_START: Final = 0.4
STARTS: Final = 5
TIMEOUT: Final = 30.0
IDLE_TIME: Final = 0.05
"""Seconds in which a rosserial board announces its topics, which confirms a command."""


def main() -> None:
    """Measure and print; exit with 1 above a limit."""
    given = arguments(__doc__ or "", calls=200)
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        results |= start_and_memory(compiled("frames", BAUDS[0], Path(folder)))
        for protocol in SKETCHES:
            results[protocol] = {
                str(baud): round_trips(protocol, baud, compiled(protocol, baud, Path(folder)), given.calls)
                for baud in BAUDS
            }
    show(results, as_json=given.json)
    if results["memory_mb"] > MOST_MEMORY or results["start_s"] > MOST_START:
        sys.exit(f"the limits of an edge agent are {MOST_MEMORY:g} MB and {MOST_START:g} s")


def compiled(protocol: str, baud: int, folder: Path) -> Path:
    """The echo firmware of a protocol at a baud rate."""
    elf = folder / f"{protocol}-{baud}.elf"
    return compile_sketch(SKETCHES[protocol], elf, libraries=[LIBRARIES], defines=[f"BAUD={baud}"])


def start_and_memory(elf: Path) -> dict[str, float]:
    """Seconds from the start of `aira edge` until its board is present, and its resident megabytes."""
    endpoint = free_endpoint()
    starts, memories = [], []
    with zenoh.open(Endpoints(listen=(endpoint,), mode="router").config()) as router, SimulatedBoard(elf) as board:
        for _ in range(STARTS):
            present = threading.Event()
            key = f"aira/agent/{AGENT}/device/board/present"
            watch: Any = router.liveliness().declare_subscriber(key, partial(_seen, present))
            began = time.perf_counter()
            with edge(board.port, endpoint) as process:
                if not present.wait(TIMEOUT):
                    sys.exit("the edge agent did not start")
                starts.append(time.perf_counter() - began)
                time.sleep(0.5)  # memory that it allocates after its start counts, too
                memories.append(resident(process.pid))
            watch.undeclare()
    return {"memory_mb": round(max(memories), 1), "start_s": round(statistics.median(starts), 3)}


@contextmanager
def edge(port: Path, endpoint: str, agent: str = AGENT) -> Iterator[subprocess.Popen[bytes]]:
    """`aira edge` as a process."""
    command = [sys.executable, "-m", "mesh", "edge", str(port), "--agent", agent, "--connect", endpoint]
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("AIRA_")}
    with subprocess.Popen(command, env=inherited, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.terminate()


def resident(pid: int) -> float:
    """Megabytes of memory of a process."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line)
    return int(status["VmRSS"].split()[0]) / 1024


def round_trips(protocol: str, baud: int, elf: Path, calls: int) -> dict[str, float]:
    """Median milliseconds of 16 bytes to the board and back, one round trip at a time on an idle line."""
    arrived: SimpleQueue[tuple[LineEvent, float]] = SimpleQueue()
    dialect = load_dialect(protocol)(baud=baud)
    took = []
    topic, payload, answer = (
        ("/echo", b'"0123456789abcde"', CommandFinished)
        if protocol == "frames"
        else ("/hear", String("0123456789ab").encode(), MessageReceived)
    )
    with SimulatedBoard(elf) as board:
        line = SerialLine(
            PortName(str(board.port)),
            dialect,
            on_event=lambda event: arrived.put((event, time.perf_counter())),
        )
        thread = threading.Thread(target=line.run, name="line")
        thread.start()
        try:
            _next(arrived, BoardReady)
            for _ in range(calls):
                began = time.perf_counter()
                line.call_soon(lambda: dialect.submit(Command(topic, payload), time.monotonic()))
                took.append(_next(arrived, answer) - began)
                if answer is not CommandFinished:
                    _next(arrived, CommandFinished)
                    time.sleep(IDLE_TIME)
        finally:
            line.stop()
            thread.join()
    p50, wire = statistics.median(took) * 1000, wire_bytes(protocol) * 10_000 / baud
    return {"p50_ms": round(p50, 2), "wire_ms": round(wire, 2), "ratio": round(p50 / wire, 2)}


def wire_bytes(protocol: str) -> int:
    """Bytes of a round trip: the message and its answer."""
    if protocol == "frames":
        return 2 * len(frames.encode_frame(frames.Frame(frames.FrameKind.CALL, 0, 0, bytes(16))))
    return 2 * rosserial.frame_size(16)


def _seen(present: threading.Event, sample: zenoh.Sample) -> None:
    if sample.kind == zenoh.SampleKind.PUT:
        present.set()


def _next(arrived: SimpleQueue[tuple[LineEvent, float]], kind: type[LineEvent]) -> float:
    """When the next event of that kind arrived."""
    while True:
        event, when = arrived.get(timeout=TIMEOUT)
        if isinstance(event, kind):
            return when


if __name__ == "__main__":
    try:
        main()
    except AiraError as error:  # the AVR tools are missing: `make peers`
        fail(error)
