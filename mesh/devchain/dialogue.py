"""One WebSocket of the JSON-RPC server: requests and their responses, and what was subscribed to."""

from __future__ import annotations

import asyncio
import json
import logging
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from aiohttp import WSMsgType

from mesh.devchain.jsonrpc import INVALID_PARAMS, RpcError

if TYPE_CHECKING:
    from aiohttp import web

    from mesh.devchain.dispatch import Dispatcher
    from mesh.devchain.feed import Feed

log = logging.getLogger(__name__)

MAX_WAITING: Final = 10_000
"""Texts that wait for a client to read them; one that falls further behind is cut off."""


class Dialogue:
    """Talks on an open socket until either side closes it. Requests are answered one after another."""

    def __init__(self, request: web.Request, socket: web.WebSocketResponse, dispatcher: Dispatcher, feed: Feed) -> None:
        self._request = request
        self._socket = socket
        self._dispatcher = dispatcher
        self._feed = feed
        self._waiting: asyncio.Queue[Any] = asyncio.Queue()
        self._subscriptions: set[str] = set()
        self._held: list[Any] | None = None
        """What is told while a request is answered: a subscription's name goes out before what it brings."""

    async def run(self) -> None:
        """Answer until the socket is closed."""
        methods = {"eth_subscribe": self._subscribe, "eth_unsubscribe": self._unsubscribe}
        writing = asyncio.create_task(self._write(), name="aira-chain-socket-writer")
        try:
            async for message in self._socket:
                if message.type not in (WSMsgType.TEXT, WSMsgType.BINARY):
                    continue
                self._held = []
                answer = await self._dispatcher.respond(message.data, methods=methods)
                held, self._held = self._held, None
                for one in ([] if answer is None else [answer]) + held:
                    self._say(one)
        finally:
            for name in self._subscriptions:
                self._feed.unsubscribe(name)
            writing.cancel()
            await asyncio.wait([writing])

    async def close(self) -> None:
        """Say that the server goes away."""
        await self._socket.close(code=1001, message=b"the node ends")

    async def _subscribe(self, params: list[Any]) -> str:
        name = await self._feed.subscribe(params, self._notify)
        self._subscriptions.add(name)
        return name

    async def _unsubscribe(self, params: list[Any]) -> bool:
        if len(params) != 1 or params[0] not in self._subscriptions:
            raise RpcError(INVALID_PARAMS, "there is no such subscription on this connection")
        self._subscriptions.remove(params[0])
        return self._feed.unsubscribe(params[0])

    def _notify(self, notification: dict[str, Any]) -> None:
        if self._held is None:
            self._say(notification)
        else:
            self._held.append(notification)

    def _say(self, message: Any) -> None:
        if self._waiting.qsize() < MAX_WAITING:
            self._waiting.put_nowait(message)
        elif self._request.transport is not None:
            log.warning("a client reads too slowly; its connection is cut off")
            self._request.transport.abort()

    async def _write(self) -> None:
        with suppress(ConnectionError):
            while True:
                await self._socket.send_str(json.dumps(await self._waiting.get()))
