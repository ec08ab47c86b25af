"""Connections to nodes that are missing, lost, frozen or on another chain."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from aiohttp import web

from mesh.chain import Chain, Node, NodeUnreachable, RequestRefused, Timing
from mesh.dev import EmbeddedChain, JsonRpcServer
from mesh.errors import ClosedError, ConfigurationError, RemoteError
from tests.mesh.chain.conftest import QUICK, unreachable
from tests.support.nodes import Anvil
from tests.support.ports import free_port
from tests.support.raising import raises_with
from tests.support.serving import serving


@pytest.mark.parametrize("scheme", ["http", "ws"])
async def test_a_missing_node_is_an_error(scheme: str) -> None:
    endpoint = f"{scheme}://127.0.0.1:{free_port()}"
    with pytest.raises(NodeUnreachable) as caught:
        async with Chain(endpoint, timing=QUICK):
            pass
    assert isinstance(caught.value, RemoteError)
    assert caught.value.endpoint == endpoint
    assert endpoint in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.hint


async def test_attempts_are_bounded_and_spaced() -> None:
    seen: list[float] = []

    async def busy(request: web.Request) -> web.Response:
        seen.append(time.monotonic())
        return web.Response(status=503)

    timing = replace(QUICK, attempts=4, retry_delay=0.02)
    async with serving(busy) as url:
        with unreachable("503"):
            async with Node(url, timing=timing):
                pass
    pauses = [later - earlier for earlier, later in pairwise(seen)]
    assert len(seen) == 4
    assert all(pause >= wanted for pause, wanted in zip(pauses, (0.015, 0.03, 0.06), strict=True)), (
        "less a quarter of jitter"
    )


async def test_a_short_outage_is_bridged_by_retries() -> None:
    count = 0

    async def hesitant(request: web.Request) -> web.Response:
        nonlocal count
        count += 1
        if count < 3:
            return web.Response(status=502)
        return web.json_response({"jsonrpc": "2.0", "id": (await request.json())["id"], "result": "0x7"})

    async with serving(hesitant) as url, Node(url, timing=replace(QUICK, attempts=3)) as node:
        assert node.chain_id == 7


@pytest.mark.parametrize(
    ("response", "why"),
    [
        ({"text": "<html>hello</html>"}, "not JSON"),
        ({"text": "{}"}, "not a JSON-RPC server"),
        ({"text": "[1]"}, "not a JSON-RPC server"),
        ({"status": 401, "text": "who are you?"}, "401"),
        ({"status": 404}, "404"),
    ],
)
async def test_a_server_that_is_not_a_node_fails_at_once(response: dict[str, Any], why: str) -> None:
    count = 0

    async def answer(request: web.Request) -> web.Response:
        nonlocal count
        count += 1
        return web.Response(**response)

    async with serving(answer) as url:
        with unreachable(why):
            async with Node(url, timing=QUICK):
                pass
    assert count == 1


async def test_a_node_that_never_answers_times_out() -> None:
    async def sleepy(request: web.Request) -> web.Response:
        await asyncio.Event().wait()
        raise AssertionError

    async with serving(sleepy) as url:
        with unreachable("no answer in time"):
            async with Node(url, timing=replace(QUICK, request_timeout=0.05)):
                pass


@pytest.mark.parametrize("scheme", ["http", "ws"])
async def test_a_server_that_says_nothing_is_given_up_after_one_attempt(scheme: str) -> None:
    attempts: list[asyncio.StreamWriter] = []
    server = await asyncio.start_server(lambda reader, writer: attempts.append(writer), "127.0.0.1")
    async with server:
        port = server.sockets[0].getsockname()[1]
        with unreachable("no answer in time"):
            async with Node(f"{scheme}://127.0.0.1:{port}", timing=Timing(first_timeout=0.2, request_timeout=60)):
                pass
        for writer in attempts:
            writer.close()
    assert len(attempts) == 1


async def test_a_server_that_speaks_no_http_is_given_up_at_once_in_one_line() -> None:
    attempts: list[bytes] = []

    async def greet(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        attempts.append(await reader.readline())
        writer.write(b"SSH-2.0-server\r\n")
        writer.close()

    server = await asyncio.start_server(greet, "127.0.0.1")
    async with server:
        with unreachable("the answer is not HTTP"):
            async with Node(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"):
                pass
    assert len(attempts) == 1


async def test_a_json_rpc_error_with_an_http_status_is_reported() -> None:
    async def rude(request: web.Request) -> web.Response:
        error = {"code": -32600, "message": "invalid request"}
        return web.json_response({"jsonrpc": "2.0", "id": 1, "error": error}, status=400)

    async with serving(rude) as url:
        with raises_with(RequestRefused, rpc_code=-32600, detail="invalid request"):
            async with Node(url, timing=QUICK):
                pass


@pytest.mark.parametrize("endpoint", ["", "127.0.0.1:8545", "ftp://127.0.0.1"])
def test_invalid_endpoints_are_refused(endpoint: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        Node(endpoint)
    assert caught.value.code == "invalid-endpoint"
    assert str(caught.value) == f"{endpoint!r} is not the address of a node"


@pytest.mark.parametrize("scheme", ["http", "ws"])
async def test_a_restarted_node_is_connected_to_again(scheme: str) -> None:
    anvil = Anvil()
    endpoint = anvil.url if scheme == "http" else anvil.ws_url
    await asyncio.to_thread(anvil.start)
    try:
        async with Node(endpoint, timing=QUICK) as node:
            assert await node.block_number() == 0
            await asyncio.to_thread(anvil.stop)
            with pytest.raises(NodeUnreachable):
                await node.block_number()
            await asyncio.to_thread(anvil.start)
            assert await node.block_number() == 0
    finally:
        await asyncio.to_thread(anvil.stop)


async def test_requests_fail_when_their_websocket_closes() -> None:
    async def hang_up(request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        await socket.receive()
        await socket.close()
        return socket

    async with serving(hang_up) as url, asyncio.timeout(60):
        with unreachable("connection was closed"):
            async with Node(url.replace("http", "ws"), timing=QUICK):
                pass


async def test_many_requests_share_a_websocket() -> None:
    async with Anvil() as anvil, Node(anvil.ws_url, timing=QUICK) as node:
        assert await asyncio.gather(*(node.block_number() for _ in range(50))) == [0] * 50


async def test_a_closed_node_raises() -> None:
    async with EmbeddedChain() as chain, JsonRpcServer(chain.provider) as server:
        async with Node(server.url, timing=QUICK) as node:
            pass
        with pytest.raises(ClosedError):
            await node.block_number()
        with pytest.raises(ClosedError):
            _ = node.chain_id


async def test_a_closed_embedded_chain_raises() -> None:
    async with EmbeddedChain() as chain, Node(chain.provider, timing=QUICK) as node:
        await chain.__aexit__(None, None, None)
        with pytest.raises(ClosedError):
            await node.block_number()


@pytest.mark.parametrize("scheme", ["http", "ws"])
async def test_the_next_node_is_asked_when_one_fails(scheme: str) -> None:
    async with Anvil() as first, Anvil() as second:
        urls = [anvil.url if scheme == "http" else anvil.ws_url for anvil in (first, second)]
        async with Node(urls, timing=replace(QUICK, attempts=1)) as node:
            await node.request("evm_mine")
            assert await node.block_number() == 1
            await asyncio.to_thread(first.kill)
            assert await asyncio.gather(*(node.block_number() for _ in range(5))) == [0] * 5
            await asyncio.to_thread(first.start)
            await asyncio.to_thread(second.kill)
            assert await node.block_number() == 0
            await asyncio.to_thread(first.kill)
            with pytest.raises(NodeUnreachable) as caught:
                await node.block_number()
    assert caught.value.endpoint == ", ".join(urls)


async def test_several_nodes_may_be_addresses_and_provider_objects() -> None:
    async with EmbeddedChain() as chain:
        endpoint: list[Any] = [f"http://127.0.0.1:{free_port()}", chain.provider]
        async with Node(endpoint, timing=QUICK) as node:
            assert await node.block_number() == 0


async def test_a_frozen_node_is_skipped_and_asked_last_afterwards() -> None:
    async with Anvil() as frozen, Anvil() as other:
        timing = replace(QUICK, request_timeout=4)
        async with Node(f"{frozen.url}, {other.url}", timing=timing) as node:
            await asyncio.to_thread(frozen.pause)
            started = time.monotonic()
            for _ in range(5):
                await node.block_number()
            assert 0.9 * timing.request_timeout < time.monotonic() - started < 2 * timing.request_timeout
            await asyncio.to_thread(frozen.resume)


async def test_a_node_that_is_missing_at_the_start_is_skipped() -> None:
    async with Anvil() as anvil, Node(f"http://127.0.0.1:{free_port()},{anvil.url}", timing=QUICK) as node:
        assert node.chain_id == 31337


@pytest.mark.parametrize("scheme", ["http", "ws"])
async def test_nodes_of_different_chains_are_refused(scheme: str) -> None:
    async with Anvil() as anvil, Anvil(arguments=("--chain-id", "4")) as other:
        urls = [one.url if scheme == "http" else one.ws_url for one in (anvil, other)]
        with raises_with(ConfigurationError, code="wrong-chain") as caught:
            async with Node(urls, timing=QUICK):
                pass
    assert str(caught.value) == f"the node {urls[1]} is on the chain 4, the others are on the chain 31337"
    assert caught.value.hint


async def test_a_node_of_another_chain_that_starts_later_is_skipped() -> None:
    other = Anvil(arguments=("--chain-id", "4"))
    async with Anvil() as anvil, Node((anvil.url, other.url), timing=replace(QUICK, attempts=1)) as node, other:
        await asyncio.to_thread(anvil.kill)
        with unreachable(f"{other.url}: .* 0x4, .* 0x7a69"):
            await node.block_number()


async def test_a_node_that_restarts_on_another_chain_is_skipped() -> None:
    first, second = Anvil(), Anvil()
    async with second, Node((first.url, second.url), timing=replace(QUICK, attempts=1)) as node:
        async with first:
            await asyncio.to_thread(second.kill)
            assert await node.block_number() == 0, "by the first"
            await asyncio.to_thread(second.start)
        assert await node.block_number() == 0, "by the second"
        async with Anvil(port=first.port, arguments=("--chain-id", "4")):
            await asyncio.to_thread(second.kill)
            with unreachable("on the chain 0x4"):
                await node.block_number()
            await asyncio.to_thread(second.start)


async def test_too_many_requests_are_retried() -> None:
    count = 0

    async def busy(request: web.Request) -> web.Response:
        nonlocal count
        count += 1
        if count < 3:
            error = {"code": -32005, "message": "too many requests"}
            return web.json_response({"jsonrpc": "2.0", "id": 1, "error": error}, status=429)
        return web.json_response({"jsonrpc": "2.0", "id": (await request.json())["id"], "result": "0x7"})

    async with serving(busy) as url, Node(url, timing=replace(QUICK, attempts=3)) as node:
        assert node.chain_id == 7


@pytest.mark.parametrize("endpoint", [(), "http://127.0.0.1:1,", ["http://127.0.0.1:1", "ftp://x"]])
def test_each_of_several_endpoints_is_validated(endpoint: Any) -> None:
    with pytest.raises(ConfigurationError, match="is not the address of a node"):
        Node(endpoint)
