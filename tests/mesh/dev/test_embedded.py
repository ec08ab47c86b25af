"""The embedded chain, used through web3."""

from __future__ import annotations

import asyncio
import threading
import time
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest
from hexbytes import HexBytes
from web3.exceptions import Web3RPCError

from mesh.chain import Account
from mesh.dev import EmbeddedChain
from mesh.dev.development import deploy_market
from tests.support.dev.web3_client import web3_of

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from web3 import AsyncWeb3

# PUSH1 size, PUSH1 offset of the rest, PUSH1 0, CODECOPY, PUSH1 size, PUSH1 0, RETURN: deploys what follows.
DEPLOYER = "60{size:02x}600c60003960{size:02x}6000f3"
# Reverts with the four bytes 0xdeadbeef.
REFUSES = "63deadbeef60e01b60005260046000fd"
# Logs its first word of input under the topic 0x11…11, and returns it.
LOGS = "6000356000527f" + "11" * 32 + "60206000a160206000f3"
# Touches memory far out, which takes some 140,000 gas.
COSTLY = "6203d0905100"
# Calls itself with all the gas that may be passed on.
CALLS_ITSELF = "6000600060006000600030" + "5af100"
# Calls the address in its first word of input with the rest of it and all the gas that may be passed on, and reverts if
# that fails.
CALLS = "60203603602060003760006000602036036000600060003" + "55af1602257" + "60006000fd5b00"


@pytest.fixture
async def node() -> AsyncIterator[EmbeddedChain]:
    async with EmbeddedChain() as node:
        yield node


async def _send(web3: AsyncWeb3[Any], key: bytes, **fields: Any) -> Any:
    account = Account(key)
    fields = {
        "nonce": await web3.eth.get_transaction_count(account.address),  # type: ignore[arg-type]
        "chainId": await web3.eth.chain_id,
        "gas": 300_000,
        "maxFeePerGas": 3 * 10**9,
        "maxPriorityFeePerGas": 1,
        "value": 0,
        "data": b"",
        "to": b"",
    } | fields
    signed = account.sign_transaction(fields)
    assert "0x" + (await web3.eth.send_raw_transaction(signed.raw)).hex().removeprefix("0x") == signed.hash
    return await web3.eth.get_transaction_receipt(signed.hash)  # type: ignore[arg-type]


async def _deploy(web3: AsyncWeb3[Any], key: bytes, code: str) -> str:
    data = bytes.fromhex(DEPLOYER.format(size=len(code) // 2) + code)
    receipt = await _send(web3, key, data=data)
    assert receipt["status"] == 1
    return str(receipt["contractAddress"])


async def test_each_transaction_is_mined_in_a_block_of_its_own(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    to = Account(node.funded_keys[1]).address
    first = await _send(web3, node.funded_keys[0], to=to, value=5)
    second = await _send(web3, node.funded_keys[0], to=to, value=7)
    assert (first["blockNumber"], second["blockNumber"], await web3.eth.block_number) == (1, 2, 2)
    assert await web3.eth.get_balance(to, 1) == 10**24 + 5  # type: ignore[arg-type]
    assert await web3.eth.get_balance(to) == 10**24 + 12  # type: ignore[arg-type]
    block = await web3.eth.get_block(2, full_transactions=True)
    assert [dict(tx)["hash"] for tx in block["transactions"]] == [second["transactionHash"]]  # type: ignore[arg-type]
    assert abs(block["timestamp"] - time.time()) < 60


async def test_a_block_has_the_time_at_which_it_was_mined(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    wanted = (await web3.eth.get_block("latest"))["timestamp"] + 2
    while time.time() < wanted:
        await asyncio.sleep(0.05)
    await _send(web3, node.funded_keys[0], to=Account(node.funded_keys[1]).address)
    assert (await web3.eth.get_block("latest"))["timestamp"] >= wanted


async def _times(node: EmbeddedChain) -> list[int]:
    """The times of all blocks."""
    head = int(await node.request("eth_blockNumber", []), 16)
    blocks = [await node.request("eth_getBlockByNumber", [hex(number), False]) for number in range(head + 1)]
    return [int(block["timestamp"], 16) for block in blocks]


async def test_the_clock_of_the_chain_is_right_once_a_market_is_deployed(node: EmbeddedChain) -> None:
    await deploy_market(node.provider, node.funded_keys)
    times = await _times(node)
    assert -10 < times[-1] - time.time() <= 1
    assert all(after > before for before, after in pairwise(times))


async def test_the_chain_waits_for_the_clock_after_many_transactions() -> None:
    async with EmbeddedChain(block_time=1.0) as node:
        await node.mine(4)
        ahead = (await _times(node))[-1]
        assert ahead - time.time() > 2
        async with asyncio.timeout(30):
            while (last := (await _times(node))[-1]) == ahead:
                assert time.time() < ahead + 3
                await asyncio.sleep(0.05)
        assert last - time.time() <= 1


async def test_blocks_and_their_logs_are_found_by_hash(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    contract = await _deploy(web3, node.funded_keys[0], LOGS)
    receipt = await _send(web3, node.funded_keys[0], to=contract, data=b"\5".rjust(32, b"\0"))
    block = await web3.eth.get_block(receipt["blockHash"])
    assert (block["number"], block["transactions"]) == (2, [receipt["transactionHash"]])
    assert [log["logIndex"] for log in await web3.eth.get_logs({"blockHash": block["hash"]})] == [0]
    with pytest.raises(Web3RPCError, match="unknown block"):
        await web3.eth.get_logs({"blockHash": HexBytes("0x" + "77" * 32)})
    transaction = await web3.eth.get_transaction(receipt["transactionHash"])
    assert (transaction["to"], transaction["blockNumber"]) == (contract, 2)


async def test_storage_and_code_are_read_at_any_block(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    stores_42 = bytes.fromhex("602a600055" + "60006000f3")
    address = (await _send(web3, node.funded_keys[0], data=stores_42))["contractAddress"]
    assert int.from_bytes(await web3.eth.get_storage_at(address, 0)) == 42
    assert int.from_bytes(await web3.eth.get_storage_at(address, 0, 0)) == 0
    assert await web3.eth.get_code(address) == b""
    assert len(await web3.eth.get_code(address, "earliest")) == 0


async def test_running_out_of_gas_has_its_own_error(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    contract = await _deploy(web3, node.funded_keys[0], COSTLY)
    with pytest.raises(Web3RPCError, match="OutOfGas"):
        await web3.eth.call({"to": contract, "gas": 30_000})


async def test_the_funded_accounts_are_those_of_other_development_chains(node: EmbeddedChain) -> None:
    assert Account(node.funded_keys[0]).address == "0xf39Fd6e51aad88F6F4ce6aB8827279cffFb92266"
    assert len(set(node.funded_keys)) == 10


async def test_blocks_are_mined_on_demand(node: EmbeddedChain) -> None:
    await node.mine(3)
    assert await web3_of(node).eth.block_number == 3


async def test_each_block_is_pushed_before_its_transaction_is_answered(node: EmbeddedChain) -> None:
    heads: list[int] = []

    def push(head: Any) -> None:
        heads.append(int(head["number"], 16))

    node.push_heads(push)
    await node.mine(2)
    assert heads == [2]
    await node.request("eth_sendTransaction", [{"from": Account(node.funded_keys[0]).address}])
    assert heads == [2, 3]
    node.push_heads(push)
    await node.request("eth_blockNumber", [])
    node.end_pushes(push)
    await node.mine()
    assert heads == [2, 3]
    node.push_heads(push)
    await node.request("eth_blockNumber", [])
    assert heads == [2, 3, 4]


async def test_blocks_are_mined_with_a_block_time() -> None:
    async with EmbeddedChain(block_time=0.01) as node:
        web3 = web3_of(node)
        async with asyncio.timeout(60):
            while await web3.eth.block_number < 3:
                await asyncio.sleep(0.01)


async def test_revert_data_reaches_the_caller_of_calls_and_estimates(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    contract = await _deploy(web3, node.funded_keys[0], REFUSES)
    for method in ("eth_call", "eth_estimateGas"):
        answer = await node.provider.make_request(method, [{"to": contract}])
        assert answer["error"]["data"] == "0xdeadbeef"
        assert answer["error"]["code"] == 3


async def test_a_transaction_that_reverts_is_mined_as_failed(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    contract = await _deploy(web3, node.funded_keys[0], REFUSES)
    receipt = await _send(web3, node.funded_keys[0], to=contract)
    assert receipt["status"] == 0
    assert receipt["gasUsed"] < 30_000


async def test_a_contract_that_calls_itself_without_end_is_an_error(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    contract = await _deploy(web3, node.funded_keys[0], CALLS_ITSELF)
    with pytest.raises(Web3RPCError, match="too deep"):
        await web3.eth.call({"to": contract})
    with pytest.raises(Web3RPCError, match="too deep"):
        await _send(web3, node.funded_keys[0], to=contract, gas=29_000_000)
    assert await web3.eth.block_number == 1
    to = Account(node.funded_keys[1]).address
    assert (await _send(web3, node.funded_keys[0], to=to, value=3))["status"] == 1
    assert await web3.eth.get_balance(to) == 10**24 + 3  # type: ignore[arg-type]


async def test_a_plain_transfer_is_estimated_exactly(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    address = Account(node.funded_keys[0]).address
    assert await web3.eth.estimate_gas({"from": address, "to": address, "value": 1}) == 21_000  # type: ignore[typeddict-item]


async def test_an_estimate_is_enough_and_not_much_more(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    contract = await _deploy(web3, node.funded_keys[0], LOGS)
    data = "0x" + "22" * 32
    gas = await web3.eth.estimate_gas({"to": contract, "data": data})  # type: ignore[typeddict-item]
    receipt = await _send(web3, node.funded_keys[0], to=contract, data=data, gas=gas)
    assert receipt["status"] == 1
    assert gas <= receipt["gasUsed"] * 1.1


@pytest.mark.parametrize("depth", [1, 3])
async def test_an_estimate_counts_the_gas_that_inner_calls_hold_back(
    node: EmbeddedChain, monkeypatch: pytest.MonkeyPatch, depth: int
) -> None:
    from mesh.dev._evm import Calls

    runs = list[int]()
    run = Calls._run

    def counted(calls: Calls, fields: dict[str, Any], height: int, *, gas: int) -> object:
        runs.append(gas)
        return run(calls, fields, height, gas=gas)

    web3 = web3_of(node)
    inner = await _deploy(web3, node.funded_keys[0], COSTLY)
    outer = [await _deploy(web3, node.funded_keys[0], CALLS) for _ in range(depth)]
    data = "0x" + "".join(address[2:].rjust(64, "0") for address in (*outer[1:], inner))
    monkeypatch.setattr(Calls, "_run", counted)
    gas = await web3.eth.estimate_gas({"to": outer[0], "data": data})  # type: ignore[typeddict-item]
    assert len(runs) <= 4  # each takes as long as the transaction
    receipt = await _send(web3, node.funded_keys[0], to=outer[0], data=data, gas=gas)
    assert receipt["status"] == 1
    assert receipt["gasUsed"] < gas <= receipt["gasUsed"] * 1.1
    assert (await _send(web3, node.funded_keys[0], to=outer[0], data=data, gas=receipt["gasUsed"]))["status"] == 0


async def test_logs_are_found_by_range_address_and_topic(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    contract, other = [await _deploy(web3, node.funded_keys[0], LOGS) for _ in range(2)]
    for number, where in enumerate((contract, other, contract)):
        await _send(web3, node.funded_keys[0], to=where, data=number.to_bytes(32, "big"))

    async def find(**query: Any) -> list[int]:
        return [int.from_bytes(log["data"], "big") for log in await web3.eth.get_logs(query)]  # type: ignore[arg-type]

    topic = "0x" + "11" * 32
    assert await find(fromBlock=0, toBlock="latest") == [0, 1, 2]
    assert await find(fromBlock=0, address=contract) == [0, 2]
    assert await find(fromBlock=0, address=[contract, other]) == [0, 1, 2]
    assert await find(fromBlock=4, toBlock=4) == [1]
    assert await find(fromBlock=0, toBlock=10**6, topics=[topic]) == [0, 1, 2]
    assert await find(fromBlock=0, topics=[["0x" + "33" * 32, topic]]) == [0, 1, 2]
    assert await find(fromBlock=0, topics=[None]) == [0, 1, 2]
    assert await find(fromBlock=0, topics=["0x" + "33" * 32]) == []
    assert await find(fromBlock=0, topics=[topic, topic]) == []
    assert await find() == [2]


@pytest.mark.parametrize(("nonce", "word"), [(0, "nonce too low"), (9, "nonce too high")])
async def test_a_wrong_nonce_is_refused_and_changes_nothing(node: EmbeddedChain, nonce: int, word: str) -> None:
    web3 = web3_of(node)
    to = Account(node.funded_keys[1]).address
    await _send(web3, node.funded_keys[0], to=to)
    with pytest.raises(Web3RPCError, match=word):
        await _send(web3, node.funded_keys[0], to=to, nonce=nonce, value=1)
    assert await web3.eth.block_number == 1
    assert (await _send(web3, node.funded_keys[0], to=to))["status"] == 1


async def test_the_same_transaction_twice_is_already_known(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    to = Account(node.funded_keys[1]).address
    await _send(web3, node.funded_keys[0], to=to, nonce=0)
    with pytest.raises(Web3RPCError, match="already known"):
        await _send(web3, node.funded_keys[0], to=to, nonce=0)


async def test_a_transaction_without_funds_is_refused(node: EmbeddedChain) -> None:
    web3 = web3_of(node)
    with pytest.raises(Web3RPCError, match="insufficient funds"):
        await _send(web3, b"\7" * 32, to=Account(node.funded_keys[1]).address)


async def test_an_invalid_transaction_is_refused(node: EmbeddedChain) -> None:
    with pytest.raises(Web3RPCError, match="be decoded"):
        await web3_of(node).eth.send_raw_transaction(b"\xc3\1\2\3")


def chain_threads() -> set[int | None]:
    """The threads of this node, and of others that live as long as the run."""
    return {thread.ident for thread in threading.enumerate() if "embedded-chain" in thread.name}


async def test_the_event_loop_is_not_blocked_by_the_chain(node: EmbeddedChain) -> None:
    ticks, before = 0, chain_threads()

    async def tick() -> None:
        nonlocal ticks
        while True:
            ticks += 1
            await asyncio.sleep(0)

    ticking = asyncio.create_task(tick())
    await asyncio.gather(*(node.mine(50) for _ in range(4)))
    ticking.cancel()
    assert ticks >= 5
    assert chain_threads() == before
