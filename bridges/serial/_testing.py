"""Simulated boards for tests of robots that have one."""

from __future__ import annotations

import asyncio
import shutil
import tempfile
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from bridges.serial._edge import Edge, EdgeOptions
from bridges.serial.boards import SimulatedBoard
from bridges.serial.firmware import CORE, compile_sketch
from mesh.base.background import in_daemon_thread
from mesh.network import Endpoints, Network

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from mesh import Agent


@asynccontextmanager
async def simulated_board(
    sketch: str | Path,
    agent: Agent,
    *,
    name: str = "board",
    protocol: str = "frames",
    baud: int = 57600,
    libraries: Sequence[Path] = (),
) -> AsyncIterator[SimulatedBoard]:
    """Compile a sketch for an Uno, simulate the board, and connect it to an agent at work as `aira edge` does.

    `sketch` is its folder. `name`, `protocol` and `baud` (bits per second) are those of
    `aira edge`, `libraries` Arduino libraries and folders of them. Yields the board: its pins change `pins` and
    `dimmings`; `set_pin`, `set_voltage`, `unplug` and `plug` change it. Compiling takes some seconds.

    Skips the test where the AVR tools are not installed. Raises `InputError` for a sketch that does not compile.
    """
    if missing := _missing_tool():
        import pytest

        packages = "gcc-avr avr-libc arduino-core-avr libsimavr-dev gcc"
        pytest.skip(f"{missing} is not installed; on Debian: apt-get install {packages}")
    with tempfile.TemporaryDirectory(prefix="aira-sketch-") as made:
        elf = Path(made) / "board.elf"
        await asyncio.to_thread(compile_sketch, Path(sketch), elf, libraries=libraries)
        board = SimulatedBoard(elf)
        await asyncio.to_thread(board.__enter__)
        try:
            options = EdgeOptions(agent=agent.address, name=name, port=str(board.port), protocol=protocol, baud=baud)
            edge = Edge(options)
            async with Network(Endpoints(connect=agent.settings.connect)) as network:
                running = in_daemon_thread(lambda: edge.run(network.session), "edge of the board")
                try:
                    yield board
                finally:
                    edge.stop()
                    await asyncio.wrap_future(running)
        finally:
            await asyncio.to_thread(board.__exit__, None, None, None)


def _missing_tool() -> str:
    """A program that is needed and not installed; empty if all are."""
    if not CORE.is_dir():
        return "the Arduino core"
    return next((tool for tool in ("avr-gcc", "gcc") if shutil.which(tool) is None), "")
