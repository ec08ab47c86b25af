"""Two sessions of one identity, of which one is far away from the router."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING

import zenoh

from mesh.errors import RemoteError
from mesh.ops.doctor._session import SessionPair
from tests.support.raising import raises_with
from tests.support.routers import client_config

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.support.routers import EmbeddedRouter

FAR = 0.15
"""Seconds by which each byte to the reader is delayed: three times as long as a put waits for the next."""


@asynccontextmanager
async def far_from(endpoint: str) -> AsyncIterator[str]:
    """An endpoint that leads to the router by a long way."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    loop = asyncio.get_running_loop()

    relays: list[asyncio.Task[None] | None] = []

    async def carry(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while data := await source.read(65_536):
                loop.call_later(FAR, sink.write, data)
            await asyncio.sleep(FAR)
        sink.close()
        with suppress(ConnectionError):
            await sink.wait_closed()

    async def relay(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        relays.append(asyncio.current_task())
        there, back = await asyncio.open_connection(host, int(port))
        await asyncio.gather(carry(source, back), carry(there, sink))

    async with await asyncio.start_server(relay, "127.0.0.1", 0) as server:
        yield f"tcp/127.0.0.1:{server.sockets[0].getsockname()[1]}"
        await asyncio.gather(*filter(None, relays))


@asynccontextmanager
async def pair(near: str, far: str) -> AsyncIterator[SessionPair]:
    """A writer beside the router, and a reader far from it."""
    writer = await asyncio.to_thread(zenoh.open, client_config(near))
    reader = await asyncio.to_thread(zenoh.open, client_config(far))
    try:
        yield SessionPair(writer, reader)
    finally:
        for session in (reader, writer):
            await asyncio.to_thread(session.close)


async def test_earlier_writes_do_not_count_for_the_round_trip(router: EmbeddedRouter) -> None:
    async with far_from(router.endpoint) as far, pair(router.endpoint, far) as both:
        took = await both.round_trip("aira/test/doctor/far")

    assert took is not None
    assert took >= FAR


async def test_denied_writes_are_not_checked_if_allowed_ones_do_not_arrive(
    router: EmbeddedRouter,
) -> None:
    async with pair(router.endpoint, router.endpoint) as both:
        with raises_with(RemoteError, code="writes-undelivered"):
            await both.delivered(("aira/test/foreign",), own="aira/test/own", barrier="aira/test/unheard")
