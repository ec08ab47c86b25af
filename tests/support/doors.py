"""The doors of a signer for programs, `aira mcp` and `aira a2a`: over HTTP, in processes of their own."""

from __future__ import annotations

import asyncio
from asyncio.subprocess import PIPE
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, NamedTuple

from tests.support.commands import AIRA

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

TOKEN = "a token of a private file"


class DoorProcess(NamedTuple):
    """A door that listens."""

    url: str
    pid: int


@asynccontextmanager
async def door_process(door: str, socket: Path, state: Path, *options: str) -> AsyncIterator[DoorProcess]:
    """`aira mcp` or `aira a2a` before the signer on a socket, with a folder for its state; it is killed in the end."""
    token = _token_file(state)
    places = ("--socket", str(socket), "--data-dir", str(state), "--token-file", str(token))
    command = (*AIRA, door, "--http", "127.0.0.1:0", *places, *options)
    process = await asyncio.create_subprocess_exec(*command, stdout=PIPE)
    try:
        assert process.stdout is not None
        async with asyncio.timeout(60):
            line = await process.stdout.readline()
        yield DoorProcess(line.decode().split()[-1], process.pid)
    finally:
        process.kill()
        await process.wait()


def _token_file(folder: Path) -> Path:
    folder.mkdir(mode=0o700, exist_ok=True)
    path = folder / "token"
    path.write_text(TOKEN)
    path.chmod(0o600)
    return path
