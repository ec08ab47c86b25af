"""What the page's server refuses: other sites' pages, strangers, too much of anything."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from yarl import URL

from bridges.web._access import WebOptions
from mesh.errors import ConfigurationError
from schemas import RpcKey
from tests.bridges.web.conftest import OWN
from tests.support.objectives import objective
from tests.support.waiting import until_answered
from tests.support.web.openapi import DOCUMENT

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.market import Place

TOKEN = "a token of people 123"
OPERATOR = "a token of operators 456"


async def refusal(browser: Any, method: str, path: str, headers: dict[str, str], **more: Any) -> tuple[int, str]:
    """The status and the code of a refused request."""
    async with browser.session.request(method, browser.server.url + path, headers=headers, **more) as response:
        return response.status, (await response.json())["error"]["code"]


async def test_requests_of_other_sites_are_refused(serve: Any) -> None:
    async with serve() as browser:
        market, orders = "/api/v1/market", "/api/v1/orders"
        assert await refusal(browser, "GET", market, {"Host": "rebound.example"}) == (421, "wrong-host")
        assert await refusal(browser, "GET", market, {"Origin": "https://evil.example"}) == (403, "wrong-origin")
        assert await refusal(browser, "GET", market, {"Sec-Fetch-Site": "cross-site"}) == (403, "wrong-origin")
        stream = "/api/v1/stream"
        assert await refusal(browser, "GET", stream, {"Origin": "http://evil.example"}) == (403, "wrong-origin")
        assert await refusal(browser, "POST", orders, {"Content-Type": "application/json"}, data=b"{}") == (
            403,
            "wrong-origin",
        )
        form = {"X-Aira-Request": "1", "Content-Type": "text/plain"}
        assert await refusal(browser, "POST", orders, form, data=b"{}") == (400, "invalid-request")


async def test_answers_carry_the_headers_that_protect_the_page(serve: Any) -> None:
    async with serve() as browser, browser.session.get(browser.server.url) as response:
        assert response.headers["Content-Security-Policy"].startswith("default-src 'self';")
        assert "frame-ancestors 'none'" in response.headers["Content-Security-Policy"]
        assert response.headers["X-Content-Type-Options"] == "nosniff"
    async with serve(embed=("https://robots.example",)) as browser, browser.session.get(browser.server.url) as response:
        assert "frame-ancestors https://robots.example" in response.headers["Content-Security-Policy"]


async def test_with_a_token_file_everything_but_the_page_needs_a_login(serve: Any) -> None:
    async with serve(token=TOKEN) as browser:
        assert (await browser.get("market", status=401))["error"]["code"] == "login-required"
        assert (await browser.post("rpc", {"method": "eth_chainId"}, status=401))["error"]["code"] == "login-required"
        assert (await browser.post("session", {"token": "wrong"}, status=401))["error"]["code"] == "login-required"
        await browser.get("openapi.json")
        async with browser.session.post(
            f"{browser.server.url}/api/v1/session", json={"token": TOKEN}, headers=OWN
        ) as response:
            cookie = response.headers["Set-Cookie"]
            assert "HttpOnly" in cookie
            assert "SameSite=Strict" in cookie
            session = cookie.partition(";")[0]
        headers = {"Cookie": session}
        async with browser.session.get(f"{browser.server.url}/api/v1/market", headers=headers) as response:
            assert (await response.json())["role"] == "anybody"


async def test_only_operators_drive_jobs(place: Place, serve: Any) -> None:
    async with place.agent("robot", open_services=True), serve(operator_token=OPERATOR) as browser:
        robot, job = place.address("robot"), {"liability": place.address("person")}
        refused = await browser.post(f"agents/{robot}/start", job, status=403)
        assert refused["error"]["code"] == "operators-only"
        session = f"{browser.server.url}/api/v1/session"
        async with browser.session.post(session, json={"token": OPERATOR}, headers=OWN) as response:
            headers = OWN | {"Cookie": response.headers["Set-Cookie"].partition(";")[0]}
        await until_answered(browser.server.components.network.session, str(RpcKey(robot, "start")))
        done = await browser.post(f"agents/{robot}/start", job, headers=headers)
        assert done["success"] is False  # it has no such job


async def test_bodies_are_bounded(place: Place, serve: Any) -> None:
    async with serve() as browser:
        browser.server.api.files.upload_limit = 1000
        data = {"X-Aira-Request": "1", "Content-Type": "application/octet-stream"}
        refused = await browser.post("objectives", bytes(1001), headers=data, status=413)
        assert refused["error"]["code"] == "upload-too-large"
        assert (await browser.post("orders", b"x" * 400_000, status=400))["error"]["code"] == "invalid-request"
        assert (await browser.post("orders", b"{}", status=400))["error"]["code"] == "invalid-message"


async def test_other_methods_of_the_node_are_not_passed_on(serve: Any) -> None:
    async with serve() as browser:
        sent = await browser.post("rpc", {"id": 1, "method": "eth_sendRawTransaction", "params": ["0x00"]})
        assert sent["error"]["code"] == -32601
        read = await browser.post("rpc", {"id": 2, "method": "eth_blockNumber"})
        assert int(read["result"], 16) >= 0


async def test_names_and_images_of_strangers_are_never_html(serve: Any) -> None:
    script = "<script>alert(1)</script>"
    png = b"\x89PNG\r\n\x1a\n" + script.encode()
    async with serve() as browser:
        data = {"X-Aira-Request": "1", "Content-Type": "application/octet-stream"}
        made = await browser.post("objectives", objective((f"/{script}", script), ("/image", png)), headers=data)
        file = f"{browser.server.url}/api/v1/files/{made['cid']}"
        found = await browser.get(f"files/{made['cid']}/messages")
        assert found["messages"][0]["value"] == script
        async with browser.session.get(file) as response:
            assert response.content_type == "application/octet-stream"
            assert response.headers["Content-Disposition"].startswith("attachment")
            assert "sandbox" in response.headers["Content-Security-Policy"]
        async with browser.session.get(browser.server.url + found["messages"][1]["image"]) as response:
            assert response.content_type == "image/png"
            assert response.headers["X-Content-Type-Options"] == "nosniff"


def test_other_machines_reach_only_a_server_with_tls_and_a_login() -> None:
    with pytest.raises(ConfigurationError):
        WebOptions(host="0.0.0.0", token=TOKEN).check()
    with pytest.raises(ConfigurationError):
        WebOptions(host="192.0.2.1", certificate="c", key="k").check()
    WebOptions(host="0.0.0.0", token=TOKEN, certificate="c", key="k").check()


async def test_files_outside_the_page_are_not_served(serve: Any, tmp_path: Path) -> None:
    (tmp_path / "secret.txt").write_text("secret")
    async with serve() as browser:
        for path in ("/..%2fsecret.txt", "/x%2f..%2f..%2fsecret.txt"):
            async with browser.session.get(URL(browser.server.url + path, encoded=True)) as response:
                assert response.status == 404
        async with browser.session.get(f"{browser.server.url}/jobs/0x00") as response:
            assert "<title>page</title>" in await response.text()


async def test_every_route_is_documented(serve: Any) -> None:
    async with serve() as browser:
        routes = {(route.method.lower(), route.path) for route in browser.server.api.routes()}
    documented = {(method, path) for path, methods in DOCUMENT["paths"].items() for method in methods}
    assert documented - routes == {("post", "/api/v1/session")}
    assert routes <= documented
