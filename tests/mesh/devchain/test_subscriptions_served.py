"""What a server of subscriptions refuses, and how it ends."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import aiohttp
import pytest

from mesh.devchain import EmbeddedChain, JsonRpcServer
from mesh.devchain.embedded import EmbeddedProvider
from tests.mesh.chain.pushing import Client, connected, node, server
from tests.support.waiting import until

if TYPE_CHECKING:
    from web3.types import RPCEndpoint, RPCResponse

__all__ = ["node", "server"]


@pytest.mark.parametrize(
    ("params", "code"),
    [
        (["newPendingTransactions"], -32601),
        ([], -32602),
        ([7], -32602),
        (["logs", "all"], -32602),
        (["logs", {"address": "0x12"}], -32602),
        (["logs", {"topics": 7}], -32602),
        (["logs", {"topics": ["0x12"]}], -32602),
    ],
)
async def test_what_can_not_be_subscribed_to_is_refused(server: JsonRpcServer, params: list[Any], code: int) -> None:
    async with connected(server) as client:
        assert (await client.ask("eth_subscribe", *params))["error"]["code"] == code


async def test_nobody_subscribes_by_post(server: JsonRpcServer) -> None:
    request = {"jsonrpc": "2.0", "id": 1, "method": "eth_subscribe", "params": ["newHeads"]}
    async with aiohttp.ClientSession() as session, session.post(server.url, json=request) as response:
        assert (await response.json())["error"]["code"] == -32601


async def test_the_node_is_not_asked_when_nobody_is_subscribed(node: EmbeddedChain) -> None:
    counting = Counting(node)
    async with JsonRpcServer(counting) as server:
        async with connected(server) as client:
            await client.subscribe("newHeads")
            asked = counting.asked
            await until(lambda: counting.asked > asked + 3, seconds=30)
        await until(lambda: not server.connections, seconds=30)
        asked = counting.asked
        await asyncio.sleep(0.3)
        assert counting.asked <= asked + 1, "a look may have been under way"


class Counting(EmbeddedProvider):
    """An embedded chain that counts what it is asked, and can be lost."""

    asked = 0
    is_lost = False

    async def make_request(self, method: RPCEndpoint, params: Any) -> RPCResponse:
        self.asked += 1
        if self.is_lost:
            raise ConnectionError("the wire is cut")
        return await super().make_request(method, params)


async def test_nothing_is_missed_while_the_node_behind_is_lost(node: EmbeddedChain) -> None:
    flaky = Counting(node)
    async with JsonRpcServer(flaky) as server, connected(server) as client:
        subscription = await client.subscribe("newHeads")
        flaky.is_lost = True
        await node.mine(3)
        asked = flaky.asked
        await until(lambda: flaky.asked > asked + 2, seconds=30)
        flaky.is_lost = False
        assert [int((await client.notified(subscription))["number"], 16) for _ in range(3)] == [1, 2, 3]


async def test_leaving_the_server_closes_its_sockets(node: EmbeddedChain) -> None:
    async with JsonRpcServer(node.provider) as server, asyncio.timeout(30):
        session = aiohttp.ClientSession()
        socket = await session.ws_connect(server.ws_url)
        client = Client(socket)
        await client.subscribe("newHeads")
        leaving = asyncio.create_task(server.__aexit__(None, None, None))
        assert (await socket.receive()).type is aiohttp.WSMsgType.CLOSE
        await leaving
        await session.close()


async def test_a_page_may_not_open_a_socket_unless_its_origin_is_allowed(node: EmbeddedChain) -> None:
    async with JsonRpcServer(node.provider, allowed_origins=["http://page"]) as server:
        with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
            async with connected(server, Origin="http://elsewhere"):
                pass
        assert caught.value.status == 403
        async with connected(server, Origin="http://page") as client:
            assert (await client.ask("eth_blockNumber"))["result"] == "0x0"


async def test_a_browser_that_looks_in_is_told_what_this_is(server: JsonRpcServer) -> None:
    async with aiohttp.ClientSession() as session, session.get(server.url) as response:
        assert response.status == 426
        assert "JSON-RPC" in await response.text()
