"""Waiting for transactions: stuck, replaced, lost and confirmed ones."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import GWEI, Account, FeePolicy, Node, NodeUnreachable, TransactionSender, TransactionTimeout
from mesh.chain.rpc import HttpTransport
from tests.mesh.chain.conftest import QUICK
from tests.support.chain.senders import SHORT, anvil, make_too_cheap, open_sender, until_pending, unused_address

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.nodes import Anvil

__all__ = ["anvil"]


async def test_a_stuck_transaction_is_replaced_with_higher_fees_and_takes_effect_once(anvil: Anvil) -> None:
    async with open_sender(anvil, replace(QUICK, replace_after=0.1)) as (node, sender):
        friend = unused_address()
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        first, offered = await make_too_cheap(node)
        async with asyncio.timeout(60):
            while not sending.done():
                await node.request("evm_mine")
                await asyncio.sleep(0.05)
        receipt = await sending
        paid = await node.request("eth_getTransactionByHash", receipt.tx)
        assert receipt.tx != first
        assert int(paid["maxFeePerGas"], 16) > offered
        assert await node.eth_balance(friend) == 5


class _Swallowing(HttpTransport):
    """A node that takes one transaction, and of others only says so."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.taken = False
        self.swallowed: list[str] = []

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_sendRawTransaction":
            taken, self.taken = self.taken, True
            if not taken:
                return await super().make_request(method, params)
            self.swallowed.append(params[0])
            return {"jsonrpc": "2.0", "id": 1, "result": "0x" + "00" * 32}
        return await super().make_request(method, params)


async def test_the_replaced_version_may_be_the_one_that_is_mined(anvil: Anvil) -> None:
    wire, friend = _Swallowing(anvil.url), unused_address()
    async with Node(wire, timing=replace(QUICK, replace_after=0.05)) as node:
        sending = asyncio.create_task(
            TransactionSender(node, Account(anvil.private_keys[0])).send(to=friend, data=b"", value=5)
        )
        first = (await until_pending(node, 1))[0]
        async with asyncio.timeout(60):
            while not wire.swallowed:
                await asyncio.sleep(0.01)
        await node.request("evm_mine")
        assert (await sending).tx == first
        assert await node.eth_balance(friend) == 5
    await wire.close()


async def test_at_the_ceiling_the_same_transaction_is_sent_again_to_a_node_that_lost_it(anvil: Anvil) -> None:
    timing = replace(QUICK, replace_after=0.2)
    async with open_sender(anvil, timing, fees=FeePolicy(ceiling=3 * GWEI)) as (node, sender):
        friend = unused_address()
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        first = (await until_pending(node, 1))[0]
        await node.request("anvil_dropTransaction", first)
        assert await until_pending(node, 1) == {0: first}
        await node.request("evm_mine")
        assert (await sending).tx == first


async def test_a_transaction_waits_for_its_confirmations(anvil: Anvil) -> None:
    async with open_sender(anvil, replace(QUICK, confirmations=3)) as (node, sender):
        sending = asyncio.create_task(sender.send(to=unused_address(), data=b"", value=5))
        await until_pending(node, 1)
        for _ in range(2):
            await node.request("evm_mine")
        await asyncio.sleep(10 * QUICK.poll_interval)
        assert not sending.done()
        await node.request("evm_mine")
        receipt = await sending
        assert await node.block_number() == receipt.block_number + 2


async def test_a_transaction_whose_block_was_replaced_is_sent_again(anvil: Anvil) -> None:
    async with open_sender(anvil, replace(QUICK, confirmations=3)) as (node, sender):
        friend = unused_address()
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        first = (await until_pending(node, 1))[0]
        for _ in range(2):
            await node.request("evm_mine")
        await asyncio.sleep(10 * QUICK.poll_interval)
        await node.request("anvil_reorg", 2, [])
        assert await node.eth_balance(friend) == 0
        assert await until_pending(node, 1) == {0: first}
        for _ in range(3):
            await node.request("evm_mine")
        assert (await sending).block_number == 3
        assert await node.eth_balance(friend) == 5


class _Recording(HttpTransport):
    """A node whose transactions are kept."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.sent: list[str] = []

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_sendRawTransaction":
            self.sent.append(params[0])
        return await super().make_request(method, params)


@pytest.mark.parametrize("kept", [False, True])
async def test_a_confirmed_transaction_that_a_reorganisation_left_in_the_pool_is_replaced(
    anvil: Anvil, tmp_path: Path, kept: bool
) -> None:
    wire, friends = _Recording(anvil.url), (unused_address(), unused_address())
    timing = replace(QUICK, replace_after=0.1)
    async with Node(wire, timing=timing, transactions=tmp_path if kept else None) as node:
        sender = TransactionSender(node, Account(anvil.private_keys[0]))
        before = await node.request("evm_snapshot")
        sending = asyncio.create_task(sender.send(to=friends[0], data=b"", value=5))
        await until_pending(node, 1)
        await node.request("evm_mine")
        mined = (await sending).tx
        offered = int((await node.request("eth_getTransactionByHash", mined))["maxFeePerGas"], 16)
        await node.request("evm_revert", before)
        await node.request("eth_sendRawTransaction", wire.sent[0])
        sending = asyncio.create_task(sender.send(to=friends[1], data=b"", value=7))
        await until_pending(node, 2)
        await node.request("anvil_setNextBlockBaseFeePerGas", hex(offered + 1))
        async with asyncio.timeout(60):
            while not sending.done():
                await node.request("evm_mine")
                await asyncio.sleep(0.05)
        await sending
        assert [await node.eth_balance(friend) for friend in friends] == [5, 7]
    await wire.close()


async def test_a_nonce_that_a_reorganisation_freed_and_nobody_remembers_is_filled(anvil: Anvil) -> None:
    """As when a process ends once its transaction is mined, and a reorganisation takes that one."""
    friends, timing = (unused_address(), unused_address()), replace(QUICK, replace_after=0.1)
    account = Account(anvil.private_keys[0])
    async with Node(anvil.url, timing=timing) as node, Node(anvil.url, timing=timing) as restarted:
        before = await node.request("evm_snapshot")
        first = asyncio.create_task(TransactionSender(node, account).send(to=friends[0], data=b"", value=5))
        await until_pending(node, 1)
        await node.request("evm_mine")
        await first
        second = asyncio.create_task(TransactionSender(restarted, account).send(to=friends[1], data=b"", value=7))
        await until_pending(node, 1)
        await node.request("evm_revert", before)
        async with asyncio.timeout(60):
            while not second.done():
                await node.request("evm_mine")
                await asyncio.sleep(0.05)
        await second
        assert [await node.eth_balance(friend) for friend in friends] == [0, 7]
        assert await node.transaction_count(account.address) == 2


async def test_all_nonces_that_a_reorganisation_freed_are_filled_together(anvil: Anvil) -> None:
    wire, others, count = _Recording(anvil.url), [unused_address() for _ in range(3)], 3
    account, timing = Account(anvil.private_keys[0]), replace(QUICK, replace_after=0.5)
    async with Node(anvil.url, timing=timing) as node, Node(wire, timing=timing) as restarted:
        before = await node.request("evm_snapshot")
        forgotten = TransactionSender(node, account)
        first = [asyncio.create_task(forgotten.send(to=unused_address(), data=b"", value=5)) for _ in range(count)]
        await until_pending(node, count)
        await node.request("evm_mine")
        await asyncio.gather(*first)
        sender = TransactionSender(restarted, account)
        second = [asyncio.create_task(sender.send(to=other, data=b"", value=7)) for other in others]
        await until_pending(node, len(others))
        await node.request("evm_revert", before)
        async with asyncio.timeout(60):
            while not all(sending.done() for sending in second):
                await node.request("evm_mine")
                await asyncio.sleep(0.05)
            await asyncio.gather(*second)
        assert [await node.eth_balance(other) for other in others] == [7, 7, 7]
        fillers = {raw for raw in wire.sent if account.address[2:].lower() in raw}
        assert len(fillers) == count, "each nonce is filled once, though three tasks wait for it"
    await wire.close()


class _Indexing(HttpTransport):
    """A node that is still busy with its index, and says so when it is asked for a receipt."""

    asked = 0

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_getTransactionReceipt":
            self.asked += 1
            if self.asked < 5:
                error = {"code": -32000, "message": "transaction indexing is in progress"}
                return {"jsonrpc": "2.0", "id": 1, "error": error}
        return await super().make_request(method, params)


async def test_a_node_that_is_still_indexing_is_asked_for_the_receipt_again(anvil: Anvil) -> None:
    wire, friend = _Indexing(anvil.url), unused_address()
    async with Node(wire, timing=QUICK) as node:
        await node.request("evm_setAutomine", True)
        await TransactionSender(node, Account(anvil.private_keys[0])).send(to=friend, data=b"", value=5)
        assert await node.eth_balance(friend) == 5
        assert wire.asked == 5
    await wire.close()


async def test_sending_again_after_a_lost_answer_continues_the_first_transaction(anvil: Anvil) -> None:
    """The node takes the transaction and is gone before it says so; the caller tries again when it is back."""
    wire, friend = _AnswerLosingTransport(anvil.url), unused_address()
    async with Node(wire, timing=QUICK) as node:
        sender = TransactionSender(node, Account(anvil.private_keys[0]))
        wire.loses = True
        with pytest.raises(NodeUnreachable):
            await sender.send(to=friend, data=b"", value=5)
        wire.loses = False
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        await node.request("evm_mine")
        await sending
        assert await node.eth_balance(friend) == 5
        again = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        await until_pending(node, 1)
        await node.request("evm_mine")
        await again
        assert await node.eth_balance(friend) == 10, "the outcome of the first was learned: this is another one"
    await wire.close()


class _AnswerLosingTransport(HttpTransport):
    """A transport that can lose the answers to sent transactions."""

    loses = False

    async def make_request(self, method: str, params: Any) -> Any:
        response = await super().make_request(method, params)
        if method == "eth_sendRawTransaction" and self.loses:
            raise ConnectionResetError("the answer was lost")
        return response


async def test_sending_again_after_a_timeout_continues_the_first_transaction(anvil: Anvil) -> None:
    async with open_sender(anvil, SHORT) as (node, sender):
        friend = unused_address()
        with pytest.raises(TransactionTimeout) as caught:
            await sender.send(to=friend, data=b"", value=5)
        await node.request("evm_mine")
        node.timing = QUICK
        assert (await sender.send(to=friend, data=b"", value=5)).tx == caught.value.tx
        assert await node.eth_balance(friend) == 5
