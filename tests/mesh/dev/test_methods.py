"""The filters of the embedded node, used through web3 and directly."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from web3.exceptions import Web3RPCError

from mesh.chain import Account, Chain, deploy
from mesh.dev import EmbeddedChain
from mesh.dev._evm import MAX_FILTERS
from mesh.dev._rpc import RpcCode, RpcError
from tests.mesh.chain.conftest import QUICK
from tests.support.dev.web3_client import web3_of

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

FRIEND = "0x" + "12" * 20


@pytest.fixture
async def node() -> AsyncIterator[EmbeddedChain]:
    async with EmbeddedChain() as node:
        yield node


@pytest.fixture
async def chain(node: EmbeddedChain) -> AsyncIterator[Chain]:
    """The contracts, for the account that deployed them."""
    deployer = Account(node.funded_keys[0])
    await deploy(node.provider, deployer)
    async with Chain(node.provider, account=deployer, timing=QUICK) as chain:
        yield chain


def values(logs: list[Any]) -> list[int]:
    return [
        int(log["data"], 16) if isinstance(log["data"], str) else int.from_bytes(log["data"], "big") for log in logs
    ]


async def test_web3_filters_return_new_logs_and_blocks(node: EmbeddedChain, chain: Chain) -> None:
    web3: Any = web3_of(node)
    logs = await web3.eth.filter({"address": chain.xrt})
    blocks = await web3.eth.filter("latest")
    for value in (1, 2):
        await chain.tokens.approve(FRIEND, value)
    assert values(await logs.get_new_entries()) == [1, 2]
    assert await logs.get_new_entries() == []
    await chain.tokens.approve(FRIEND, 3)
    assert values(await logs.get_new_entries()) == [3]
    hashes = await blocks.get_new_entries()
    assert [(await web3.eth.get_block(found))["number"] for found in hashes] == [
        await chain.block_number() - back for back in (2, 1, 0)
    ]
    assert await web3.eth.uninstall_filter(logs.filter_id)
    with pytest.raises(Web3RPCError, match="filter not found"):
        await logs.get_new_entries()


async def test_a_filter_from_the_first_block_returns_all_logs(node: EmbeddedChain, chain: Chain) -> None:
    """As the JavaScript of generation 3 lists the lighthouses."""
    name = await node.request("eth_newFilter", [{"address": chain.factory, "fromBlock": "0x0", "toBlock": "latest"}])
    found = await node.request("eth_getFilterLogs", [name])
    [lighthouse] = await chain.lighthouses.list()
    assert found[0]["transactionHash"] == lighthouse.tx
    assert await node.request("eth_getFilterChanges", [name]) == [], "that was before it was made"
    await chain.lighthouses.create(minimal_stake=1, timeout_blocks=1, name="other")
    assert len(await node.request("eth_getFilterChanges", [name])) == 1


async def test_a_filter_from_a_later_block_returns_nothing_before_it(node: EmbeddedChain, chain: Chain) -> None:
    later = await chain.block_number() + 2
    name = await node.request("eth_newFilter", [{"address": chain.xrt, "fromBlock": hex(later)}])
    for value in (1, 2):
        await chain.tokens.approve(FRIEND, value)
    assert values(await node.request("eth_getFilterChanges", [name])) == [2]


async def test_logs_that_replace_reverted_ones_are_new(node: EmbeddedChain, chain: Chain) -> None:
    name = await node.request("eth_newFilter", [{"address": chain.xrt}])
    await chain.tokens.approve(FRIEND, 1)
    assert values(await node.request("eth_getFilterChanges", [name])) == [1]
    await node.request("evm_revert", [hex(await chain.block_number() - 1)])
    assert await node.request("eth_getFilterChanges", [name]) == []
    await chain.tokens.approve(FRIEND, 2)
    assert values(await node.request("eth_getFilterChanges", [name])) == [2]


async def test_the_least_recently_used_filter_is_removed(node: EmbeddedChain) -> None:
    first, second = [await node.request("eth_newBlockFilter", []) for _ in range(2)]
    await node.request("eth_getFilterChanges", [first])
    for _ in range(MAX_FILTERS - 1):
        await node.request("eth_newBlockFilter", [])
    assert await node.request("eth_getFilterChanges", [first]) == []
    with pytest.raises(RpcError) as caught:
        await node.request("eth_getFilterChanges", [second])
    assert (caught.value.code, caught.value.message) == (RpcCode.SERVER_ERROR, "filter not found")


@pytest.mark.parametrize(
    ("method", "params"),
    [
        ("eth_newFilter", ["all"]),
        ("eth_newFilter", [{"topics": 7}]),
        ("eth_getFilterChanges", ["0x77"]),
        ("eth_getFilterLogs", [7]),
    ],
)
async def test_invalid_filters_are_refused(node: EmbeddedChain, method: str, params: list[Any]) -> None:
    with pytest.raises(RpcError):
        await node.request(method, params)
    assert await node.request("eth_uninstallFilter", params) is False


async def test_a_block_filter_has_no_logs(node: EmbeddedChain) -> None:
    name = await node.request("eth_newBlockFilter", [])
    with pytest.raises(RpcError) as caught:
        await node.request("eth_getFilterLogs", [name])
    assert caught.value.code == RpcCode.INVALID_PARAMS


async def test_the_node_signs_for_its_funded_accounts(node: EmbeddedChain) -> None:
    [first, second, *others] = await node.request("eth_accounts", [])
    assert len(others) == 8
    assert first == await node.request("eth_coinbase", [])
    hash_ = await node.request("eth_sendTransaction", [{"from": first, "to": second, "value": "0x5"}])
    transaction = await node.request("eth_getTransactionByHash", [hash_])
    assert (transaction["from"], transaction["to"], transaction["gas"]) == (first, second, hex(21_000))
    given = {"from": first, "to": second, "gas": "0x7530", "gasPrice": "0x77359400", "nonce": "0x1"}
    transaction = await node.request("eth_getTransactionByHash", [await node.request("eth_sendTransaction", [given])])
    assert {name: transaction[name] for name in ("gas", "gasPrice", "nonce")} == {
        name: given[name] for name in ("gas", "gasPrice", "nonce")
    }


async def test_the_node_signs_messages_as_anvil_does(node: EmbeddedChain) -> None:
    first = (await node.request("eth_accounts", []))[0]
    signed = await node.request("eth_sign", [first, "0x11"])
    assert signed == (
        "0x8afa5df03d97e7cd3b15002a4813add96a04fa0bae5650d993b9036d82d73f3c"
        "5b9dba495ff7638c54737ad84375222028faa2d91fbe1b5b6d6298039d7d61171b"
    )
    assert signed == await node.request("personal_sign", ["0x11", first])


@pytest.mark.parametrize(
    ("method", "params"),
    [("eth_sendTransaction", [{"from": FRIEND}]), ("eth_sendTransaction", [{}]), ("eth_sign", [FRIEND, "0x11"])],
)
async def test_the_node_signs_for_no_other_account(node: EmbeddedChain, method: str, params: list[Any]) -> None:
    with pytest.raises(RpcError) as caught:
        await node.request(method, params)
    assert caught.value.code == RpcCode.INVALID_PARAMS
