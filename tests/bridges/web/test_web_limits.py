"""What strangers use up is theirs: requests that are refused, wrong tokens, half requests, uploads that never end."""

from __future__ import annotations

import asyncio
import tempfile
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest
from aiohttp import ClientSession, CookieJar

from bridges.web._files import UPLOAD_LIMITS
from bridges.web.server import REFUSED, REQUESTS
from tests.bridges.web.conftest import OWN
from tests.support.market import MODEL
from tests.support.objectives import objective
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.market import Place

TOKEN = "a token of people 123"
FOREIGN = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"}
PART = 50_000


async def statuses(browser: Any, number: int, path: str, **request: Any) -> Counter[int]:
    """The statuses of that many requests."""
    found: Counter[int] = Counter()
    for _ in range(number):
        async with browser.session.request(
            request.get("method", "GET"),
            browser.server.url + path,
            **{name: value for name, value in request.items() if name != "method"},
        ) as response:
            found[response.status] += 1
    return found


async def use_up(browser: Any, *said: str) -> None:
    """Ask for the page, as one client or as these in turn, until a request is refused; a slow machine asks longer."""
    for number in range(10 * int(REQUESTS.burst)):
        headers = {"X-Forwarded-For": said[number % len(said)]} if said else {}
        if (await statuses(browser, 1, "/", headers=headers))[429]:
            return
    pytest.fail("no request was refused")


@pytest.mark.parametrize("path", ["/api/v1/market", "/", "/rpc"])
@pytest.mark.parametrize("site", ["cross-site", "same-site"])
async def test_a_page_of_another_site_uses_up_no_request_of_the_own_page(serve: Any, path: str, site: str) -> None:
    async with serve() as browser:
        flood = int(REQUESTS.burst + REFUSED.burst)
        refused = await statuses(browser, flood, path, headers=FOREIGN | {"Sec-Fetch-Site": site})
        assert refused[429] > flood / 2
        own = {"Sec-Fetch-Site": "same-origin"}
        assert await statuses(browser, 50, "/api/v1/market", headers=own) == {200: 50}


async def test_requests_without_a_login_use_up_none_of_those_who_have_one(serve: Any) -> None:
    async with serve(token=TOKEN) as browser, ClientSession(cookie_jar=CookieJar(unsafe=True)) as session:
        flood = int(REQUESTS.burst + REFUSED.burst)
        assert (await statuses(browser, flood, "/api/v1/market"))[429] > flood / 2
        await use_up(browser)
        browser.session, strangers = session, browser.session
        assert await browser.post("session", {"token": TOKEN}) == {"role": "anybody"}
        assert await statuses(browser, 50, "/api/v1/market") == {200: 50}
        browser.session = strangers


async def test_wrong_tokens_do_not_lock_out_the_right_one(serve: Any) -> None:
    async with serve(token=TOKEN) as browser:
        wrong = Counter[int]()
        for number in range(int(REQUESTS.burst + REFUSED.burst) + 50):
            body = {"token": f"guess {number}"} if number % 2 else ["no request"]
            url = f"{browser.server.url}/api/v1/session"
            async with browser.session.post(url, json=body, headers=OWN) as response:
                wrong[response.status] += 1
        assert wrong[429]
        assert wrong[401]
        assert await browser.post("session", {"token": TOKEN}) == {"role": "anybody"}


async def test_behind_a_proxy_of_ours_each_client_has_limits_of_its_own(serve: Any) -> None:
    async with serve(proxies=("127.0.0.1", "192.0.2.200")) as browser:
        for said in ("192.0.2.1", "6.6.6.6, 192.0.2.1", "192.0.2.1, 192.0.2.200"):
            await use_up(browser, said)
        fresh = {"X-Forwarded-For": "192.0.2.2"}
        assert await statuses(browser, 50, "/", headers=fresh) == {200: 50}
    async with serve() as browser:  # others than our proxy may say anything
        await use_up(browser, *(f"192.0.2.{number}" for number in range(1, 101)))


async def test_half_requests_from_one_address_leave_room_for_whole_ones_from_it(serve: Any) -> None:
    async with serve() as browser:
        host, port = browser.server.url.removeprefix("http://").split(":")
        half = [await asyncio.open_connection(host, int(port)) for _ in range(300)]
        for _, writer in half:
            writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"a" * 7000)
        async with ClientSession() as session:
            browser.session, own = session, browser.session
            assert await statuses(browser, 10, "/api/v1/market") == {200: 10}
            browser.session = own
        ended = [asyncio.ensure_future(reader.read()) for reader, _ in half[:200]]
        await asyncio.wait_for(asyncio.gather(*ended, return_exceptions=True), 20)
        for _, writer in half:
            writer.transport.abort()


async def test_uploads_that_never_end_are_bounded_together(serve: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def held() -> list[int]:
        """The sizes of the temporary files."""
        return [file.stat().st_size for file in tmp_path.glob("aira-upload-*/objective")]

    async def upload(browser: Any, sender: str, parts: int) -> tuple[int, str]:
        async def content() -> Any:
            for _ in range(parts):
                yield bytes(PART)
            await gate.wait()

        headers = OWN | {"Content-Type": "application/octet-stream", "X-Forwarded-For": sender}
        url = f"{browser.server.url}/api/v1/objectives"
        async with browser.session.post(url, data=content(), headers=headers) as response:
            return response.status, (await response.json()).get("error", {}).get("code", "")

    gate = asyncio.Event()
    async with serve(settings={"objective_size_limit": 10 * PART}, proxies=("127.0.0.1",)) as browser:
        async with asyncio.timeout(30):
            senders = [f"192.0.2.{number}" for number in range(UPLOAD_LIMITS.at_once + 2)]
            small = [
                asyncio.create_task(upload(browser, one, 1))
                for one in senders
                for _ in range(UPLOAD_LIMITS.per_sender + 1)
            ]
            await until(lambda: sum(one.done() for one in small) == len(small) - UPLOAD_LIMITS.at_once)
            assert {one.result() for one in small if one.done()} == {(503, "uploads-busy")}
            assert len(held()) == UPLOAD_LIMITS.at_once
            gate.set()
            assert [(await one)[0] for one in small].count(200) == UPLOAD_LIMITS.at_once
            gate.clear()
            large = [asyncio.create_task(upload(browser, one, 9)) for one in senders[:4]]
            await until(lambda: sum(one.done() for one in large) == 2)
            assert sum(held()) <= 2 * 10 * PART
            twice = [asyncio.create_task(upload(browser, senders[5], parts)) for parts in (1, 10)]
            await until(lambda: any(one.done() for one in twice))
            gate.set()
            outcomes = [await one for one in (*large, *twice)]
            assert {code for status, code in outcomes if status != 200} == {"uploads-busy"}
        assert (await upload(browser, senders[0], 9))[0] == 200
        assert (await upload(browser, senders[0], 11)) == (413, "upload-too-large")
        assert not held()


async def test_an_upload_that_breaks_off_leaves_nothing(
    serve: Any, tmp_path: Path, monkeypatch: Any, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    by_length, in_chunks = "Content-Length: 90000\r\n\r\nabc", "Transfer-Encoding: chunked\r\n\r\n3\r\nabc\r\n"
    async with serve() as browser:
        place = browser.server.url.removeprefix("http://")
        head = f"POST /api/v1/objectives HTTP/1.1\r\nHost: {place}\r\nX-Aira-Request: 1\r\n"
        host, port = place.split(":")
        for framing in (by_length, in_chunks):
            _, writer = await asyncio.open_connection(host, int(port))
            writer.write(f"{head}Content-Type: application/octet-stream\r\n{framing}".encode())
            await until(lambda: browser.server.api.files._uploads, what="an upload")
            writer.close()
            await until(lambda: not browser.server.api.files._uploads, what="the end of the upload")
        await until(lambda: not list(tmp_path.glob("aira-upload-*")), what="an empty folder")
        await browser.get("market")
    assert "Traceback" not in caplog.text


@pytest.mark.parametrize("lifetime", [-5, 0, 10**23, 10**6])
async def test_a_lifetime_that_no_provider_takes_is_refused_before_anything_is_approved(
    place: Place, serve: Any, lifetime: int
) -> None:
    chain, person = place.chains["person"], place.address("person")
    async with serve("person") as browser:
        before = await chain.tokens.allowance(person, chain.factory)
        data = {"X-Aira-Request": "1", "Content-Type": "application/octet-stream"}
        cid = (await browser.post("objectives", objective(("/blink", "on")), headers=data))["cid"]
        order = {"model": MODEL, "objective": cid, "cost": "5", "lifetime": lifetime}
        refused = await browser.post("local/orders", order, status=400)
        assert refused["error"]["code"] == "invalid-lifetime"
        assert await chain.tokens.allowance(person, chain.factory) == before
        assert browser.server.components.agent.orders() == []
