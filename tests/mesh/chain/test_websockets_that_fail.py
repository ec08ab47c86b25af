"""A WebSocket that is closed, and one that answers pings but no requests."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from aiohttp import WSMsgType, web

from mesh.chain import Node
from mesh.dev import EmbeddedChain
from schemas.decoding import decode_json
from tests.mesh.chain.conftest import QUICK

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


class Socket:
    """A WebSocket of a node that never pushes a block: `is_stuck` answers pings only."""

    def __init__(self, node: EmbeddedChain) -> None:
        self.node = node
        self.is_stuck = False
        self.opened: list[web.WebSocketResponse] = []

    async def handle(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        self.opened.append(socket)
        stuck = self.is_stuck
        async for message in socket:
            stuck = stuck or (self.is_stuck and socket is self.opened[0])
            if message.type is not WSMsgType.BINARY or stuck:
                continue
            asked = decode_json(message.data)
            if asked["method"] == "eth_subscribe":
                answer = {"jsonrpc": "2.0", "result": "0x1"}
            else:
                answer = dict(await self.node.provider.make_request(asked["method"], asked["params"]))
            await socket.send_json(answer | {"id": asked["id"]})
        return socket

    @asynccontextmanager
    async def serve(self) -> AsyncIterator[str]:
        application = web.Application()
        application.router.add_get("/", self.handle)
        runner = web.AppRunner(application, shutdown_timeout=0.1)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        try:
            yield f"ws://127.0.0.1:{runner.addresses[0][1]}"
        finally:
            await runner.cleanup()


async def test_a_closed_websocket_does_not_blind_who_waits_for_a_block() -> None:
    async with EmbeddedChain() as evm, (socket := Socket(evm)).serve() as url, Node(url, timing=QUICK) as node:
        head = await node.heads.look()
        node.heads.pushed(head)
        waiting = asyncio.create_task(node.heads.next(head.hash))
        await asyncio.sleep(0)
        await evm.mine(1)
        await socket.opened[0].close()
        async with asyncio.timeout(10):
            assert (await waiting).number == head.number + 1
        assert len(socket.opened) == 2


@pytest.mark.parametrize("attempts", [2])
async def test_a_websocket_that_answers_pings_only_is_replaced(attempts: int) -> None:
    timing = replace(QUICK, request_timeout=0.5, attempts=attempts)
    async with EmbeddedChain() as evm, (socket := Socket(evm)).serve() as url, Node(url, timing=timing) as node:
        await node.block_number()
        socket.is_stuck = True
        asking = asyncio.create_task(node.block_number())
        await asyncio.sleep(0.1)
        socket.is_stuck = False
        async with asyncio.timeout(10):
            await asking
        assert len(socket.opened) == 2
