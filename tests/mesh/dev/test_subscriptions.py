"""`eth_subscribe` over a WebSocket, with web3's own subscriptions and with a plain client."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import aiohttp
import pytest
from web3 import AsyncWeb3, WebSocketProvider

from mesh.chain import XRT, Account, Chain, Deployment, Node, TransactionSender, deploy
from mesh.dev import EmbeddedChain, JsonRpcServer
from mesh.dev._embedded import EmbeddedProvider
from schemas import keccak256
from tests.mesh.chain.conftest import QUICK
from tests.support.dev.websockets import SubscriptionClient, connected, node, server
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


__all__ = ["node", "server"]

TRANSFER = "0x" + keccak256(b"Transfer(address,address,uint256)").hex()


@asynccontextmanager
async def token(node: EmbeddedChain) -> AsyncIterator[tuple[Chain, Deployment]]:
    deployer = Account(node.funded_keys[0])
    deployment = await deploy(node.provider, deployer)
    async with Chain(node.provider, account=deployer, timing=QUICK) as chain:
        yield chain, deployment


async def test_web3_receives_new_heads_and_the_logs_it_subscribed_to(
    node: EmbeddedChain, server: JsonRpcServer
) -> None:
    async with token(node) as (chain, deployment), AsyncWeb3(WebSocketProvider(server.ws_url)) as web3:
        heads = await web3.eth.subscribe("newHeads")
        logs = await web3.eth.subscribe("logs", {"address": deployment.xrt, "topics": [TRANSFER]})
        before = await web3.eth.block_number
        await chain.tokens.approve(deployment.factory, 7)
        tx = await chain.tokens.transfer(deployment.factory, 5)
        heard: dict[str, list[Any]] = {heads: [], logs: []}
        async with asyncio.timeout(30):
            async for message in web3.socket.process_subscriptions():
                heard[str(message["subscription"])].append(message["result"])
                if [len(results) for results in heard.values()] == [2, 1]:
                    break
        block = await web3.eth.get_block(before + 2)
    assert [head["number"] for head in heard[heads]] == [before + 1, before + 2]
    assert (heard[heads][1]["hash"], heard[heads][1]["parentHash"]) == (block["hash"], block["parentHash"])
    assert "transactions" not in heard[heads][1]
    [log] = heard[logs]
    assert ("0x" + bytes(log["transactionHash"]).hex(), log["address"]) == (tx, deployment.xrt)
    assert (int.from_bytes(log["data"], "big"), log["removed"]) == (5, False)


async def test_a_websocket_answers_as_a_post_does(server: JsonRpcServer) -> None:
    async with connected(server) as client:
        assert (await client.ask("eth_blockNumber"))["result"] == "0x0"
        assert (await client.ask("eth_mindControl"))["error"]["code"] == -32601
        await client.socket.send_str("{nonsense")
        assert (await client.receive())["error"]["code"] == -32700
        await client.socket.send_json([{"id": 1, "method": "eth_chainId"}, {"id": 2, "method": "eth_blockNumber"}])
        assert [answer["id"] for answer in await client.receive()] == [1, 2]


async def test_our_client_works_over_a_websocket(node: EmbeddedChain, server: JsonRpcServer) -> None:
    async with token(node) as (_, deployment), Chain(server.ws_url, timing=QUICK) as chain:
        assert chain.xrt == deployment.xrt
        assert await asyncio.gather(*(chain.block_number() for _ in range(20))) == [deployment.block_number] * 20


async def test_every_block_is_sent_once(node: EmbeddedChain, server: JsonRpcServer) -> None:
    async with connected(server) as client:
        subscription = await client.subscribe("newHeads")
        await node.mine(300)
        numbers = [int((await client.next_notification(subscription))["number"], 16) for _ in range(300)]
    assert numbers == list(range(1, 301))


async def test_earlier_blocks_are_not_sent(node: EmbeddedChain, server: JsonRpcServer) -> None:
    async with connected(server) as early, connected(server) as late:
        first = await early.subscribe("newHeads")
        await node.mine(1)
        second = await late.subscribe("newHeads")
        await node.mine(1)
        assert int((await late.next_notification(second))["number"], 16) == 2
        assert [int((await early.next_notification(first))["number"], 16) for _ in range(2)] == [1, 2]


async def test_logs_of_replaced_blocks_are_removed_before_new_ones_are_sent(
    node: EmbeddedChain, server: JsonRpcServer
) -> None:
    async with token(node) as (chain, deployment), connected(server) as client:
        subscription = await client.subscribe("logs", {"address": deployment.xrt})
        for value in (1, 2):
            await chain.tokens.approve(deployment.factory, value)
        notifications = [await client.next_notification(subscription) for _ in range(2)]
        await node.request("evm_revert", [hex(await chain.block_number() - 2)])
        await node.mine(2)
        await chain.tokens.approve(deployment.factory, 3)
        notifications += [await client.next_notification(subscription) for _ in range(3)]
    assert [(int(log["data"], 16), log["removed"]) for log in notifications] == [
        (1, False),
        (2, False),
        (2, True),
        (1, True),
        (3, False),
    ]


async def test_a_chain_that_is_reverted_past_the_subscription_is_followed(
    node: EmbeddedChain, server: JsonRpcServer
) -> None:
    await node.mine(5)
    async with connected(server) as client:
        subscription = await client.subscribe("newHeads")
        await node.mine(1)
        assert int((await client.next_notification(subscription))["number"], 16) == 6
        await node.request("evm_revert", ["0x2"])
        assert int((await client.next_notification(subscription))["number"], 16) == 2
        await node.mine(1)
        assert int((await client.next_notification(subscription))["number"], 16) == 3


async def test_nothing_is_sent_after_unsubscribing(node: EmbeddedChain, server: JsonRpcServer) -> None:
    async with connected(server) as client:
        one, other = await client.subscribe("newHeads"), await client.subscribe("newHeads")
        assert (await client.ask("eth_unsubscribe", one))["result"] is True
        assert (await client.ask("eth_unsubscribe", one))["error"]["code"] == -32602
        await node.mine(2)
        for _ in range(2):
            await client.next_notification(other)


async def test_a_subscription_belongs_to_one_connection(server: JsonRpcServer) -> None:
    async with connected(server) as one, connected(server) as other:
        subscription = await one.subscribe("newHeads")
        assert (await other.ask("eth_unsubscribe", subscription))["error"]["code"] == -32602


async def test_whole_blocks_contain_their_transactions(node: EmbeddedChain, server: JsonRpcServer) -> None:
    """As the JavaScript of generation 3 does: by `to`, and then by the receipt's logs."""
    async with token(node) as (chain, deployment), Node(server.url, timing=QUICK) as way:
        receipt = await TransactionSender(chain.node, Account(node.funded_keys[0])).call(
            chain.node.contract("XRT", deployment.xrt).transfer(deployment.factory, XRT)
        )
        block = await way.request("eth_getBlockByNumber", hex(receipt.block_number), True)
        [sent] = [one for one in block["transactions"] if one["to"] == deployment.xrt.lower()]
        assert (sent["hash"], sent["input"][:10], int(sent["blockNumber"], 16)) == (
            receipt.tx,
            "0xa9059cbb",
            receipt.block_number,
        )
        assert {"from", "gas", "gasPrice", "nonce", "value", "transactionIndex", "blockHash"} <= sent.keys()
        logs = (await way.request("eth_getTransactionReceipt", sent["hash"]))["logs"]
        assert logs[0]["topics"][0] == TRANSFER


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
async def test_invalid_subscriptions_are_refused(server: JsonRpcServer, params: list[Any], code: int) -> None:
    async with connected(server) as client:
        assert (await client.ask("eth_subscribe", *params))["error"]["code"] == code


async def test_post_has_no_subscriptions(server: JsonRpcServer) -> None:
    request = {"jsonrpc": "2.0", "id": 1, "method": "eth_subscribe", "params": ["newHeads"]}
    async with aiohttp.ClientSession() as session, session.post(server.url, json=request) as response:
        assert (await response.json())["error"]["code"] == -32601


async def test_the_node_is_polled_only_with_subscribers(node: EmbeddedChain) -> None:
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

    async def make_request(self, method: str, params: Any) -> Any:
        self.asked += 1
        if self.is_lost:
            raise ConnectionError("the wire is cut")
        return await super().make_request(method, params)


async def test_blocks_during_an_outage_of_the_node_are_sent_afterwards(node: EmbeddedChain) -> None:
    flaky = Counting(node)
    async with JsonRpcServer(flaky) as server, connected(server) as client:
        subscription = await client.subscribe("newHeads")
        flaky.is_lost = True
        await node.mine(3)
        asked = flaky.asked
        await until(lambda: flaky.asked > asked + 2, seconds=30)
        flaky.is_lost = False
        assert [int((await client.next_notification(subscription))["number"], 16) for _ in range(3)] == [1, 2, 3]


async def test_leaving_the_server_closes_its_sockets(node: EmbeddedChain) -> None:
    async with JsonRpcServer(node.provider) as server, asyncio.timeout(30):
        session = aiohttp.ClientSession()
        socket = await session.ws_connect(server.ws_url)
        client = SubscriptionClient(socket)
        await client.subscribe("newHeads")
        leaving = asyncio.create_task(server.__aexit__(None, None, None))
        assert (await socket.receive()).type is aiohttp.WSMsgType.CLOSE
        await leaving
        await session.close()


async def test_web_pages_can_not_open_a_websocket(server: JsonRpcServer) -> None:
    with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
        async with connected(server, Origin="http://page"):
            pass
    assert caught.value.status == 403


async def test_a_browser_gets_an_explanation(server: JsonRpcServer) -> None:
    async with aiohttp.ClientSession() as session, session.get(server.url) as response:
        assert response.status == 426
        assert "JSON-RPC" in await response.text()
