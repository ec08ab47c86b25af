"""The page's stream: resumed after a break, and bounded for slow tabs."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

from bridges.web._stream import EVENT_LIMITS, Stream, StreamConnection
from schemas import Demand, encode, verify
from tests.support.market import MODEL
from tests.support.waiting import until

if TYPE_CHECKING:
    from tests.support.market import Place


async def received(socket: Any, *kinds: str) -> list[dict[str, Any]]:
    """The events until one of each kind has come."""
    events: list[dict[str, Any]] = []
    async with asyncio.timeout(60):
        while not set(kinds) <= {event["kind"] for event in events}:
            events += json.loads((await socket.receive()).data)
    return events


async def test_an_order_on_the_mesh_reaches_the_page(place: Place, serve: Any) -> None:
    async with serve() as browser, browser.session.ws_connect(f"{browser.server.url}/api/v1/stream") as socket:
        await socket.send_json({"subscribe": ["market"]})
        await received(socket, "hello")
        terms: dict[str, Any] = {
            "model": MODEL,
            "objective": MODEL,
            "cost": 2**70,
            "validator_fee": 0,
            "nonce": "ab" * 32,
        }
        addresses: dict[str, Any] = {"token": place.address("robot"), "validator": "0x" + "00" * 20}
        market = await browser.get("market")
        lighthouse = market["lighthouse"]["address"]
        demand = Demand(**terms, **addresses, lighthouse=lighthouse, deadline=market["block"] + 100)
        signed = place.market.accounts["person"].signer.sign(demand)
        browser.server.components.channel.publish(signed)
        order = next(event for event in await received(socket, "order") if event["kind"] == "order")
        assert order["topic"] == "market"
        assert order["data"]["cost"] == str(2**70)
        assert order["data"]["hash"] == verify(encode(signed)).hash.hex()
        assert (await browser.get("orders", kind="demand"))["orders"][0]["hash"] == order["data"]["hash"]


async def test_a_broken_connection_goes_on_where_it_was(serve: Any) -> None:
    async with serve() as browser:
        stream, url = browser.server.api.stream, f"{browser.server.url}/api/v1/stream"
        async with browser.session.ws_connect(url) as socket:
            await socket.send_json({"subscribe": ["a"]})
            await received(socket, "hello")
            stream.publish("a", "first", 1)
            seen = (await received(socket, "first"))[-1]["seq"]
        stream.publish("a", "missed", 2)
        stream.publish("b", "other", 3)
        async with browser.session.ws_connect(url) as socket:
            await socket.send_json({"subscribe": ["a"], "after": seen, "stream": stream.id})
            events = await received(socket, "missed")
            assert [event["kind"] for event in events] == ["hello", "missed"]
        async with browser.session.ws_connect(url) as socket:
            await socket.send_json({"subscribe": ["a"], "after": seen, "stream": "of an earlier server"})
            assert [event["kind"] for event in await received(socket, "gap")] == ["hello", "gap"]


def test_a_position_that_is_no_longer_kept_is_a_gap() -> None:
    stream = Stream()
    for _ in range(EVENT_LIMITS.kept + 10):
        stream.publish("a", "tick", None)
    assert stream.since(5) is None
    assert stream.since(stream.seq + 1) is None
    kept = stream.since(10)
    assert kept is not None
    assert next(kept).seq == 11


async def test_a_slow_tab_loses_old_ticks_of_the_market_and_nothing_else() -> None:
    sent: list[dict[str, Any]] = []

    class Slow:
        async def send_str(self, text: str) -> None:
            sent.extend(json.loads(text))

    socket: Any = Slow()
    stream = Stream()
    connection = StreamConnection(stream, socket)
    assert connection.subscribe('{"subscribe": ["market", "liability/0x00"]}')
    stream._connections.add(connection)
    stream.publish("liability/0x00", "paid", {})
    for number in range(EVENT_LIMITS.waiting + 50):
        stream.publish("market", "order", number)
    sending = asyncio.create_task(connection.send())
    await until(lambda: any(event.get("data") == EVENT_LIMITS.waiting + 49 for event in sent))
    sending.cancel()
    assert next(event for event in sent if event["kind"] == "lost")["data"] == {"count": 51}
    assert [event["kind"] for event in sent].count("paid") == 1
    orders = [event["data"] for event in sent if event["kind"] == "order"]
    assert orders == list(range(51, EVENT_LIMITS.waiting + 50))


async def test_what_is_no_subscription_ends_the_connection(serve: Any) -> None:
    async with serve() as browser, browser.session.ws_connect(f"{browser.server.url}/api/v1/stream") as socket:
        await socket.send_str("[1]")
        async with asyncio.timeout(60):
            assert (await socket.receive()).type.name in ("CLOSE", "CLOSED")


async def test_a_connection_that_is_made_while_the_server_stops_is_ended(serve: Any) -> None:
    async with serve() as browser:
        await browser.server.api.stream.close()
        async with browser.session.ws_connect(f"{browser.server.url}/api/v1/stream") as socket, asyncio.timeout(60):
            assert (await socket.receive()).type.name == "CLOSE"
            assert socket.close_code == 1001
