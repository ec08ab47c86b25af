"""A JSON-RPC server with a WebSocket, and a client that hears what it pushes."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import aiohttp
import pytest

from mesh.devchain import EmbeddedChain, JsonRpcServer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


@pytest.fixture
async def node() -> AsyncIterator[EmbeddedChain]:
    async with EmbeddedChain() as node:
        yield node


@pytest.fixture
async def server(node: EmbeddedChain) -> AsyncIterator[JsonRpcServer]:
    async with JsonRpcServer(node.provider) as server:
        yield server


class Client:
    """A client that hears all that comes on its socket."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.heard: list[Any] = []

    async def hear(self) -> Any:
        """The next text."""
        async with asyncio.timeout(30):
            self.heard.append(json.loads((await self.socket.receive()).data))
        return self.heard[-1]

    async def ask(self, method: str, *params: Any) -> Any:
        await self.socket.send_json({"jsonrpc": "2.0", "id": len(self.heard), "method": method, "params": params})
        return await self.hear()

    async def subscribe(self, *params: Any) -> str:
        answer = await self.ask("eth_subscribe", *params)
        return str(answer["result"])

    async def notified(self, subscription: str) -> Any:
        """The next notification, which is of that subscription."""
        heard = await self.hear()
        assert (heard["method"], heard["params"]["subscription"]) == ("eth_subscription", subscription)
        return heard["params"]["result"]


@asynccontextmanager
async def connected(server: JsonRpcServer, **headers: str) -> AsyncIterator[Client]:
    async with aiohttp.ClientSession() as session, session.ws_connect(server.ws_url, headers=headers) as socket:
        yield Client(socket)
