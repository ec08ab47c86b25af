"""Who may connect, and what a slow or hostile client can't do."""

from __future__ import annotations

import asyncio
import json
import random
import ssl
from typing import TYPE_CHECKING, Any

import pytest
import websockets

from bridges.foxglove.server import VIEWER_LIMITS, FoxgloveOptions
from mesh.errors import ConfigurationError
from schemas.payloads import RAW, encode_value
from tests.support.foxglove.viewer import viewing
from tests.support.sites import Site
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

TOKEN = "a token of the tests"
VIEW = "0x" + "05" * 20


async def refusal(url: str, **options: Any) -> int:
    """The status with which a client is refused."""
    with pytest.raises(websockets.InvalidStatus) as caught:
        async with viewing(url, **options):
            pass
    return caught.value.response.status_code


async def test_a_page_of_another_site_may_not_connect(serve: Any) -> None:
    async with serve(origins=("https://viewer.example",)) as server:
        url = server.front.url
        assert await refusal(url, origin="https://evil.example") == 403
        assert await refusal(url, origin="null") == 403
        for origin in (None, "https://app.foxglove.dev", "https://viewer.example"):
            async with viewing(url, origin=origin) as viewer:
                assert viewer.info["name"] == "test"
        assert server.front.drops.totals() == {"foxglove-refused": 2}


async def test_the_token_opens_the_view(serve: Any) -> None:
    async with serve(token=TOKEN) as server:
        url = server.front.url
        assert await refusal(url) == 401
        assert await refusal(f"{url}?token=another+token+of+a+test") == 401
        async with viewing(f"{url}?token={TOKEN.replace(' ', '+')}") as viewer:
            assert viewer.info["name"] == "test"
        async with viewing(url, additional_headers={"Authorization": f"Bearer {TOKEN}"}) as viewer:
            assert viewer.info["name"] == "test"


async def test_the_newer_subprotocol_is_served(serve: Any) -> None:
    async with serve() as server, viewing(server.front.url, subprotocol="foxglove.sdk.v1.1") as viewer:
        assert viewer.socket.subprotocol == "foxglove.sdk.v1.1"


async def test_a_view_by_tls(serve: Any, tmp_path: Path) -> None:
    site = Site(tmp_path / "members")
    folder = site.certify("view", VIEW, "watcher", hosts=("127.0.0.1",))
    given = {"certificate": str(folder.certificate), "key": str(folder.key), "token": TOKEN}
    async with serve(**given, host="0.0.0.0") as server:
        context = ssl.create_default_context(cafile=str(site.authority.certificate))
        context.verify_flags |= ssl.VERIFY_X509_STRICT  # as Python does from 3.13 on
        url = server.front.url.replace("0.0.0.0", "127.0.0.1")
        assert url.startswith("wss://")
        async with viewing(f"{url}?token={TOKEN.replace(' ', '+')}", ssl=context) as viewer:
            server.publish("/x", *encode_value("on"))
            assert (await viewer.until_seen("/x"))[0].data == "on"


@pytest.mark.parametrize(
    "protection", [{}, {"token": TOKEN}, {"certificate": "a", "key": "b"}, {"certificate": "a", "token": TOKEN}]
)
def test_other_machines_need_tls_and_a_token(protection: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError):
        FoxgloveOptions(host="0.0.0.0", **protection).check()
    FoxgloveOptions(host="0.0.0.0", certificate="a", key="b", token=TOKEN).check()
    FoxgloveOptions(host="::1").check()


async def test_a_browser_is_told_what_this_is(serve: Any) -> None:
    async with serve() as server:
        host, port = server.front.url.removeprefix("ws://").split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        answer = await reader.read()
        assert answer.startswith(b"HTTP/1.1 426 ")
        assert b"Foxglove" in answer
        writer.close()


async def test_clients_are_bounded(serve: Any) -> None:
    async with serve() as server:
        opened = [viewing(server.front.url) for _ in range(VIEWER_LIMITS.clients)]
        viewers = [await one.__aenter__() for one in opened]
        assert len(viewers) == VIEWER_LIMITS.clients
        assert await refusal(server.front.url) == 503
        for one in opened:
            await one.__aexit__(None, None, None)
        await until(lambda: not server.front.clients)
        async with viewing(server.front.url) as viewer:
            assert viewer.info


async def test_a_message_that_is_too_long_ends_the_connection(serve: Any) -> None:
    async with serve() as server, viewing(server.front.url) as viewer:
        await viewer.socket.send("x" * (VIEWER_LIMITS.message + 1))
        await until(lambda: viewer.socket.close_code == 1009)


async def test_a_client_that_sends_nonsense_hurts_no_other(serve: Any) -> None:
    async with serve() as server, viewing(server.front.url) as viewer, viewing(server.front.url) as hostile:
        many = [{"id": number, "channelId": 10**6 + number} for number in range(2000)]
        for nonsense in ("no JSON", b"\xff\x00", json.dumps({"op": "subscribe", "subscriptions": many}), b""):
            await hostile.socket.send(nonsense)
        advertised = [{"id": 1, "topic": "/cmd_vel", "encoding": "json", "schemaName": ""}]
        await hostile.socket.send(json.dumps({"op": "advertise", "channels": advertised}))
        server.publish("/x", *encode_value("on"))
        assert (await viewer.until_seen("/x"))[0].data == "on"
        await until(lambda: hostile.statuses or hostile.socket.close_code, what="an answer to nonsense")
        assert set(viewer.topics) == {"/x"}


async def test_a_client_that_does_not_read_is_disconnected(serve: Any) -> None:
    async with serve() as server, viewing(server.front.url, "/x") as viewer, viewing(server.front.url, "/x") as slow:
        server.front.stalled = 2.0
        server.publish("/x", bytes(10), RAW)
        await viewer.until_seen("/x")
        await slow.until_seen("/x")
        slow.socket.transport.pause_reading()
        picture = bytes(1 << 17)

        def sent() -> bool:
            server.publish("/x", picture, RAW)
            return bool(server.front.clients == 1)

        await until(sent, what="the end of the slow client", pause=0.01)
        server.publish("/y", *encode_value("on"))
        await until(lambda: "/y" in viewer.topics)


async def test_a_message_in_parts_is_bounded_too(serve: Any) -> None:
    async with serve() as server, viewing(server.front.url) as viewer:
        await viewer.socket.send(["x" * (VIEWER_LIMITS.message // 4)] * 5)
        await until(lambda: viewer.socket.close_code == 1009)
        assert server.front.drops.totals() == {"foxglove-refused": 1}


async def test_a_client_without_the_subprotocol_is_refused(serve: Any) -> None:
    async with serve() as server:
        assert await refusal(server.front.url, subprotocols=None) == 400
        assert await refusal(server.front.url, subprotocols=["foxglove.websocket.v1"]) == 400


async def test_clients_are_told_of_the_end(serve: Any) -> None:
    async with serve() as server, viewing(server.front.url) as viewer:
        leaving = asyncio.create_task(server.__aexit__(None, None, None))
        await until(lambda: viewer.socket.close_code is not None)
        await leaving
        await until(lambda: not server.front.clients)
        assert await refusal(server.front.url) == 503


async def test_no_request_breaks_the_front(serve: Any) -> None:
    chance = random.Random(1)
    async with serve(token=TOKEN) as server:
        host, port = server.front.url.removeprefix("ws://").split(":")
        for _ in range(100):
            noise = chance.randbytes(chance.randrange(300))
            for data in (noise, b"GET / HTTP/1.1\r\nUpgrade: websocket\r\n" + noise + b"\r\n\r\n"):
                reader, writer = await asyncio.open_connection(host, int(port))
                writer.write(data)
                writer.write_eof()
                assert (await reader.read(12)) in (b"", b"HTTP/1.1 400", b"HTTP/1.1 401", b"HTTP/1.1 426")
                writer.close()
        async with viewing(f"{server.front.url}?token={TOKEN.replace(' ', '+')}") as viewer:
            assert viewer.info["name"] == "test"


async def test_viewers_that_come_at_once_get_the_last_messages_each(serve: Any) -> None:
    async with serve() as server:
        for number in range(VIEWER_LIMITS.clients):
            server.publish(f"/{number}", *encode_value(float(number)))

        async def see(number: int) -> None:
            async with viewing(server.front.url, f"/{number}") as viewer:
                assert [one.data for one in await viewer.until_seen(f"/{number}")] == [number]

        await asyncio.gather(*[see(number) for number in range(VIEWER_LIMITS.clients)])
