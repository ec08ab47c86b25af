"""Connections that ask nothing: they end, and requests are answered among them."""

from __future__ import annotations

import asyncio
import gc
import logging
import socket
import ssl
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from aiohttp import ClientSession, web

from mesh.base.door import Door, DoorLimits, network_of
from mesh.base.http_server import HttpServer
from mesh.errors import PortUnavailable
from tests.support.clocks import SECOND, SetClock
from tests.support.sites import Site
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.base.door import Guest

HOST = "127.0.0.1"
HALF = b"GET / HTTP/1.1\r\nHost: localhost\r\nX-A: "
BODY = b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 60000\r\n\r\n"


class Callers:
    """Who calls at a door, and whose connection was closed."""

    def __init__(self, limits: DoorLimits) -> None:
        self.clock = SetClock()
        self.door = Door(limits, clock=self.clock)
        self.closed: list[str] = []
        self.guests: dict[str, Guest] = {}

    def call(self, name: str, address: str = "192.0.2.1") -> bool:
        self.clock.pass_by(SECOND // 1000)

        def close() -> None:
            self.closed.append(name)
            self.door.leave(self.guests[name])

        guest = self.door.enter(address, close)
        if guest is not None:
            self.guests[name] = guest
        return guest is not None

    def wait(self, seconds: float) -> list[str]:
        """Those who were late by then."""
        self.clock.pass_by(round(seconds * SECOND))
        self.closed.clear()
        self.door.end_late()
        return self.closed


def test_of_one_address_the_longest_waiting_makes_room_and_never_one_that_is_answered() -> None:
    callers = Callers(DoorLimits(per_address=3))
    assert [callers.call(name) for name in "abc"] == [True] * 3
    callers.guests["a"].began()
    assert callers.call("other", "192.0.2.2")
    assert callers.call("d")
    assert callers.closed == ["b"]
    for name in "cd":
        callers.guests[name].began()
    assert not callers.call("e")
    assert callers.closed == ["b"]
    callers.door.leave(callers.guests["a"])
    assert callers.call("f")


def test_of_all_the_address_with_most_connections_makes_room() -> None:
    callers = Callers(DoorLimits(connections=4, per_address=4))
    assert callers.call("first", "192.0.2.9")
    assert [callers.call(name) for name in "abc"] == [True] * 3
    assert callers.call("new", "192.0.2.8")
    assert callers.closed == ["a"]
    for name in "bc":
        callers.guests[name].began()
    assert callers.call("newer", "192.0.2.7")
    assert callers.closed == ["a", "first"]


def test_unfinished_bodies_make_room_last() -> None:
    callers = Callers(DoorLimits(per_address=2))
    callers.call("upload")
    callers.guests["upload"].began(lambda: False)
    callers.call("silent")
    callers.call("a")
    assert callers.closed == ["silent"]
    callers.guests["a"].began()
    callers.call("b")
    assert callers.closed == ["silent", "upload"]


def test_many_clients_come_from_a_proxy() -> None:
    callers = Callers(DoorLimits(per_address=1, proxies=("192.0.2.1",)))
    assert all(callers.call(name) for name in "abc")
    assert not callers.closed


def test_heads_bodies_and_pauses_have_their_time() -> None:
    callers = Callers(DoorLimits(head=10, idle=75, grace=10, pace=1000))
    callers.call("silent")
    callers.call("slow head")
    callers.call("asks")
    callers.guests["slow head"].received(5)
    number = callers.guests["asks"].began()
    assert callers.wait(9) == []
    callers.guests["slow head"].received(5)
    assert callers.wait(2) == ["silent", "slow head"]
    assert callers.wait(1000) == []  # it is the server that takes its time
    callers.guests["asks"].ended(number)
    assert callers.wait(74) == []
    callers.guests["asks"].received(1)  # of the next head
    assert callers.wait(9) == []
    assert callers.wait(2) == ["asks"]


def test_a_body_keeps_a_pace() -> None:
    callers = Callers(DoorLimits(grace=10, pace=1000))
    whole = False
    for name in ("slow", "fair"):
        callers.call(name)
        callers.guests[name].began(lambda: whole)
    assert callers.wait(9.9) == []
    callers.guests["slow"].received(4_000)
    callers.guests["fair"].received(6_000)
    assert callers.wait(5) == ["slow"]
    whole = True
    assert callers.wait(1000) == []


def test_the_end_of_a_request_is_not_that_of_the_next() -> None:
    callers = Callers(DoorLimits(idle=1))
    callers.call("pipelined")
    first = callers.guests["pipelined"].began()
    callers.guests["pipelined"].began()
    callers.guests["pipelined"].ended(first)
    assert callers.wait(100) == []


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("192.0.2.7", "192.0.2.7"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("::ffff:192.0.2.7", "192.0.2.7"),
        ("nonsense", "nonsense"),
    ],
)
def test_a_client_has_one_address_of_ipv4_or_a_network_of_ipv6(address: str, network: str) -> None:
    assert network_of(address) == network


@asynccontextmanager
async def served(limits: DoorLimits, tls: ssl.SSLContext | None = None) -> AsyncIterator[HttpServer]:
    """A server that answers with the length of the body, and echoes what comes over a WebSocket."""

    async def length(request: web.Request) -> web.Response:
        return web.Response(text=str(len(await request.read())))

    async def echo(request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        async for message in socket:
            await socket.send_str(message.data)
        return socket

    app = web.Application()
    app.add_routes([web.route("*", "/", length), web.get("/socket", echo)])
    async with HttpServer(app, HOST, 0, tls=tls, limits=limits) as server, asyncio.timeout(30):
        yield server


@asynccontextmanager
async def connected(
    server: HttpServer, *said: bytes, tls: ssl.SSLContext | None = None
) -> AsyncIterator[asyncio.StreamReader]:
    """A connection over which something was said."""
    reader, writer = await asyncio.open_connection(HOST, server.port, ssl=tls)
    for part in said:
        writer.write(part)
    try:
        yield reader
    finally:
        writer.transport.abort()


async def asked(server: HttpServer, *, tls: ssl.SSLContext | None = None) -> str:
    """The answer to a fair request."""
    url = f"{'http' if tls is None else 'https'}://{HOST}:{server.port}/"
    async with ClientSession() as session, session.post(url, data=b"abc", ssl=tls or True) as answer:
        return await answer.text()


@pytest.mark.parametrize(
    "said", [b"", b"G", HALF, BODY, BODY + b"x" * 900], ids=["nothing", "byte", "head", "body", "part"]
)
async def test_a_request_that_never_ends_is_closed(said: bytes) -> None:
    limits = DoorLimits(head=0.2, grace=0.2, pace=1000)
    async with served(limits) as server, connected(server, said) as reader:
        assert await reader.read() == b""
        assert await asked(server) == "3"


async def test_a_head_that_trickles_is_closed() -> None:
    async with served(DoorLimits(head=0.5)) as server:
        reader, writer = await asyncio.open_connection(HOST, server.port)
        writer.write(HALF)
        ended = asyncio.ensure_future(reader.read())
        while not ended.done():
            writer.write(b"a")
            await asyncio.wait([ended], timeout=0.05)
        writer.transport.abort()


async def test_in_a_flood_of_half_requests_whoever_asks_is_answered() -> None:
    limits = DoorLimits(connections=40, per_address=20)
    async with served(limits) as server:
        half = [await asyncio.open_connection(HOST, server.port) for _ in range(100)]
        for _, writer in half:
            writer.write(HALF)
        for _ in range(5):
            assert await asked(server) == "3"
        assert server.guests <= limits.per_address
        for _, writer in half:
            writer.transport.abort()


async def test_half_handshakes_of_tls_are_bounded_too(tmp_path: Path) -> None:
    folder = Site(tmp_path / "members").certify("page", "0x" + "11" * 20, "person", hosts=(HOST,))
    own = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    own.load_cert_chain(folder.certificate, folder.key)
    theirs = ssl.create_default_context(cafile=str(folder.ca))
    async with served(DoorLimits(per_address=10, head=2.0), tls=own) as server:
        silent = [await asyncio.open_connection(HOST, server.port) for _ in range(30)]
        async with connected(server, HALF, tls=theirs) as half:
            assert await asked(server, tls=theirs) == "3"
            assert server.guests <= 10
            assert await half.read() == b""  # it was late, after its handshake
        for reader, writer in silent:
            with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
                await reader.readexactly(1)
            writer.transport.abort()
        await until(lambda: not server.guests)


async def test_websockets_stay_and_connections_serve_several_requests() -> None:
    async with served(DoorLimits(head=0.2, idle=0.3, grace=0.2)) as server, ClientSession() as session:
        url = f"http://{HOST}:{server.port}"
        async with session.ws_connect(f"{url}/socket") as socket:
            for _ in range(3):
                await asyncio.sleep(0.7)  # longer than any limit
                await socket.send_str("hello")
                assert (await socket.receive_str()) == "hello"
        reader, writer = await asyncio.open_connection(HOST, server.port)
        for _ in range(3):
            writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 200")
            assert await reader.readexactly(1) == b"0"
        assert await reader.read() == b""  # after a pause
        writer.close()


async def test_leaving_ends_all_connections_and_frees_the_port() -> None:
    async with served(DoorLimits()) as server:
        port = server.port
        with pytest.raises(PortUnavailable, match="can't listen on"):
            await HttpServer(web.Application(), HOST, port).__aenter__()
        silent, writer = await asyncio.open_connection(HOST, port)
        await until(lambda: server.guests)
    assert await silent.read() == b""
    writer.close()
    async with HttpServer(web.Application(), HOST, port) as again:
        assert again.port == port


async def test_leaving_closes_connections_that_are_only_just_made() -> None:
    """Whatever is left open raises a `ResourceWarning`, which is an error in tests."""
    for turns in range(40):
        async with AsyncExitStack() as stack, HttpServer(web.Application(), HOST, 0) as server:
            for _ in range(5):
                client = stack.enter_context(socket.socket())
                client.setblocking(False)
                client.connect_ex((HOST, server.port))
            for _ in range(turns % 8):
                await asyncio.sleep(0)
        gc.collect()


async def test_requests_that_are_none_leave_no_traceback_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    async with served(DoorLimits()) as server:
        for said in (b"\x16\x03\x01\x00\n", b"GET /" + b"x" * 9000 + b" HTTP/1.1\r\n\r\n", b"GET / HTTP/9\r\n\r\n"):
            async with connected(server, said) as reader:
                assert (await reader.read()).startswith(b"HTTP/1.")
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
