"""Clients of the door: the SDK's own, over stdio and HTTP, of each revision of the protocol."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import httpx2
from mcp import Client, StdioServerParameters
from mcp.client.streamable_http import streamable_http_client
from mcp_types.version import LATEST_HANDSHAKE_VERSION

from tests.support.commands import AIRA

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator
    from pathlib import Path


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
