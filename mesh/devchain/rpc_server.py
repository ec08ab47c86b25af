"""A JSON-RPC server over HTTP and WebSocket in front of a provider: several processes share one embedded chain."""

from __future__ import annotations

import asyncio
import json
import logging
import os
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from aiohttp import WSMsgType, web

from mesh.devchain.errors import PortUnavailable
from mesh.devchain.jsonrpc import INVALID_PARAMS, LIMIT_EXCEEDED, MAX_RESPONSE_BYTES, Dispatcher, RpcError
from mesh.devchain.subscriptions import Subscriptions
from mesh.log_context import log_event

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable
    from typing import Self

    from mesh.chain.transports import Transport

log = logging.getLogger(__name__)

MAX_BODY_BYTES: Final = 4 * 1024 * 1024
HEARTBEAT: Final = 30.0
"""Seconds between two pings of a WebSocket."""
MAX_UNSENT: Final = 10_000
"""Messages that wait for a client to read them; a client that falls further behind is disconnected."""
MAX_UNSENT_BYTES: Final = 64_000_000
ACCEPTED_WITHIN: Final = 0.02
"""Seconds after which connections that were accepted before the end are made, and can be closed."""
MAX_CONNECTIONS: Final = 200
"""WebSockets that are open at once; more are refused with HTTP 503."""
MAX_SUBSCRIPTIONS: Final = 100
"""Subscriptions of a connection."""
LOOPBACK_NAMES: Final = frozenset({"127.0.0.1", "localhost", "[::1]", "::1"})


class JsonRpcServer:
    """Serves `provider` (the embedded chain's, or another whose results are JSON).

    Requests are sent by POST or over a WebSocket, at the same address; a WebSocket also has `eth_subscribe` (`newHeads`
    and `logs`) and `eth_unsubscribe`.

    It listens on loopback by default. A web page may call it only from one of `allowed_origins` (`"*"` for any); a
    loopback server also refuses requests that name another host, as after DNS rebinding.

    Used with `async with`; leaving it finishes the requests in progress. Entering raises `PortUnavailable` when the
    port is taken.
    """

    def __init__(
        self,
        provider: Transport,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        allowed_origins: Iterable[str] = (),
        max_response_bytes: int = MAX_RESPONSE_BYTES,
    ) -> None:
        self._dispatcher = Dispatcher(provider, max_response_bytes=max_response_bytes)
        self._subscriptions: Subscriptions | None = None
        self._connections: set[WebSocketConnection] = set()
        self._host = host
        self._port = port
        self._origins = frozenset(allowed_origins)
        self._runner: web.AppRunner | None = None

    @property
    def url(self) -> str:
        """Where it listens, with the actual port."""
        return f"http://{self._host}:{self._port}"

    @property
    def ws_url(self) -> str:
        """The address for WebSockets."""
        return f"ws://{self._host}:{self._port}"

    @property
    def connections(self) -> int:
        """How many WebSockets are open."""
        return len(self._connections)

    async def __aenter__(self) -> Self:
        app = web.Application(client_max_size=MAX_BODY_BYTES)
        app.router.add_post("/", self._post)
        app.router.add_get("/", self._open_socket)
        app.router.add_options("/", self._preflight)
        app.cleanup_ctx.append(self._run_subscriptions)
        app.on_shutdown.append(self._close_sockets)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=2.0)
        await self._runner.setup()
        factory = self._runner.server
        assert factory is not None
        try:
            self._listener = await asyncio.get_running_loop().create_server(factory, self._host, self._port)
        except OSError as error:
            await self._runner.cleanup()
            why = os.strerror(error.errno) if error.errno else str(error)
            raise PortUnavailable(self._host, self._port, why) from None
        self._port = self._listener.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._runner is not None:
            for listening in self._listener.sockets:
                asyncio.get_running_loop().remove_reader(listening)
            await asyncio.sleep(ACCEPTED_WITHIN)  # a connection that is made after `close` would never be closed
            self._listener.close()
            await self._runner.cleanup()
            self._runner = None

    async def _run_subscriptions(self, _app: web.Application) -> AsyncIterator[None]:
        async with Subscriptions(self._dispatcher.ask) as self._subscriptions:
            yield

    async def _close_sockets(self, _app: web.Application) -> None:
        for connection in list(self._connections):
            await connection.close()

    async def _post(self, request: web.Request) -> web.Response:
        headers = self._admit(request)
        answer = await self._dispatcher.respond(await request.read())
        if answer is None:
            return web.Response(status=204, headers=headers)
        return web.Response(text=answer, content_type="application/json", headers=headers)

    async def _open_socket(self, request: web.Request) -> web.StreamResponse:
        headers = self._admit(request)
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT, max_msg_size=MAX_BODY_BYTES)
        if not socket.can_prepare(request):
            raise web.HTTPUpgradeRequired(
                text="this is a node: POST JSON-RPC here, or open a WebSocket", headers=headers
            )
        if len(self._connections) >= MAX_CONNECTIONS:
            raise web.HTTPServiceUnavailable(text="too many WebSockets are open", headers=headers)
        assert self._subscriptions is not None
        connection = WebSocketConnection(request, socket, self._dispatcher, self._subscriptions)
        self._connections.add(connection)
        try:
            await socket.prepare(request)
            await connection.run()
        finally:
            self._connections.discard(connection)
        return socket

    async def _preflight(self, request: web.Request) -> web.Response:
        headers = self._admit(request)
        return web.Response(
            status=204,
            headers=headers | {"Access-Control-Allow-Methods": "POST", "Access-Control-Allow-Headers": "content-type"},
        )

    def _admit(self, request: web.Request) -> dict[str, str]:
        """The headers that let a page read the answer. Raises HTTP 403 for a page that is not allowed to ask."""
        name = (request.host or "").rpartition(":")[0] or request.host
        if self._host in LOOPBACK_NAMES and name not in LOOPBACK_NAMES:
            raise web.HTTPForbidden(text="this node serves its own machine only")
        origin = request.headers.get("Origin")
        if origin is None:
            return {}
        if origin not in self._origins and "*" not in self._origins:
            raise web.HTTPForbidden(text="pages of this origin may not ask this node")
        return {"Access-Control-Allow-Origin": origin, "Vary": "Origin"}


class WebSocketConnection:
    """One WebSocket: answers its requests one after another, and sends what it subscribed to."""

    def __init__(
        self,
        request: web.Request,
        socket: web.WebSocketResponse,
        dispatcher: Dispatcher,
        subscriptions: Subscriptions,
    ) -> None:
        self._request = request
        self._socket = socket
        self._dispatcher = dispatcher
        self._subscriptions = subscriptions
        self._own_ids: set[str] = set()
        self._unsent: asyncio.Queue[str] = asyncio.Queue()
        self._unsent_bytes = 0
        self._held: list[str] | None = None
        """Notifications during a request: the id of a new subscription is sent before its first notification."""

    async def run(self) -> None:
        """Answer until either side closes the socket."""
        methods = {"eth_subscribe": self._subscribe, "eth_unsubscribe": self._unsubscribe}
        writing = asyncio.create_task(self._write(), name="aira-chain-socket-writer")
        try:
            async for message in self._socket:
                if message.type not in (WSMsgType.TEXT, WSMsgType.BINARY):
                    continue
                self._held = []
                answer = await self._dispatcher.respond(message.data, methods=methods)
                held, self._held = self._held, None
                for text in ([] if answer is None else [answer]) + held:
                    self._send(text)
        finally:
            for subscription_id in self._own_ids:
                self._subscriptions.remove(subscription_id)
            writing.cancel()
            await asyncio.wait([writing])

    async def close(self) -> None:
        """Close the socket because the server stops."""
        await self._socket.close(code=1001, message=b"the node ends")

    async def _subscribe(self, params: list[Any]) -> str:
        if len(self._own_ids) >= MAX_SUBSCRIPTIONS:
            raise RpcError(LIMIT_EXCEEDED, f"a connection has at most {MAX_SUBSCRIPTIONS} subscriptions")
        subscription_id = await self._subscriptions.add(params, self._notify)
        self._own_ids.add(subscription_id)
        return subscription_id

    async def _unsubscribe(self, params: list[Any]) -> bool:
        if len(params) != 1 or params[0] not in self._own_ids:
            raise RpcError(INVALID_PARAMS, "there is no such subscription on this connection")
        self._own_ids.remove(params[0])
        return self._subscriptions.remove(params[0])

    def _notify(self, notification: dict[str, Any]) -> None:
        text = json.dumps(notification)
        if self._held is None:
            self._send(text)
        elif len(self._held) < MAX_UNSENT:
            self._held.append(text)
        else:
            self._drop()

    def _send(self, text: str) -> None:
        self._unsent_bytes += len(text)
        if self._unsent.qsize() < MAX_UNSENT and self._unsent_bytes < MAX_UNSENT_BYTES:
            self._unsent.put_nowait(text)
        else:
            self._drop()

    def _drop(self) -> None:
        if self._request.transport is not None:
            log.warning(
                "a client reads too slowly; disconnecting it",
                extra=log_event("rpc-client-dropped", client=self._request.remote),
            )
            self._request.transport.abort()

    async def _write(self) -> None:
        with suppress(ConnectionError):
            while True:
                text = await self._unsent.get()
                await self._socket.send_str(text)
                self._unsent_bytes -= len(text)
