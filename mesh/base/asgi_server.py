"""HTTP servers of ASGI applications (uvicorn), behind a `Door`: for SDKs that are made of such applications."""

from __future__ import annotations

import asyncio
import logging
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, ClassVar, Final

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from mesh.base.background import Background
from mesh.base.door import Door, DoorLimits, Guest
from mesh.base.http_server import listening_sockets
from mesh.base.lifecycle import Lifecycle

if TYPE_CHECKING:
    import socket
    import ssl
    from collections.abc import Awaitable, Callable, MutableMapping
    from contextlib import AbstractContextManager, AsyncExitStack

    Message = MutableMapping[str, Any]
    Receive = Callable[[], Awaitable[Message]]
    Send = Callable[[Message], Awaitable[None]]
    AsgiApplication = Callable[[MutableMapping[str, Any], Receive, Send], Awaitable[None]]

LARGEST_HEAD: Final = 32 << 10
"""Bytes of the head of a request."""


class AsgiServer(Lifecycle):
    """Serves an application: `async with AsgiServer(app, host, port) as server`, then `server.port`.

    Leaving finishes the requests in progress for two seconds, and ends all connections. Entering raises
    `PortUnavailable`, whose hint names the `option` for the port.
    """

    title = "HTTP server"

    def __init__(
        self,
        app: AsgiApplication,
        host: str,
        port: int,
        *,
        tls: ssl.SSLContext | None = None,
        limits: DoorLimits = DoorLimits(),  # noqa: B008
        option: str = "--port",
    ) -> None:
        self._app = app
        self._host = host
        self._tls = tls
        self._option = option
        self._door = Door(limits)
        self._guests: dict[tuple[str, int], Guest] = {}
        self.port = port
        """Where it listens."""

    @property
    def url(self) -> str:
        """Where it is reached, without a path."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"{'http' if self._tls is None else 'https'}://{host}:{self.port}"

    async def _open(self, stack: AsyncExitStack) -> None:
        listening = await listening_sockets(self._host, self.port, option=self._option)
        for one in listening:
            stack.callback(one.close)
        self.port = listening[0].getsockname()[1]
        stack.callback(self._door.end_all)
        tls = self._tls
        config = uvicorn.Config(
            self._watched,
            interface="asgi3",
            http=type("GuestProtocol", (_GuestProtocol,), {"door": self._door, "guests": self._guests}),
            ws="none",
            log_config=None,
            access_log=False,
            proxy_headers=False,
            server_header=False,
            date_header=False,
            lifespan="on",
            h11_max_incomplete_event_size=LARGEST_HEAD,
            timeout_graceful_shutdown=2,
            ssl_context_factory=None if tls is None else lambda *_: tls,
        )
        server = _Server(config)
        tasks = await stack.enter_async_context(Background())
        tasks.start(self._door.run(), "late connections")
        serving = asyncio.create_task(server.serve(listening), name="http server")
        stack.push_async_callback(_end, server, serving)
        started = asyncio.create_task(server.ready.wait())
        await asyncio.wait((serving, started), return_when=asyncio.FIRST_COMPLETED)
        started.cancel()
        if serving.done():
            await serving

    async def _watched(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Tell the door when a request began, when its body is whole, and when it was answered."""
        guest = self._guests.get(tuple(scope["client"])) if scope["type"] == "http" and scope.get("client") else None
        if guest is None:
            await self._app(scope, receive, send)
            return
        is_whole = False

        async def heard() -> Message:
            nonlocal is_whole
            message = await receive()
            is_whole = is_whole or not message.get("more_body", False)
            return message

        number = guest.began(lambda: is_whole)
        try:
            await self._app(scope, heard, send)
        finally:
            guest.ended(number)


class _Server(uvicorn.Server):
    """Leaves the signals to the program, and says when it listens."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.ready = asyncio.Event()

    def capture_signals(self) -> AbstractContextManager[None]:  # type: ignore[override]
        return nullcontext()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self.ready.set()


async def _end(server: _Server, serving: asyncio.Task[None]) -> None:
    server.should_exit = True
    await asyncio.wait((serving,))


class _GuestProtocol(H11Protocol):
    """Tells the door who is connected, and how many bytes came."""

    door: ClassVar[Door]
    guests: ClassVar[dict[tuple[str, int], Guest]]
    _guest: Guest | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        address = self.client or ("", 0)
        self._guest = self.door.enter(address[0], transport.abort)
        if self._guest is None:
            transport.abort()
        else:
            self.guests[address] = self._guest

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        if self._guest is not None:
            self.guests.pop(self.client or ("", 0), None)
            self.door.leave(self._guest)

    def data_received(self, data: bytes) -> None:
        if self._guest is not None:
            self._guest.received(len(data))
        super().data_received(data)


_LOG: Final = logging.getLogger("uvicorn.error")
_LOG.setLevel(logging.ERROR)
"""What strangers send that is no request is no warning for the operator."""
