"""JSON-RPC over HTTP and WebSocket in front of a provider, so that several processes share one embedded chain."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final

from aiohttp import web

from mesh.devchain.dialogue import Dialogue
from mesh.devchain.dispatch import Dispatcher
from mesh.devchain.feed import Feed
from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable
    from types import TracebackType
    from typing import Self

    from web3.providers.async_base import AsyncBaseProvider

MAX_BODY_BYTES: Final = 4 * 1024 * 1024
HEARTBEAT: Final = 30.0
"""Seconds between two looks whether the other side of a WebSocket is still there."""
LOOPBACK_NAMES: Final = frozenset({"127.0.0.1", "localhost", "[::1]", "::1"})


class JsonRpcServer:
    """Serves `provider` (any whose results are JSON, as the embedded chain's and web3's HTTP provider's are).

    Requests come by POST or on a WebSocket, at the same address; a WebSocket also has `eth_subscribe`, of `newHeads`
    and `logs`, and `eth_unsubscribe`.

    It listens on loopback unless told otherwise. A browser's page may call it only from one of `allowed_origins`
    (`"*"` for any); a loopback server also refuses requests that name another host, as a rebound DNS name would.

    Used with `async with`; leaving it finishes the requests under way. Entering raises `ConfigurationError` when the
    port is taken.
    """

    def __init__(
        self,
        provider: AsyncBaseProvider,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        allowed_origins: Iterable[str] = (),
    ) -> None:
        self._dispatcher = Dispatcher(provider)
        self._feed: Feed | None = None
        self._dialogues: set[Dialogue] = set()
        self._host = host
        self._port = port
        self._origins = frozenset(allowed_origins)
        self._runner: web.AppRunner | None = None

    @property
    def url(self) -> str:
        """Where it listens, with the port that was really taken."""
        return f"http://{self._host}:{self._port}"

    @property
    def ws_url(self) -> str:
        """The same for WebSockets."""
        return f"ws://{self._host}:{self._port}"

    async def __aenter__(self) -> Self:
        app = web.Application(client_max_size=MAX_BODY_BYTES)
        app.router.add_post("/", self._post)
        app.router.add_get("/", self._open_socket)
        app.router.add_options("/", self._preflight)
        app.cleanup_ctx.append(self._feeding)
        app.on_shutdown.append(self._close_sockets)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=2.0)
        await self._runner.setup()
        try:
            await web.TCPSite(self._runner, self._host, self._port).start()
        except OSError as error:
            await self._runner.cleanup()
            raise ConfigurationError(
                f"can't listen on {self._host}:{self._port}: {os.strerror(error.errno) if error.errno else error}",
                hint="another node may run there; choose another port",
            ) from None
        self._port = self._runner.addresses[0][1]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._runner is not None:
            await self._runner.cleanup()
            self._runner = None

    async def _feeding(self, _app: web.Application) -> AsyncIterator[None]:
        async with Feed(self._dispatcher.ask) as self._feed:
            yield

    async def _close_sockets(self, _app: web.Application) -> None:
        for dialogue in list(self._dialogues):
            await dialogue.close()

    async def _post(self, request: web.Request) -> web.Response:
        headers = self._admit(request)
        answer = await self._dispatcher.respond(await request.read())
        if answer is None:
            return web.Response(status=204, headers=headers)
        return web.json_response(answer, headers=headers)

    async def _open_socket(self, request: web.Request) -> web.StreamResponse:
        headers = self._admit(request)
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT, max_msg_size=MAX_BODY_BYTES)
        if not socket.can_prepare(request):
            raise web.HTTPUpgradeRequired(
                text="this is a node: POST JSON-RPC here, or open a WebSocket", headers=headers
            )
        assert self._feed is not None
        await socket.prepare(request)
        dialogue = Dialogue(request, socket, self._dispatcher, self._feed)
        self._dialogues.add(dialogue)
        try:
            await dialogue.run()
        finally:
            self._dialogues.discard(dialogue)
        return socket

    async def _preflight(self, request: web.Request) -> web.Response:
        headers = self._admit(request)
        return web.Response(
            status=204,
            headers=headers | {"Access-Control-Allow-Methods": "POST", "Access-Control-Allow-Headers": "content-type"},
        )

    def _admit(self, request: web.Request) -> dict[str, str]:
        """The headers that let a page read the answer. Raises HTTP 403 for a page that may not ask."""
        name = (request.host or "").rpartition(":")[0] or request.host
        if self._host in LOOPBACK_NAMES and name not in LOOPBACK_NAMES:
            raise web.HTTPForbidden(text="this node serves its own machine only")
        origin = request.headers.get("Origin")
        if origin is None:
            return {}
        if origin not in self._origins and "*" not in self._origins:
            raise web.HTTPForbidden(text="pages of this origin may not ask this node")
        return {"Access-Control-Allow-Origin": origin, "Vary": "Origin"}
