"""What can fail around a robot of a test: the cable to the router can be cut, a small disk of its own can be filled."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

import pytest

from mesh.base.lifecycle import Lifecycle

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AsyncExitStack
    from pathlib import Path

FILLER: Final = "filler"


class Cable(Lifecycle):
    """Passes bytes between the router and a robot that connects to `endpoint`: `async with Cable(router) as cable`."""

    title = "cable"

    def __init__(self, router: str) -> None:
        self._host, _, port = router.removeprefix("tcp/").rpartition(":")
        self._port = int(port)
        self._ends: set[asyncio.Transport] = set()
        self._is_cut = False
        self.endpoint = ""
        """Where the robot connects to, as in `tcp/127.0.0.1:7447`."""

    async def _open(self, stack: AsyncExitStack) -> None:
        loop = asyncio.get_running_loop()
        server = await loop.create_server(lambda: _End(self), self._host, 0)
        stack.callback(server.close)
        stack.callback(self.cut)
        self.endpoint = f"tcp/{self._host}:{server.sockets[0].getsockname()[1]}"
        self._is_cut = False

    def cut(self) -> None:
        """End all connections, and let nobody connect, until `mend`."""
        self._is_cut = True
        for end in tuple(self._ends):
            end.abort()

    def mend(self) -> None:
        """Let the robot connect again."""
        self._is_cut = False

    def opened(self, end: _End) -> None:
        """One end is connected."""
        if self._is_cut:
            end.transport.abort()
            return
        self._ends.add(end.transport)
        if end.other is None:
            end.transport.pause_reading()
            end.connecting = asyncio.create_task(self._connect(end), name="cable to the router")

    def closed(self, end: _End) -> None:
        """One end is not connected any more: neither is the other."""
        self._ends.discard(end.transport)
        if end.other is not None:
            end.other.transport.close()

    async def _connect(self, end: _End) -> None:
        loop = asyncio.get_running_loop()
        try:
            to_router, _ = await loop.create_connection(lambda: _End(self, end), self._host, self._port)
        except OSError:
            end.transport.abort()
        else:
            if end.transport.is_closing():  # meanwhile
                to_router.abort()
            else:
                end.transport.resume_reading()


class _End(asyncio.Protocol):
    """One of the two connections of a cable."""

    transport: asyncio.Transport
    connecting: asyncio.Task[None] | None = None

    def __init__(self, cable: Cable, other: _End | None = None) -> None:
        self._cable = cable
        self.other = other

    def connection_made(self, transport: Any) -> None:
        self.transport = transport
        if self.other is not None:
            self.other.other = self
        self._cable.opened(self)

    def data_received(self, data: bytes) -> None:
        if self.other is not None:
            self.other.transport.write(data)

    def pause_writing(self) -> None:
        if self.other is not None and not self.other.transport.is_closing():
            self.other.transport.pause_reading()

    def resume_writing(self) -> None:
        if self.other is not None and not self.other.transport.is_closing():
            self.other.transport.resume_reading()

    def connection_lost(self, error: Exception | None) -> None:
        self._cable.closed(self)


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[None]:
    """Mount a file system of `size` bytes in memory at a new folder. Skips the test where that is not allowed."""
    if sys.platform != "linux" or os.geteuid() != 0:
        pytest.skip("a robot gets a disk of its own only on Linux, and as root")
    folder.mkdir()
    options = f"size={size},mode=700"
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"a robot can't get a disk of its own here: {mounted.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


@contextmanager
def full(folder: Path) -> Iterator[None]:
    """Meanwhile the disk has no byte left."""
    filler = folder / FILLER
    try:
        with filler.open("wb", buffering=0) as file:
            while True:
                try:
                    file.write(bytes(64 << 10))
                except OSError:  # ENOSPC
                    break
        yield
    finally:
        filler.unlink()
