"""JSON-RPC over HTTP or WebSocket, on one connection that stays open until it is closed."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from itertools import count
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec
from aiohttp import ClientError, ClientResponse, ClientSession, ClientWebSocketResponse, WSMsgType

from mesh.chain.answers import MAX_ANSWER, SpoiledAnswer

if TYPE_CHECKING:
    from collections.abc import Callable

TOO_MANY_REQUESTS: Final = 429
PIECE: Final = 1 << 16
"""Bytes that are read of an answer at a time."""


class Transport(Protocol):
    """What carries requests to a node; web3's asynchronous providers do."""

    async def make_request(self, method: Any, params: Any) -> Any:
        """The node's response, a JSON object with a result or an error. Raises as `HttpTransport` does."""


class HttpTransport:
    """A node at `http(s)://…`. Raises aiohttp's errors, `OSError`, and `ValueError` for an answer that is not JSON."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._numbers = count()
        self._session: ClientSession | None = None

    async def make_request(self, method: str, params: Any) -> Any:
        """The node's response, with a result or an error."""
        if self._session is None:
            self._session = ClientSession(headers={"Content-Type": "application/json"})
        async with self._session.post(self._url, data=_encode(next(self._numbers), method, params)) as response:
            body = await _read(response)
            # Some nodes answer errors with HTTP 4xx or 5xx and a JSON-RPC error in the body. "Too many requests" is
            # raised for a retry.
            if response.status == TOO_MANY_REQUESTS or (not response.ok and not body.lstrip().startswith(b"{")):
                response.raise_for_status()
            return _decode(body)

    async def close(self) -> None:
        """Close the connection; a later request opens another."""
        session, self._session = self._session, None
        if session is not None:
            await session.close()

    def __str__(self) -> str:
        return self._url


class WebSocketTransport:
    """A node at `ws(s)://…`. Raises as `HttpTransport`, and `ConnectionError` for a lost connection."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._numbers = count()
        self._opening = asyncio.Lock()
        self._session: ClientSession | None = None
        self._socket: ClientWebSocketResponse | None = None
        self._listening: asyncio.Task[None] | None = None
        self._waiting: dict[int, asyncio.Future[Any]] = {}
        self._on_head: Callable[[Any], None] | None = None
        self._subscribing: asyncio.Task[None] | None = None
        self._subscription: Any = None

    def push_heads(self, on_head: Callable[[Any], None]) -> None:
        """Call `on_head` with each new block that the node pushes, as JSON, and with None when it no longer does.

        A node that has no such subscription is not asked again.
        """
        if self._on_head is None:
            self._on_head = on_head
            if self._socket is not None and not self._socket.closed:
                self._subscribing = asyncio.create_task(self._subscribe(), name="aira-chain-heads")

    async def make_request(self, method: str, params: Any) -> Any:
        """The node's response, with a result or an error."""
        socket = await self._opened()
        number = next(self._numbers)
        answer: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answer
        try:
            await socket.send_bytes(_encode(number, method, params))
            return await answer
        finally:
            self._waiting.pop(number, None)

    async def close(self) -> None:
        """Close the connection; a later request opens another."""
        session, self._session, self._socket = self._session, None, None
        if session is not None:
            await session.close()
        if self._subscribing is not None:
            self._subscribing.cancel()
            self._subscribing = None
        if self._listening is not None:
            await self._listening
            self._listening = None

    async def _opened(self) -> ClientWebSocketResponse:
        async with self._opening:
            if self._socket is None or self._socket.closed:
                await self.close()
                self._session = ClientSession()
                self._socket = await self._session.ws_connect(self._url, max_msg_size=MAX_ANSWER, heartbeat=30)
                self._listening = asyncio.create_task(self._read(self._socket), name="aira-chain-websocket")
                if self._on_head is not None:
                    self._subscribing = asyncio.create_task(self._subscribe(), name="aira-chain-heads")
            return self._socket

    async def _subscribe(self) -> None:
        """Ask for new blocks. A failure changes nothing: blocks are polled then."""
        with suppress(OSError, ValueError, ClientError):
            response = await self.make_request("eth_subscribe", ["newHeads"])
            self._subscription = response.get("result")

    async def _read(self, socket: ClientWebSocketResponse) -> None:
        """Deliver the answers to the requests that wait for them, until the connection ends."""
        async for message in socket:
            if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                self._deliver(message.data)
        self._fail_all(ConnectionResetError("the connection was closed"))
        if self._subscription is not None and self._on_head is not None:
            self._subscription = None
            self._on_head(None)

    def _deliver(self, text: str | bytes) -> None:
        """Give an answer to the request with its id. One that names no request may be anybody's: all ask again."""
        try:
            response: Any = _decode(text)
            if isinstance(response, dict) and response.get("method") == "eth_subscription":
                self._take_pushed(response.get("params"))
                return
            number = response.get("id") if isinstance(response, dict) else None
            if not isinstance(number, int):
                raise SpoiledAnswer("an answer without the id of its request")
        except ValueError as error:
            self._fail_all(error)
            return
        answer = self._waiting.get(number)
        if answer is not None and not answer.done():
            answer.set_result(response)

    def _take_pushed(self, params: Any) -> None:
        is_ours = isinstance(params, dict) and params.get("subscription") == self._subscription
        if is_ours and self._on_head is not None and "result" in params:
            self._on_head(params["result"])

    def _fail_all(self, error: Exception) -> None:
        for answer in self._waiting.values():
            if not answer.done():
                answer.set_exception(error)

    def __str__(self) -> str:
        return self._url


async def _read(response: ClientResponse) -> bytes:
    """The body of an answer. Raises `SpoiledAnswer` above `MAX_ANSWER`."""
    body = bytearray()
    async for piece in response.content.iter_chunked(PIECE):
        body += piece
        if len(body) > MAX_ANSWER:
            raise SpoiledAnswer(f"its answer is longer than {MAX_ANSWER} bytes")
    return bytes(body)


def _encode(number: int, method: str, params: Any) -> bytes:
    return msgspec.json.encode({"jsonrpc": "2.0", "id": number, "method": method, "params": params})


def _decode(text: str | bytes) -> Any:
    """The JSON of an answer. Raises `ValueError`: `SpoiledAnswer` for one that begins as an answer does."""
    try:
        return msgspec.json.decode(text)
    except (ValueError, RecursionError):
        begins = text.lstrip()[:1] in (b"{", "{")
        raise SpoiledAnswer("its answer is not JSON to the end") if begins else ValueError("not JSON") from None
