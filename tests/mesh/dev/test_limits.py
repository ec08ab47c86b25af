"""What a client may ask a development chain for: gas, time, blocks, logs, filters, subscriptions, batches."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import aiohttp
import pytest

from mesh.chain import Account
from mesh.dev import EmbeddedChain, JsonRpcServer
from mesh.dev._evm import GAS_LIMIT, MAX_MINED_BLOCKS
from mesh.dev._rpc import SOCKET_LIMITS, RpcCode, RpcError
from tests.support.dev.websockets import connected, node, server

if TYPE_CHECKING:
    from collections.abc import Awaitable

__all__ = ["node", "server"]

ENDLESS = "0x5b600056"
"""JUMPDEST, PUSH1 0, JUMP: as the code of a contract's creation."""


async def refusal(request: Awaitable[Any]) -> RpcError:
    with pytest.raises(RpcError) as caught:
        await request
    return caught.value


@pytest.mark.parametrize("method", ["eth_call", "eth_estimateGas"])
async def test_other_requests_are_answered_during_an_endless_call(method: str) -> None:
    async with EmbeddedChain(run_seconds=1.0) as node:
        endless = [asyncio.create_task(node.request(method, [{"data": ENDLESS}])) for _ in range(3)]
        assert await node.request("eth_blockNumber", []) == "0x0"
        await node.mine(3)
        assert await node.request("eth_blockNumber", []) == "0x3"
        assert not all(call.done() for call in endless)
        for call in endless:
            assert (await refusal(call)).code == RpcCode.SERVER_ERROR


@pytest.mark.parametrize("precompile", ["08", "0c", "0e", "0f"])
async def test_a_long_pairing_is_refused(node: EmbeddedChain, precompile: str) -> None:
    """No loop of the EVM, and a second and more for each pair."""
    call = {"to": "0x" + precompile.rjust(40, "0"), "data": "0x" + "00" * 384 * 20}
    refused = await refusal(node.request("eth_call", [call]))
    assert (refused.code, refused.message) == (RpcCode.SERVER_ERROR, "execution aborted (timeout = 5s)")
    short = await node.request("eth_call", [{"to": "0x" + "08".rjust(40, "0"), "data": "0x" + "00" * 384}])
    assert int(short, 16) == 1


async def test_a_call_gets_no_more_gas_than_a_block_has(node: EmbeddedChain) -> None:
    gas_left = "0x5a60005260206000f3"  # GAS, PUSH1 0, MSTORE, PUSH1 32, PUSH1 0, RETURN
    answer = await node.request("eth_call", [{"data": gas_left, "gas": hex(2**60)}])
    assert GAS_LIMIT * 0.9 < int(answer, 16) < GAS_LIMIT


async def test_a_transaction_that_runs_too_long_is_refused_and_the_chain_goes_on() -> None:
    async with EmbeddedChain(run_seconds=0.2) as node:
        account = Account(node.funded_keys[0])
        fields = {"chainId": int(await node.request("eth_chainId", []), 16), "nonce": 0, "value": 0}
        fields |= {"maxFeePerGas": 3 * 10**9, "maxPriorityFeePerGas": 1}
        endless = account.sign_transaction(fields | {"gas": GAS_LIMIT, "to": b"", "data": ENDLESS})
        refused = await refusal(node.request("eth_sendRawTransaction", ["0x" + endless.raw.hex()]))
        assert (refused.code, refused.message) == (RpcCode.SERVER_ERROR, "execution aborted (timeout = 0.2s)")
        assert await node.request("eth_blockNumber", []) == "0x0"
        simple = account.sign_transaction(fields | {"gas": 21_000, "to": account.address, "data": b""})
        await node.request("eth_sendRawTransaction", ["0x" + simple.raw.hex()])
        assert (await node.request("eth_getTransactionReceipt", [simple.hash]))["status"] == "0x1"


async def test_a_transaction_with_more_gas_than_a_block_is_refused(node: EmbeddedChain) -> None:
    account = Account(node.funded_keys[0])
    fields = {"chainId": int(await node.request("eth_chainId", []), 16), "nonce": 0, "value": 0, "data": b""}
    fields |= {"maxFeePerGas": 3 * 10**9, "maxPriorityFeePerGas": 1, "to": account.address, "gas": GAS_LIMIT + 1}
    raw = "0x" + account.sign_transaction(fields).raw.hex()
    refused = await refusal(node.request("eth_sendRawTransaction", [raw]))
    assert (refused.code, refused.message) == (RpcCode.SERVER_ERROR, "exceeds block gas limit")


@pytest.mark.parametrize("blocks", [MAX_MINED_BLOCKS + 1, 0x5000, 2**256])
async def test_only_so_many_blocks_are_mined_at_once(node: EmbeddedChain, blocks: int) -> None:
    assert (await refusal(node.request("evm_mine", [hex(blocks)]))).code == RpcCode.INVALID_PARAMS
    assert await node.request("eth_blockNumber", []) == "0x0"


async def test_other_requests_are_answered_while_blocks_are_mined(node: EmbeddedChain) -> None:
    mining = asyncio.create_task(node.mine(MAX_MINED_BLOCKS))
    while int(await node.request("eth_blockNumber", []), 16) == 0:
        pass
    assert not mining.done()
    await mining
    assert await node.request("eth_blockNumber", []) == hex(MAX_MINED_BLOCKS)


@pytest.mark.parametrize(
    "query",
    [
        {"address": ["0x" + "11" * 20] * 1_001},
        {"topics": [None] * 5},
        {"topics": [["0x" + "11" * 32] * 1_001]},
        {"fromBlock": "0x2", "toBlock": "0x1"},
    ],
)
@pytest.mark.parametrize("method", ["eth_getLogs", "eth_newFilter"])
async def test_a_query_of_logs_is_bounded(node: EmbeddedChain, method: str, query: dict[str, Any]) -> None:
    await node.mine(3)
    assert (await refusal(node.request(method, [query]))).code == RpcCode.INVALID_PARAMS


async def test_more_logs_than_a_response_may_have_are_refused() -> None:
    async with EmbeddedChain(max_logs=2) as node:
        await log_times(node, 3)
        refused = await refusal(node.request("eth_getLogs", [{"fromBlock": "0x1"}]))
        assert (refused.code, refused.message) == (RpcCode.LIMIT_EXCEEDED, "query returned more than 2 results")
        assert len(await node.request("eth_getLogs", [{"fromBlock": "0x2"}])) == 2


async def test_a_filter_with_more_changes_than_a_response_may_have_returns_them_in_parts() -> None:
    async with EmbeddedChain(max_logs=2) as node:
        logs = await node.request("eth_newFilter", [{}])
        blocks = await node.request("eth_newBlockFilter", [])
        await log_times(node, 3)
        for name, all_of_them in ((logs, 3), (blocks, 3)):
            assert len(await node.request("eth_getFilterChanges", [name])) == 2
            assert len(await node.request("eth_getFilterChanges", [name])) == all_of_them - 2
            assert await node.request("eth_getFilterChanges", [name]) == []


async def log_times(node: EmbeddedChain, times: int) -> None:
    """Mine that many blocks with one log each."""
    account = (await node.request("eth_accounts", []))[0]
    for _ in range(times):
        await node.request("eth_sendTransaction", [{"from": account, "data": "0x60006000a0"}])


async def test_too_many_requests_at_once_are_refused() -> None:
    async with EmbeddedChain(max_requests=3, run_seconds=0.2) as node:
        endless = [asyncio.create_task(node.request("eth_call", [{"data": ENDLESS}])) for _ in range(3)]
        await asyncio.sleep(0)
        assert (await refusal(node.request("eth_blockNumber", []))).code == RpcCode.LIMIT_EXCEEDED
        await asyncio.gather(*endless, return_exceptions=True)
        assert await node.request("eth_blockNumber", []) == "0x0"


async def test_a_batch_has_a_bounded_response(node: EmbeddedChain) -> None:
    code = "0x" + "00" * 20
    large = {"jsonrpc": "2.0", "method": "web3_sha3", "params": [code]}
    async with (
        JsonRpcServer(node.provider, max_response_bytes=300) as server,
        aiohttp.ClientSession() as session,
        session.post(server.url, json=[large | {"id": number} for number in range(10)]) as response,
    ):
        answers = await response.json()
    assert [answer["id"] for answer in answers] == list(range(10))
    assert "result" in answers[0]
    assert [answer["error"]["code"] for answer in answers[4:]] == [RpcCode.RESPONSE_TOO_LARGE] * 6


async def test_a_connection_has_only_so_many_subscriptions(server: JsonRpcServer) -> None:
    async with connected(server) as client:
        ids = [await client.subscribe("newHeads") for _ in range(SOCKET_LIMITS.subscriptions)]
        assert (await client.ask("eth_subscribe", "newHeads"))["error"]["code"] == RpcCode.LIMIT_EXCEEDED
        await client.ask("eth_unsubscribe", ids[0])
        assert await client.subscribe("newHeads") not in ids


async def test_only_so_many_sockets_are_open_at_once(server: JsonRpcServer) -> None:
    async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)) as session:
        sockets = [await session.ws_connect(server.ws_url) for _ in range(SOCKET_LIMITS.connections)]
        with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
            await session.ws_connect(server.ws_url)
        assert caught.value.status == 503
        for socket in sockets:
            await socket.close()
