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
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from recordings import ROUNDS, measure_job, measure_playback, measure_recorder

from common import SPAWN, arguments, process, router
from mesh.content import Exchange, Store
from mesh.network import Endpoints, Network
from schemas.unixfs import cid_of_stream

if TYPE_CHECKING:
    from collections.abc import Callable

MEGABYTE: Final = 1e6
LIMITS: Final = {
    "cid ratio": (">=", 0.6),
    "transfer mb_per_s": (">=", 100),
    "recorder ratio": (">=", 0.6),
    "recorder lost": ("<=", 0),
    "playback p99_ms": ("<=", 2),
    "job p99_ms": ("<=", 5),
    "job messages_per_s": (">=", 5000),
}
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
    with router() as (endpoint, _), process(_hold, endpoint, folder / "holder", ready, done):
        ready.wait()
        seconds = min(asyncio.run(_fetch(endpoint, folder / str(number), cid)) for number in range(ROUNDS))
        done.set()
    return {"mb_per_s": round((mebibytes << 20) / MEGABYTE / seconds, 1)}


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


class _Noise:
    """A stream of `size` random bytes."""

    def __init__(self, size: int) -> None:
        self._left = size

    def read(self, size: int, /) -> bytes:
        data = os.urandom(min(size, self._left))
        self._left -= len(data)
        return data


def _seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


if __name__ == "__main__":
    sys.exit(main())
