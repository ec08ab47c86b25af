"""Fees, and the ceiling for them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import GWEI, Account, FeePolicy, FeeTooHigh, Node, TransactionSender
from mesh.chain._node import Fees
from mesh.chain.rpc import HttpTransport
from tests.mesh.chain.conftest import QUICK
from tests.support.chain.senders import unused_address
from tests.support.nodes import Anvil

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


@pytest.fixture
async def anvil() -> AsyncIterator[Anvil]:
    async with Anvil() as anvil:
        yield anvil


def _sender(node: Node, anvil: Anvil) -> TransactionSender:
    return TransactionSender(node, Account(anvil.private_keys[0]))


async def _next_base_fee(node: Node, wei: int) -> None:
    await node.request("anvil_setNextBlockBaseFeePerGas", hex(wei))
    await node.request("evm_mine")


async def test_above_the_ceiling_nothing_is_sent(anvil: Anvil) -> None:
    async with Node(anvil.url, timing=QUICK, fees=FeePolicy(ceiling=20 * GWEI)) as node:
        sender, friend = _sender(node, anvil), unused_address()
        await _next_base_fee(node, 30 * GWEI)
        with pytest.raises(FeeTooHigh) as caught:
            await sender.send(to=friend, data=b"", value=1)
        assert (caught.value.price, caught.value.ceiling) == (31 * GWEI, 20 * GWEI)
        assert caught.value.hint
        assert await node.transaction_count(sender.account.address, block="pending") == 0


async def test_never_more_than_the_ceiling_is_offered(anvil: Anvil) -> None:
    async with Node(anvil.url, timing=QUICK, fees=FeePolicy(ceiling=25 * GWEI)) as node:
        await _next_base_fee(node, 20 * GWEI)
        receipt = await _sender(node, anvil).send(to=unused_address(), data=b"", value=1)
        sent = await node.request("eth_getTransactionByHash", receipt.tx)
    assert int(sent["maxFeePerGas"], 16) == 25 * GWEI
    assert int(sent["type"], 16) == 2


async def test_a_replacement_offers_the_fees_that_nodes_require_or_is_not_made(anvil: Anvil) -> None:
    async with Node(anvil.url, timing=QUICK) as node:
        policy, market = FeePolicy(ceiling=100 * GWEI), await node.gas_market()
        bumped = policy.replacement(market, Fees(50 * GWEI, 7))
        assert bumped == Fees(575 * GWEI // 10, GWEI), "the priority fee goes to the market's price at least"
        assert policy.replacement(market, Fees(90 * GWEI, 2 * GWEI)) == Fees(100 * GWEI, 23 * GWEI // 10)
        assert policy.replacement(market, Fees(91 * GWEI, 2 * GWEI)) is None
        assert policy.replacement(market, Fees(10 * GWEI, None)) == Fees(115 * GWEI // 10, None)
        cheap = replace(policy, ceiling=GWEI // 2).replacement(market, Fees(1, 1))
        assert cheap == Fees(GWEI // 2, GWEI // 2), "the priority fee is never above the whole"


class _Plain(HttpTransport):
    """A node that lacks a word for priority fees."""

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_maxPriorityFeePerGas":
            return {"jsonrpc": "2.0", "id": 1, "error": {"code": -32601, "message": "the method does not exist"}}
        return await super().make_request(method, params)


async def test_without_a_suggested_priority_fee_the_gas_price_is_used(anvil: Anvil) -> None:
    wire = _Plain(anvil.url)
    async with Node(wire, timing=QUICK) as node:
        base = (await node.heads.look()).base_fee or 0
        price = await node.gas_price()
        receipt = await _sender(node, anvil).send(to=unused_address(), data=b"", value=1)
        sent = await node.request("eth_getTransactionByHash", receipt.tx)
    assert int(sent["maxPriorityFeePerGas"], 16) == price - base
    assert int(sent["maxFeePerGas"], 16) == base + price
    await wire.close()
