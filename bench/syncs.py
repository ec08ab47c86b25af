"""What a job writes to the disk: how often each role waits until something is there; exits with 1 above the limit.

Router, provider, robot and person are processes of their own, on a chain with a block every second. While jobs follow
one another, `strace` counts the calls that sync files and folders, and says of what. Each job has an objective of its
own, with one message, and the person fetches the recording. The first job, which creates files, is not counted. A
playback of N seconds has up to 4 N syncs more: recording and position, every half second.
"""

from __future__ import annotations

import asyncio
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rpc import SETTLE_SECONDS, Case, market_of

from common import arguments, show
from mesh.dev.development import ROLES

if TYPE_CHECKING:
    from collections.abc import Iterator

LIMIT: Final = 10
"""Syncs of the robot in a job, at most."""
CALLS: Final = "fsync,fdatasync,sync_file_range,syncfs,sync"
WHAT: Final = {
    "ledger": re.compile(r"/ledger\.sqlite"),
    "recording": re.compile(r"/recordings"),
    "pins": re.compile(r"/\.pins"),
    "content": re.compile(r"/content"),
    "transactions": re.compile(r"/transactions/"),
    "provider": re.compile(r"/provider-"),
}
"""What was synced, by its path; the first that fits."""


@contextmanager
def traced(pid: int, output: Path) -> Iterator[None]:
    """Meanwhile write the syncs of a process to a file."""
    strace = shutil.which("strace")
    if strace is None:
        sys.exit("install strace")
    command = [strace, "-f", "-y", "-qq", "-e", f"trace={CALLS}", "-o", str(output), "-p", str(pid)]
    with subprocess.Popen(command) as process:
        try:
            yield
        finally:
            process.terminate()


def counted(output: Path, jobs: int) -> dict[str, float]:
    """The syncs of a job by what was synced."""
    lines = [line for line in output.read_text().splitlines() if "resumed" not in line and "sync" in line]
    found = Counter(next((name for name, path in WHAT.items() if path.search(line)), "other") for line in lines)
    return {name: round(count / jobs, 2) for name, count in sorted(found.items())}


async def measure(jobs: int, folder: Path) -> dict[str, dict[str, float]]:
    """The syncs of each role in a job."""
    async with market_of(Case("1s", 1, "http")) as (market, _):
        await market.job()
        await asyncio.sleep(SETTLE_SECONDS)
        outputs = {role: folder / role for role in ROLES}
        with (
            traced(market.processes["provider"], outputs["provider"]),
            traced(market.processes["robot"], outputs["robot"]),
            traced(market.processes["person"], outputs["person"]),
        ):
            await asyncio.sleep(1)  # strace has attached
            for _ in range(jobs):
                await market.job()
            await asyncio.sleep(SETTLE_SECONDS)
    return {role: counted(output, jobs) for role, output in outputs.items()}


def main() -> None:
    """Run the benchmark."""
    options = arguments("syncs of files and folders in a job", jobs=8)
    with tempfile.TemporaryDirectory(prefix="aira-bench-") as folder:
        found = asyncio.run(measure(options.jobs, Path(folder)))
    per_job = {role: round(sum(kinds.values()), 2) for role, kinds in found.items()}
    results: dict[str, Any] = {"syncs_per_job": per_job, "limit": {"robot": LIMIT}, "of": found}
    show(results, as_json=options.json)
    sys.exit(per_job["robot"] > LIMIT)


if __name__ == "__main__":
    main()
