"""The door over HTTP in this process; and the SDK's own clients, over stdio and HTTP, of each revision."""

from __future__ import annotations

from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx2
from mcp import Client, StdioServerParameters
from mcp.client.streamable_http import streamable_http_client
from mcp_types.version import LATEST_HANDSHAKE_VERSION

from bridges.mcp._door import McpDoor
from bridges.mcp._http import PATH, application
from mesh.base.asgi_server import AsgiServer
from mesh.base.door import DoorLimits
from mesh.signer.client import SignerClient
from tests.support.commands import AIRA

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator

    from bridges.mcp._http import McpOptions


HEADERS = {"Content-Type": "application/json", "Accept": "application/json, text/event-stream"}
CALL = {
    "jsonrpc": "2.0",
    "id": 1,
    "method": "initialize",
    "params": {"protocolVersion": "2025-11-25", "capabilities": {}, "clientInfo": {"name": "test", "version": "1"}},
}


@asynccontextmanager
async def served(options: McpOptions, *, limits: DoorLimits = DoorLimits()) -> AsyncIterator[str]:  # noqa: B008
    """The door over HTTP, in this process, of a signer that does not run; its URL."""
    async with SignerClient(Path("/nowhere/door.sock")) as signer:
        app = application(McpDoor(signer).server, options)
        async with AsgiServer(app, options.host, options.port, limits=limits) as server:
            yield f"http://127.0.0.1:{server.port}{PATH}"


def _mode(version: str) -> str:
    """The mode in which the SDK's client speaks a revision."""
    return "legacy" if version == LATEST_HANDSHAKE_VERSION else "auto"


@asynccontextmanager
async def http_client(
    url: str, token: str, version: str, *, verify: ssl.SSLContext | bool = True, **options: Any
) -> AsyncIterator[Client]:
    headers = {"Authorization": f"Bearer {token}"}
    async with httpx2.AsyncClient(headers=headers, timeout=60, verify=verify) as http:
        transport = streamable_http_client(url, http_client=http)
        async with Client(transport, mode=_mode(version), **options) as client:
            yield client


@asynccontextmanager
async def stdio_client(
    *arguments: str, version: str, pid_file: Path | None = None, **options: Any
) -> AsyncIterator[Client]:
    """A client that starts `aira mcp` as assistants do; the process id is written to `pid_file`."""
    command = [*map(str, AIRA), "mcp", *arguments]
    if pid_file is not None:
        command = ["sh", "-c", 'echo $$ > "$0" && exec "$@"', str(pid_file), *command]
    process = StdioServerParameters(command=command[0], args=command[1:])
    async with Client(process, mode=_mode(version), **options) as client:
        yield client
