"""Simulated boards for tests. Firmware is compiled once for all processes and runs, until a source changes."""

from __future__ import annotations

import fcntl
import hashlib
import os
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from bridges.serial import firmware as compiler
from bridges.serial.boards import SimulatedBoard
from tests.support.commands import AIRA, Serving
from tests.support.peers import require

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[2]
LIBRARIES = ROOT / "examples" / "firmware"
ECHO = "examples/firmware/AiraFrames/examples/Echo"
COUNTER = "tests/support/firmware/counter"
DIMMER = "tests/support/firmware/dimmer"
STOPPABLE = "tests/support/firmware/stoppable"
TALKER = "tests/support/firmware/talker"
ROSSERIAL_ECHO = "tests/support/firmware/rosserial_echo"
ROSSERIAL_TWINS = "tests/support/firmware/rosserial_twins"


@cache
def firmware(sketch: str, *defines: str) -> Path:
    """The compiled sketch in this folder of the project. Skips the test if the tools are missing.

    It is kept in the cache folder of the tests' programs, under a hash of everything that it is made of.
    """
    for tool in ("avr-gcc", "arduino-core", "libsimavr"):
        require(tool)
    folder = Path(os.environ.get("AIRA_PEERS_CACHE") or "~/.cache/aira-mesh").expanduser() / "firmware"
    folder.mkdir(parents=True, exist_ok=True)
    elf = folder / f"{Path(sketch).name}-{_digest(ROOT / sketch, defines)}.elf"
    with open(folder / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the other processes wait rather than compile the same
        if not elf.exists():
            compiled = elf.with_suffix(f".{os.getpid()}")
            compiler.compile_sketch(ROOT / sketch, compiled, libraries=[LIBRARIES], defines=defines)
            compiled.replace(elf)
    return elf


def _digest(sketch: Path, defines: tuple[str, ...]) -> str:
    sources = [
        Path(compiler.__file__),
        *(path for top in (sketch, LIBRARIES) for path in sorted(top.rglob("*"))),
    ]
    parts = [repr(defines).encode(), *(path.read_bytes() for path in sources if path.is_file())]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:12]


def board(sketch: str, *defines: str) -> SimulatedBoard:
    """A board with that sketch, not yet running."""
    return SimulatedBoard(firmware(sketch, *defines))


@contextmanager
def edge(port: Path, agent: str, endpoint: str, *options: str) -> Iterator[Serving]:
    """`aira edge` for a board, as a process of its own. The board may not be ready yet."""
    command: tuple[str | Path, ...] = ("edge", port, "--agent", agent, "--connect", endpoint, *options)
    with Serving(*AIRA, *command, says="edge of 0x") as serving:
        yield serving
