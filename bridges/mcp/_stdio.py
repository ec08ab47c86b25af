"""The door over stdin and stdout, for a client that starts `aira mcp` itself."""

from __future__ import annotations

import asyncio
import os
import stat
import sys
from typing import TYPE_CHECKING, Any, Final

from mcp.server.stdio import stdio_server

from mesh.errors import InputError
from mesh.signer.protocol import LARGEST_REQUEST

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mcp.server.lowlevel import Server

LONGEST_LINE: Final = 2 * LARGEST_REQUEST
"""Bytes of a message; longer ones are skipped."""
_TOO_LONG: Final = "a message that is too long\n"


async def serve_stdio(server: Server[Any]) -> None:
    """Serve the client until it closes stdin. Raises `InputError` if stdin is a file, or /dev/null."""
    kind = os.fstat(sys.stdin.fileno()).st_mode
    if not (stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind) or sys.stdin.isatty()):
        raise InputError(
            "stdin is no pipe", hint="an MCP client starts this command; for HTTP use --http", code="stdin-unusable"
        )
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader(limit=LONGEST_LINE)
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    lines: Any = _lines(reader)  # the SDK iterates over it, and asks no more of a file
    async with stdio_server(stdin=lines) as (incoming, outgoing):
        await server.run(incoming, outgoing, server.create_initialization_options())


async def _lines(reader: asyncio.StreamReader) -> AsyncIterator[str]:
    is_too_long = False
    while True:
        try:
            line = await reader.readuntil(b"\n")
        except asyncio.LimitOverrunError as error:
            await reader.readexactly(error.consumed)
            is_too_long = True
        except asyncio.IncompleteReadError:
            return
        else:
            # The SDK answers what is no message with an error.
            yield _TOO_LONG if is_too_long else line.decode("utf-8", "replace")
            is_too_long = False
