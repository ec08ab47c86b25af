"""HTTP servers of aiohttp, behind a `Door`."""

from __future__ import annotations

import asyncio
import logging
import socket
from typing import TYPE_CHECKING, Any, Final, cast

from aiohttp import web
from aiohttp.http import HttpProcessingError

from mesh.base.background import Background
from mesh.base.door import Door, DoorLimits, Guest
from mesh.base.lifecycle import Lifecycle
from mesh.errors import PortUnavailable

if TYPE_CHECKING:
    import ssl
    from collections.abc import Awaitable, Callable
    from contextlib import AsyncExitStack

    Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

log = logging.getLogger(__name__)

BACKLOG: Final = 256
"""Connections that wait to be accepted."""


async def listening_sockets(host: str, port: int, *, option: str) -> list[socket.socket]:
    """Sockets that listen on each address of a host, all on one port; 0 selects a free one.

    Raises `PortUnavailable`, whose hint names the `option` for the port.
    """
    listening: list[socket.socket] = []
    try:
        places = await asyncio.get_running_loop().getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        for family, kind, number, _, address in dict.fromkeys(places):
            one = socket.socket(family, kind, number)
            listening.append(one)
            one.setblocking(False)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                one.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            one.bind((address[0], port, *address[2:]))
            one.listen(BACKLOG)
            port = one.getsockname()[1]
    except (OSError, OverflowError, UnicodeError) as error:
        for one in listening:
            one.close()
        why = getattr(error, "strerror", None) or str(error)
        raise PortUnavailable(host, port, why, option=option) from None
    return listening


class HttpServer(Lifecycle):
    """Serves an application: `async with HttpServer(app, host, port) as server`, then `server.port`.

    A connection counts from its first packet, so that the handshakes of TLS are bounded, too. Leaving finishes the
    requests in progress, and ends all connections. Entering raises `PortUnavailable`, whose hint names the `option` for
    the port.

    It listens on `bound` instead of a port if that is given: a socket with an address, such as a path, which it closes.
    A client without a place, because all others ask something, is sent `refusal`, which goes without TLS only.
    """

    title = "HTTP server"

    def __init__(
        self,
        app: web.Application,
        host: str,
        port: int = 0,
        *,
        bound: socket.socket | None = None,
        refusal: bytes = b"",
        tls: ssl.SSLContext | None = None,
        limits: DoorLimits = DoorLimits(),  # noqa: B008
        option: str = "--port",
    ) -> None:
        app.middlewares.insert(0, self._watched)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=2.0, logger=_LOG, auto_decompress=False)
        self._host = host
        self._tls = tls
        self._option = option
        self._bound = bound
        self._refusal = refusal
        self._refused = 0
        self._door = Door(limits)
        self._tasks: set[asyncio.Task[None]] = set()
        self._guests: dict[asyncio.BaseTransport | None, Guest] = {}
        self.port = port
        """Where it listens."""

    @property
    def guests(self) -> int:
        """How many connections are open, those under TLS's handshake included."""
        return len(self._door)

    async def _open(self, stack: AsyncExitStack) -> None:
        stack.callback(self._door.end_all)
        tasks = await stack.enter_async_context(Background())
        tasks.start(self._door.run(), "late connections")
        await self._runner.setup()
        stack.push_async_callback(self._runner.cleanup)
        if self._bound is None:
            listening = await listening_sockets(self._host, self.port, option=self._option)
            self.port = listening[0].getsockname()[1]
        else:
            self._bound.listen(BACKLOG)
            self._bound.setblocking(False)
            listening = [self._bound]
        stack.push_async_callback(self._stop, listening)
        for one in listening:
            self._watch(one)

    def _watch(self, listening: socket.socket) -> None:
        if listening.fileno() >= 0:
            asyncio.get_running_loop().add_reader(listening, self._accept, listening)

    async def _stop(self, listening: list[socket.socket]) -> None:
        """Accept no more connections; those that are made stay."""
        for one in listening:
            asyncio.get_running_loop().remove_reader(one)
            one.close()
        while self._tasks:
            for task in self._tasks:
                task.cancel()
            await asyncio.wait(self._tasks)

    def _accept(self, listening: socket.socket) -> None:
        """Accept a connection: at once, because an `await` that is cancelled would lose it."""
        try:
            connection, address = listening.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return
        except OSError as error:  # such as too many open files
            log.debug("can't accept a connection: %s", error)
            loop = asyncio.get_running_loop()
            loop.remove_reader(listening)
            loop.call_later(0.2, self._watch, listening)  # when there may be a descriptor left
            return
        connection.setblocking(False)
        # A path has no address of the client.
        making = self._make(connection, str(address[0]) if address else "")
        task = asyncio.get_running_loop().create_task(making, name="connection")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        task.add_done_callback(lambda done: connection.close() if done.cancelled() else None)  # before it began

    async def _make(self, connection: socket.socket, address: str) -> None:
        """Make the connection: with TLS that takes a handshake."""
        task, server = asyncio.current_task(), self._runner.server
        assert task is not None
        assert server is not None
        guest = self._door.enter(address, task.cancel)
        if guest is None:
            await self._refuse(connection)
            return
        timeout = None if self._tls is None else self._door.limits.head
        try:
            if hasattr(socket, "TCP_USER_TIMEOUT") and connection.family != socket.AF_UNIX:
                # Milliseconds in which the client must take something of what it is sent, or its connection ends.
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 30_000)
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: _Watched(server(), guest, self), connection, ssl=self._tls, ssl_handshake_timeout=timeout
            )
        except (OSError, asyncio.CancelledError) as error:  # errors of TLS are `OSError`, too
            self._door.leave(guest)
            connection.close()
            log.debug("a client at %s did not connect: %s", address, error)

    async def _refuse(self, connection: socket.socket) -> None:
        """Close a connection for which there is no place, and say so where a few do not know it yet."""
        loop = asyncio.get_running_loop()
        self._refused += 1
        try:
            if self._refusal and self._refused <= 16:
                async with asyncio.timeout(1):  # who is answered before it asks may not hear it
                    await loop.sock_recv(connection, 1 << 16)
                    await loop.sock_sendall(connection, self._refusal)
                    connection.shutdown(socket.SHUT_WR)
                    while await loop.sock_recv(connection, 1 << 16):
                        pass
        except (OSError, TimeoutError) as error:
            log.debug("a client that was refused did not hear it: %s", error)
        finally:
            self._refused -= 1
            connection.close()

    def made(self, transport: asyncio.BaseTransport, guest: Guest) -> None:
        """A connection is made: it is closed by its transport from now on."""
        guest.close = cast("asyncio.Transport", transport).abort
        self._guests[transport] = guest

    def lost(self, transport: asyncio.BaseTransport, guest: Guest) -> None:
        """A connection has ended."""
        self._guests.pop(transport, None)
        self._door.leave(guest)

    @web.middleware
    async def _watched(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Tell the door of a request: it ends with its task, which also sends the answer."""
        guest, task = self._guests.get(request.transport), asyncio.current_task()
        if guest is not None and task is not None:
            number = guest.began(request.content.is_eof)
            task.add_done_callback(lambda _: guest.ended(number))
        return await handler(request)


class _Watched(asyncio.Protocol):
    """Tells the door what happens on a connection, and carries it to the protocol behind."""

    def __init__(self, inner: asyncio.BaseProtocol, guest: Guest, server: HttpServer) -> None:
        self._inner: Any = inner
        self._guest = guest
        self._server = server

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport
        self._server.made(transport, self._guest)
        self._inner.connection_made(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self._server.lost(self._transport, self._guest)
        self._inner.connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        self._guest.received(len(data))
        self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        return cast("bool | None", self._inner.eof_received())

    def pause_writing(self) -> None:
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        self._inner.resume_writing()


def _concerns_the_operator(record: logging.LogRecord) -> bool:
    """Whether a log record is about more than a request that is none, of which strangers can send any number."""
    return record.exc_info is None or not isinstance(record.exc_info[1], HttpProcessingError | ConnectionError)


_LOG: Final = logging.getLogger("aiohttp.server.mesh")
_LOG.addFilter(_concerns_the_operator)
