"""Simulated boards for tests, with firmware that each process which runs tests compiles once."""

from __future__ import annotations

import atexit
import shutil
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING

from bridges.serial.boards import SimulatedBoard
from bridges.serial.firmware import compile_sketch
from tests.support.commands import AIRA, Serving
from tests.support.peers import require

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[2]
LIBRARIES = ROOT / "examples" / "firmware"
ECHO = "examples/firmware/AiraFrames/examples/Echo"
COUNTER = "tests/support/firmware/counter"
ROSSERIAL_ECHO = "tests/support/firmware/rosserial_echo"


@cache
def firmware(sketch: str, *defines: str) -> Path:
    """The compiled sketch in this folder of the project. Skips the test where the tools are missing."""
    for tool in ("avr-gcc", "arduino-core", "libsimavr"):
        require(tool)
    folder = mkdtemp(prefix="aira-firmware-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return compile_sketch(ROOT / sketch, Path(folder) / "firmware.elf", libraries=[LIBRARIES], defines=defines)


def board(sketch: str, *defines: str) -> SimulatedBoard:
    """A board with that sketch, not yet running."""
    return SimulatedBoard(firmware(sketch, *defines))


@contextmanager
def edge(port: Path, agent: str, endpoint: str, *options: str) -> Iterator[Serving]:
    """`aira edge` for a board, as a process of its own; the board may not be ready yet."""
    command: tuple[str | Path, ...] = ("edge", port, "--agent", agent, "--connect", endpoint, *options)
    with Serving(*AIRA, *command, says="edge of 0x") as serving:
        yield serving
