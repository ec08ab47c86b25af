"""Sending transactions when the connection, the node or the chain fails."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import (
    XRT,
    Account,
    Chain,
    Node,
    TransactionSender,
    TransactionTimeout,
    deploy,
)
from mesh.chain.rpc import HttpTransport
from mesh.dev import EmbeddedChain
from mesh.dev._embedded import EmbeddedProvider
from tests.mesh.chain.conftest import QUICK, reverted, unreachable
from tests.support.chain.senders import unused_address
from tests.support.nodes import Anvil

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable


class _Wire(EmbeddedProvider):
    """The way to an embedded chain, where things happen around the sending of transactions."""

    def __init__(self, chain: EmbeddedChain) -> None:
        super().__init__(chain)
        self.before: Callable[[], Awaitable[object]] | None = None
        self.answers_to_lose = 0
        self.sent = 0

    async def make_request(self, method: str, params: Any) -> Any:
        if method != "eth_sendRawTransaction":
            return await super().make_request(method, params)
        self.sent += 1
        before, self.before = self.before, None
        if before is not None:
            await before()
        response = await super().make_request(method, params)
        if self.answers_to_lose > 0:
            self.answers_to_lose -= 1
            raise ConnectionResetError("the answer was lost")
        return response


@pytest.fixture
async def node() -> AsyncIterator[EmbeddedChain]:
    async with EmbeddedChain() as node:
        yield node


async def test_a_transaction_whose_answer_was_lost_is_mined_once(node: EmbeddedChain) -> None:
    wire, friend = _Wire(node), unused_address()
    async with Node(wire, timing=QUICK) as way:
        sender = TransactionSender(way, Account(node.funded_keys[0]))
        wire.answers_to_lose = 1
        receipt = await sender.send(to=friend, data=b"", value=5)
        assert receipt.block_number == 1
        assert wire.sent == 2
        assert await way.eth_balance(friend) == 5


async def test_a_node_that_is_lost_while_sending_is_an_error(node: EmbeddedChain) -> None:
    wire = _Wire(node)
    async with Node(wire, timing=QUICK) as way:
        sender = TransactionSender(way, Account(node.funded_keys[0]))
        wire.answers_to_lose = 100
        with unreachable("lost"):
            await sender.send(to=unused_address(), data=b"", value=5)


async def test_a_nonce_taken_by_another_client_is_replaced(node: EmbeddedChain) -> None:
    """Even by the very same transaction, byte for byte: it is another one all the same."""
    wire, friend = _Wire(node), unused_address()
    account = Account(node.funded_keys[0])
    async with Node(wire, timing=QUICK) as one, Node(node.provider, timing=QUICK) as other:
        wire.before = lambda: TransactionSender(other, account).send(to=friend, data=b"", value=5)
        await TransactionSender(one, account).send(to=friend, data=b"", value=5)
        assert await one.eth_balance(friend) == 10


async def test_a_transaction_that_fails_only_when_mined_has_its_reason(node: EmbeddedChain) -> None:
    """Another account takes the tokens between the simulation and the block."""
    wire = _Wire(node)
    deployer, friend = (Account(key) for key in node.funded_keys[:2])
    deployment = await deploy(node.provider, deployer)
    async with (
        Chain(wire, account=friend, timing=QUICK) as chain,
        Chain(node.provider, account=deployer, timing=QUICK) as rival,
    ):
        await rival.tokens.transfer(friend.address, XRT)
        await chain.tokens.approve(deployer.address, XRT)
        wire.before = lambda: rival.tokens.transfer_from(friend.address, deployer.address, XRT)
        with reverted("ERC20InsufficientBalance") as caught:
            await chain.tokens.transfer(deployment.factory, XRT)
        assert caught.value.arguments == (friend.address, 0, XRT)


async def test_concurrent_transactions_of_one_node_get_different_nonces(node: EmbeddedChain) -> None:
    wire, friend = _Wire(node), unused_address()
    account = Account(node.funded_keys[0])
    async with Node(wire, timing=QUICK) as way:
        await asyncio.gather(*(TransactionSender(way, account).send(to=friend, data=b"", value=1) for _ in range(10)))
        assert await way.eth_balance(friend) == 10
    assert wire.sent == 10


async def test_senders_of_one_node_fill_a_block_together() -> None:
    """On a chain that makes blocks by time, many transactions of an account wait at once, each with its number."""
    friend = unused_address()
    async with Anvil(arguments=("--block-time", "1")) as anvil, Node(anvil.url, timing=QUICK) as node:
        account = Account(anvil.private_keys[0])
        senders = [TransactionSender(node, account) for _ in range(3)]
        receipts = await asyncio.gather(*(sender.send(to=friend, data=b"", value=1) for sender in senders * 5))
        assert await node.eth_balance(friend) == 15
        assert len({receipt.block_number for receipt in receipts}) < 15


class _Forgetful(HttpTransport):
    """A node behind a balancer: the one that counts has not heard of what another was given."""

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_getTransactionCount":
            params = [params[0], "latest"]
        return await super().make_request(method, params)


async def test_nonces_continue_when_the_node_does_not_count_pending_transactions() -> None:
    friend = unused_address()
    async with Anvil(arguments=("--block-time", "1")) as anvil:
        forgetful = _Forgetful(anvil.url)
        async with Node(forgetful, timing=QUICK) as node:
            sender = TransactionSender(node, Account(anvil.private_keys[0]))
            await asyncio.gather(*(sender.send(to=friend, data=b"", value=value) for value in (1, 2, 4)))
            assert await node.eth_balance(friend) == 7
        await forgetful.close()


async def test_a_transaction_that_is_not_mined_times_out_and_keeps_its_nonce() -> None:
    timing = replace(QUICK, receipt_timeout=0.1)
    friend = unused_address()
    async with Anvil(arguments=("--no-mining",)) as anvil, Node(anvil.url, timing=timing) as node:
        sender = TransactionSender(node, Account(anvil.private_keys[0]))
        with pytest.raises(TransactionTimeout) as caught:
            await sender.send(to=friend, data=b"", value=1)
        assert caught.value.tx.startswith("0x")
        assert caught.value.hint
        with pytest.raises(TransactionTimeout):
            await sender.send(to=friend, data=b"", value=2)
        await node.request("evm_mine")
        assert await node.eth_balance(friend) == 3


async def test_the_nonce_of_a_dropped_transaction_is_used_again() -> None:
    friend = unused_address()
    async with (
        Anvil(arguments=("--no-mining",)) as anvil,
        Node(anvil.url, timing=replace(QUICK, receipt_timeout=0.1)) as node,
    ):
        sender = TransactionSender(node, Account(anvil.private_keys[0]))
        with pytest.raises(TransactionTimeout) as dropped:
            await sender.send(to=friend, data=b"", value=1)
        await node.request("anvil_dropTransaction", dropped.value.tx)
        with pytest.raises(TransactionTimeout):
            await sender.send(to=friend, data=b"", value=2)
        await node.request("evm_mine")
        assert await node.eth_balance(friend) == 2


async def test_a_chain_without_a_base_fee_is_paid_by_gas_price() -> None:
    arguments = ("--hardfork", "berlin", "--gas-price", "1000000000")
    friend = unused_address()
    async with Anvil(arguments=arguments) as anvil, Node(anvil.url, timing=QUICK) as node:
        await TransactionSender(node, Account(anvil.private_keys[0])).send(to=friend, data=b"", value=1)
        assert await node.eth_balance(friend) == 1


async def test_cancelling_does_not_block_the_next_transaction(node: EmbeddedChain) -> None:
    wire, friend = _Wire(node), unused_address()
    reached = asyncio.Event()

    async def hang() -> None:
        reached.set()
        await asyncio.Event().wait()

    async with Node(wire, timing=QUICK) as way:
        sender = TransactionSender(way, Account(node.funded_keys[0]))
        wire.before = hang
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=1))
        await reached.wait()
        sending.cancel()
        with pytest.raises(asyncio.CancelledError):
            await sending
        await sender.send(to=friend, data=b"", value=2)
        assert await way.eth_balance(friend) == 2


async def test_a_transaction_that_one_node_may_have_is_remembered_when_another_refuses_it(node: EmbeddedChain) -> None:
    """Else it could be sent again with another nonce, and both be mined."""

    class Nodes(EmbeddedProvider):
        asked = 0

        async def make_request(self, method: str, params: Any) -> Any:
            if method != "eth_sendRawTransaction":
                return await super().make_request(method, params)
            self.asked += 1
            if self.asked == 1:
                raise ConnectionResetError("the answer was lost")
            return {"jsonrpc": "2.0", "id": 1, "error": {"code": -32000, "message": "txpool is full"}}

    account = Account(node.funded_keys[0])
    async with Node(Nodes(node), timing=QUICK) as way:
        with unreachable("txpool is full"):
            await TransactionSender(way, account).send(to=unused_address(), data=b"", value=5)
        assert len(way.pending_transactions(account.address).abandoned) == 1
