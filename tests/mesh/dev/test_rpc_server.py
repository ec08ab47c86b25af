"""The JSON-RPC server, with the embedded chain behind it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import aiohttp
import pytest
from aiohttp import web

from mesh.dev import EmbeddedChain, JsonRpcServer
from tests.support.development import serve_embedded

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


@pytest.fixture
async def url() -> AsyncIterator[str]:
    async with serve_embedded() as served:
        yield served.url


async def _post(url: str, body: Any, **headers: str) -> tuple[int, Any]:
    async with (
        aiohttp.ClientSession() as session,
        session.post(url, json=body, headers=headers) as response,
    ):
        return response.status, await response.json() if response.content_type == "application/json" else None


async def test_a_request_gets_its_result(url: str) -> None:
    request = {"jsonrpc": "2.0", "id": "seven", "method": "eth_blockNumber", "params": []}
    assert await _post(url, request) == (200, {"jsonrpc": "2.0", "id": "seven", "result": "0x0"})


async def test_a_batch_gets_its_results_in_order_and_nothing_for_a_notification(url: str) -> None:
    batch = [
        {"jsonrpc": "2.0", "id": 1, "method": "eth_chainId", "params": []},
        {"jsonrpc": "2.0", "method": "evm_mine", "params": ["0x2"]},
        {"jsonrpc": "2.0", "id": 2, "method": "eth_blockNumber"},
    ]
    _, answers = await _post(url, batch)
    assert [(answer["id"], "result" in answer) for answer in answers] == [(1, True), (2, True)]
    assert answers[1]["result"] == "0x2"


async def test_notifications_alone_get_an_empty_response(url: str) -> None:
    assert await _post(url, [{"jsonrpc": "2.0", "method": "evm_mine"}]) == (204, None)


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ({"id": 1}, -32600),
        ([], -32600),
        ("text", -32600),
        ({"id": 1, "method": "eth_call", "params": {}}, -32602),
        ({"id": 1, "method": "eth_getBalance", "params": ["0x12"]}, -32602),
        ({"id": 1, "method": "eth_getBalance", "params": []}, -32602),
        ({"id": 1, "method": "eth_getBalance", "params": [1, 2, 3, 4]}, -32602),
        ({"id": 1, "method": "eth_getLogs", "params": ["0x"]}, -32602),
        ({"id": 1, "method": "eth_getLogs", "params": [{"fromBlock": ["0x1"]}]}, -32602),
        ({"id": 1, "method": "eth_mindControl", "params": []}, -32601),
        ({"id": 1, "method": "eth_getCode", "params": ["0x" + "00" * 20, "0xff"]}, -32000),
    ],
)
async def test_a_bad_request_gets_the_error_of_the_standard(url: str, body: Any, code: int) -> None:
    status, answer = await _post(url, body)
    assert status == 200
    assert answer["error"]["code"] == code
    assert answer["error"]["message"]


async def test_a_body_that_is_not_json_is_a_parse_error(url: str) -> None:
    async with aiohttp.ClientSession() as session, session.post(url, data=b"{nonsense") as response:
        assert (await response.json())["error"]["code"] == -32700


async def test_web_pages_are_refused(url: str) -> None:
    request = {"jsonrpc": "2.0", "id": 1, "method": "eth_chainId", "params": []}
    assert (await _post(url, request, Origin="http://page"))[0] == 403
    async with aiohttp.ClientSession() as session, session.options(url, headers={"Origin": "http://page"}) as response:
        assert "Access-Control-Allow-Origin" not in response.headers


async def test_a_loopback_server_refuses_other_host_names(url: str) -> None:
    request = {"jsonrpc": "2.0", "id": 1, "method": "eth_chainId", "params": []}
    assert (await _post(url, request, Host="evil.example:80"))[0] == 403


async def test_a_websocket_that_is_being_opened_lets_the_server_end(monkeypatch: pytest.MonkeyPatch) -> None:
    reached = asyncio.Event()

    async def never(socket: web.WebSocketResponse, request: web.Request) -> None:
        reached.set()
        await asyncio.Event().wait()

    monkeypatch.setattr(web.WebSocketResponse, "prepare", never)
    async with EmbeddedChain() as chain, aiohttp.ClientSession() as session:
        async with JsonRpcServer(chain.provider) as server:
            opening = asyncio.create_task(session.ws_connect(server.ws_url))
            await reached.wait()
        with pytest.raises(aiohttp.ClientError):
            await opening
