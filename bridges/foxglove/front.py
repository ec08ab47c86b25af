"""What clients connect to. The SDK's server checks nobody: it listens behind this, on an address of this machine.

The front checks each request (site, token), bounds the clients and what each of them sends, ends those that don't read,
and offers TLS. Everything else it carries unchanged.
"""

from __future__ import annotations

import asyncio
import logging
import os
import ssl
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bridges.foxglove.errors import ClientRefused
from bridges.foxglove.handshake import LONGEST_FRAME, FrameGuard, Upgrade
from bridges.web.options import is_loopback
from mesh.background import Background
from mesh.devchain.errors import PortUnavailable
from mesh.flood import Rate, RateLimiter
from mesh.log_context import log_event
from mesh.role import Lifecycle

if TYPE_CHECKING:
    from contextlib import AsyncExitStack

    from bridges.foxglove.options import FoxgloveOptions
    from mesh.flood import Drops

log = logging.getLogger(__name__)

CLIENTS: Final = 16
"""Clients at a time."""
PENDING: Final = 256
"""Connections at a time, with those whose request is not read yet."""
CONNECTIONS: Final = Rate(per_second=1.0, burst=20)
"""Connections of one address."""
LONGEST_HEAD: Final = 16_384
"""Bytes of a request."""
REQUEST_TIMEOUT: Final = 5.0
SENT: Final = Rate(per_second=1 << 16, burst=4 * LONGEST_FRAME)
"""Bytes that one client sends; beyond, the front waits before it reads more."""
PART: Final = 1 << 16
TOO_BIG: Final = b"\x88\x02\x03\xf1"
"""The frame that ends a WebSocket with the status 1009, a message too big."""


class FoxgloveFront(Lifecycle):
    """`async with FoxgloveFront(options, drops) as front`, then `front.url`; `front.inner` is where the SDK's server
    listens, as host and port, or None while there is none."""

    title = "front of the Foxglove server"
    stalled: float = 5.0
    """Seconds in which a client must take `PART` bytes, or it is disconnected."""

    def __init__(self, options: FoxgloveOptions, drops: Drops) -> None:
        options.check()
        self._options = options
        self.drops: Final = drops
        self._limiter = RateLimiter(per_sender=CONNECTIONS)
        self._clients: set[asyncio.Task[None]] = set()
        self._admitted = 0
        self._opening = asyncio.Lock()
        self.inner: tuple[str, int] | None = None
        self.url = ""

    async def _open(self, stack: AsyncExitStack) -> None:
        options = self._options
        tls = await asyncio.to_thread(_tls, options)
        timeout = None if tls is None else REQUEST_TIMEOUT
        try:
            server = await asyncio.start_server(
                self._accept, options.host, options.port, ssl=tls, ssl_handshake_timeout=timeout, limit=LONGEST_HEAD
            )
        except OSError as error:
            why = os.strerror(error.errno) if error.errno else str(error)
            raise PortUnavailable(options.host, options.port, why, option="--listen HOST:PORT") from None
        stack.push_async_callback(self._end, server)
        host = f"[{options.host}]" if ":" in options.host else options.host
        self.url = f"{'ws' if tls is None else 'wss'}://{host}:{server.sockets[0].getsockname()[1]}"

    async def _end(self, server: asyncio.Server) -> None:
        server.close()
        await self.disconnect()

    async def disconnect(self) -> None:
        """End all connections."""
        for client in self._clients:
            client.cancel()
        if self._clients:
            await asyncio.wait(self._clients)

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = asyncio.get_running_loop().create_task(self._serve(reader, writer), name="foxglove client")
        self._clients.add(client)
        client.add_done_callback(self._clients.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        address = str((writer.get_extra_info("peername") or ("",))[0])
        try:
            await self._carry(reader, writer, address)
        except ClientRefused as refused:
            self.drops.count("foxglove-refused", address)
            fields = log_event("foxglove-refused", address=address, why=str(refused))
            log.debug("refused a client at %s: %s", address, refused, extra=fields)
            with suppress(OSError):
                writer.write(TOO_BIG if refused.status == "1009" else refused.response())
        except (OSError, EOFError, TimeoutError, asyncio.LimitOverrunError) as error:
            log.debug("a client at %s is gone: %s", address, error)
        finally:
            await _close(writer)

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, address: str) -> None:
        """Serve one client until it or the SDK's server ends."""
        if not is_loopback(address) and not self._limiter.allow(address):
            raise ClientRefused("429 Too Many Requests", "too many connections; wait a moment")
        if len(self._clients) > PENDING:
            raise ClientRefused("503 Service Unavailable", "there are too many connections")
        async with asyncio.timeout(REQUEST_TIMEOUT):
            request = Upgrade.parse(await reader.readuntil(b"\r\n\r\n"))
            request.check(self._options)
            if self.inner is None:
                raise ClientRefused("503 Service Unavailable", "nothing is shown yet")
            if self._admitted >= CLIENTS:
                raise ClientRefused("503 Service Unavailable", f"there are {CLIENTS} clients already")
            inner = self.inner
            server_reader, server_writer = await asyncio.open_connection(*inner)
        self._admitted += 1
        try:
            # The SDK numbers clients and their sinks apart; the numbers are equal if clients come one after another.
            async with self._opening, asyncio.timeout(REQUEST_TIMEOUT):
                server_writer.write(request.carried("{}:{}".format(*inner)))
                greeting = await server_reader.readuntil(b"\r\n\r\n") + await server_reader.read(PART)
            writer.write(greeting)
            async with Background() as tasks:
                tasks.start(_send(reader, server_writer), "foxglove client sends")
                await _receive(server_reader, writer, self.stalled)
        finally:
            self._admitted -= 1
            await _close(server_writer)


async def _send(reader: asyncio.StreamReader, server: asyncio.StreamWriter) -> None:
    """Carry what a client sends, at a bounded rate. Raises `ClientRefused`, and `EOFError` at the end."""
    guard, limiter = FrameGuard(), RateLimiter(per_sender=SENT)
    while data := await reader.read(PART):
        guard.feed(data)
        while not limiter.allow("", len(data)):  # noqa: ASYNC110 - nothing else happens then
            await asyncio.sleep(0.1)
        server.write(data)
        await server.drain()
    raise EOFError("the client closed the connection")


async def _receive(server: asyncio.StreamReader, writer: asyncio.StreamWriter, stalled: float) -> None:
    """Carry what the SDK's server sends, until it ends. Raises `TimeoutError` for a client that does not read."""
    while data := await server.read(PART):
        writer.write(data)
        async with asyncio.timeout(stalled):
            await writer.drain()


async def _close(writer: asyncio.StreamWriter) -> None:
    """Close a connection; what a client does not take within a second is lost."""
    writer.close()
    try:
        async with asyncio.timeout(1.0):
            await writer.wait_closed()
    except (OSError, TimeoutError):
        writer.transport.abort()


def _tls(options: FoxgloveOptions) -> ssl.SSLContext | None:
    if not options.certificate:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(Path(options.certificate).expanduser(), Path(options.key).expanduser())
    return context
