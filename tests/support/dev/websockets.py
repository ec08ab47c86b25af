"""An embedded chain behind a JSON-RPC server, and a WebSocket client with subscriptions."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import aiohttp
import pytest

from mesh.dev import EmbeddedChain, JsonRpcServer

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


class SubscriptionClient:
    """A JSON-RPC client that also receives notifications."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.received: list[Any] = []

    async def receive(self) -> Any:
        """The next message."""
        async with asyncio.timeout(30):
            self.received.append(json.loads((await self.socket.receive()).data))
        return self.received[-1]

    async def ask(self, method: str, *params: Any) -> Any:
        await self.socket.send_json({"jsonrpc": "2.0", "id": len(self.received), "method": method, "params": params})
        return await self.receive()

    async def subscribe(self, *params: Any) -> str:
        answer = await self.ask("eth_subscribe", *params)
        return str(answer["result"])

    async def next_notification(self, subscription: str) -> Any:
        """The next message, which must be a notification of that subscription."""
        heard = await self.receive()
        assert (heard["method"], heard["params"]["subscription"]) == ("eth_subscription", subscription)
        return heard["params"]["result"]


@asynccontextmanager
async def connected(server: JsonRpcServer, **headers: str) -> AsyncIterator[SubscriptionClient]:
    async with aiohttp.ClientSession() as session, session.ws_connect(server.ws_url, headers=headers) as socket:
        yield SubscriptionClient(socket)
