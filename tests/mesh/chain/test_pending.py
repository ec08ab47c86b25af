"""Pending transactions of earlier processes, with and without a transaction folder."""

from __future__ import annotations

import asyncio
import sqlite3
import sys
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from mesh.chain import GWEI, Account, Node, TransactionSender, TransactionTimeout
from mesh.chain._pending import FILE
from mesh.errors import ConfigurationError
from tests.mesh.chain.conftest import QUICK
from tests.support.chain.senders import (
    NO_MINING,
    SHORT,
    anvil,
    open_sender,
    pending_hashes,
    until_pending,
    unused_address,
)
from tests.support.nodes import Anvil
from tests.support.provider.held_node import HeldNode
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path


__all__ = ["anvil"]


def _kept(folder: Path) -> list[int]:
    """The nonces of the transactions in the tables in a folder."""
    nonces = []
    for path in folder.rglob(FILE):
        with closing(sqlite3.connect(path)) as database:
            nonces += [nonce for (nonce,) in database.execute("SELECT nonce FROM transactions")]
    return nonces


async def test_a_transaction_that_was_mined_long_ago_is_sent_as_a_new_one(anvil: Anvil) -> None:
    async with open_sender(anvil, replace(SHORT, repeat_within=0)) as (node, sender):
        friend = unused_address()
        with pytest.raises(TransactionTimeout):
            await sender.send(to=friend, data=b"", value=5)
        await node.request("evm_mine")
        await node.request("evm_setAutomine", True)
        node.timing = replace(QUICK, repeat_within=0)
        await sender.send(to=friend, data=b"", value=5)
        assert await node.eth_balance(friend) == 10


async def test_pending_transactions_of_an_earlier_process_keep_their_nonces(anvil: Anvil) -> None:
    friend = unused_address()
    async with open_sender(anvil, SHORT) as (_, sender):
        with pytest.raises(TransactionTimeout):
            await sender.send(to=friend, data=b"", value=1)
    async with open_sender(anvil) as (node, sender):
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=2))
        assert sorted(await until_pending(node, 2)) == [0, 1]
        await node.request("evm_mine")
        await sending
        assert await node.eth_balance(friend) == 3


async def dropped(anvil: Anvil, friend: str, *, transactions: Path) -> str:
    """The hash of a transfer of 5 wei in an earlier open_sender, which the node has forgotten."""
    async with open_sender(anvil, SHORT, transactions=transactions) as (node, sender):
        with pytest.raises(TransactionTimeout) as caught:
            await sender.send(to=friend, data=b"", value=5)
        await node.request("anvil_dropTransaction", caught.value.tx)
    return caught.value.tx


async def test_a_restarted_process_sends_transactions_again_that_the_node_lost(anvil: Anvil, tmp_path: Path) -> None:
    friend = unused_address()
    forgotten = await dropped(anvil, friend, transactions=tmp_path)
    async with open_sender(anvil, transactions=tmp_path) as (node, sender):
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        assert await until_pending(node, 1) == {0: forgotten}
        await node.request("evm_mine")
        assert (await sending).tx == forgotten
        assert await node.eth_balance(friend) == 5
    assert _kept(tmp_path) == [], "settled transactions are not kept"


async def test_a_restarted_process_continues_several_transactions_and_sends_none_twice(
    anvil: Anvil, tmp_path: Path
) -> None:
    friend, values = unused_address(), range(1, 6)
    async with open_sender(anvil, transactions=tmp_path) as (node, sender):
        sending = [asyncio.create_task(sender.send(to=friend, data=b"", value=value)) for value in values]
        before = await until_pending(node, 5)
        for task in sending:
            task.cancel()
        await asyncio.wait(sending)
        await node.request("anvil_dropTransaction", before[1])
        await node.request("anvil_dropTransaction", before[3])
    async with open_sender(anvil, transactions=tmp_path) as (node, sender):
        sending = [asyncio.create_task(sender.send(to=friend, data=b"", value=value)) for value in reversed(values)]
        assert await until_pending(node, 5) == before
        await node.request("evm_mine")
        assert {receipt.tx for receipt in await asyncio.gather(*sending)} == set(before.values())
        assert await node.eth_balance(friend) == sum(values)
        assert await node.transaction_count(sender.account.address) == 5
    assert _kept(tmp_path) == []


async def test_of_several_stuck_transactions_the_first_is_replaced_and_all_are_mined_once(anvil: Anvil) -> None:
    friend = unused_address()
    async with open_sender(anvil, replace(QUICK, replace_after=0.5)) as (node, sender):
        sending = [asyncio.create_task(sender.send(to=friend, data=b"", value=value)) for value in (1, 2, 3)]
        before = await until_pending(node, 3)
        async with asyncio.timeout(30):
            while (now := await pending_hashes(node))[0] == before[0]:
                await asyncio.sleep(0.05)
        assert len(now) == 3
        await node.request("evm_setAutomine", True)
        await node.request("evm_mine")
        await asyncio.gather(*sending)
        assert await node.eth_balance(friend) == 6
        assert await node.transaction_count(sender.account.address) == 3


async def test_the_nonce_of_a_forgotten_transaction_is_used_again(anvil: Anvil, tmp_path: Path) -> None:
    friend = unused_address()
    await dropped(anvil, friend, transactions=tmp_path)
    async with open_sender(anvil, transactions=tmp_path) as (node, sender):
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=7))
        assert list(await until_pending(node, 1)) == [0]
        await node.request("evm_mine")
        await sending
        assert await node.eth_balance(friend) == 7


async def test_a_stuck_transaction_of_an_earlier_process_is_replaced(anvil: Anvil, tmp_path: Path) -> None:
    friend = unused_address()
    async with open_sender(anvil, SHORT, transactions=tmp_path) as (node, sender):
        with pytest.raises(TransactionTimeout) as stuck:
            await sender.send(to=friend, data=b"", value=1)
    async with open_sender(anvil, replace(QUICK, replace_after=0.1), transactions=tmp_path) as (node, sender):
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=2))
        async with asyncio.timeout(60):
            while (await until_pending(node, 2))[0] == stuck.value.tx:
                await asyncio.sleep(0.01)
        await node.request("evm_mine")
        await sending
        assert await node.eth_balance(friend) == 3


async def test_a_transaction_that_is_being_replaced_is_not_sent_a_second_time(anvil: Anvil, tmp_path: Path) -> None:
    """Another one waits for its nonce, and gives it higher fees just when it is sent again."""
    friend, timing = unused_address(), replace(QUICK, replace_after=0.1)
    async with open_sender(anvil, SHORT, transactions=tmp_path) as (_, sender):
        with pytest.raises(TransactionTimeout):
            await sender.send(to=friend, data=b"", value=1)
    async with HeldNode(anvil.url) as held, Node(held, timing=timing, transactions=tmp_path) as node:
        sender = TransactionSender(node, sender.account)
        later = asyncio.create_task(sender.send(to=friend, data=b"", value=2))
        await until_pending(node, 2)
        with held.back("eth_sendRawTransaction"):
            await until(lambda: held.waiting["eth_sendRawTransaction"])
            again = asyncio.create_task(sender.send(to=friend, data=b"", value=1))
            await asyncio.sleep(0.3)
        async with asyncio.timeout(30):
            while not (later.done() and again.done()):
                await node.request("evm_mine")
                await asyncio.sleep(0.05)
        assert (await later).tx != (await again).tx
        assert await node.eth_balance(friend) == 3
        assert await node.transaction_count(sender.account.address) == 2


async def test_a_transaction_folder_belongs_to_one_chain(tmp_path: Path) -> None:
    """A development chain that is started afresh has the same chain id, and none of the old transactions."""
    friend = unused_address()
    for born in ("1700000000", "1700000001"):
        async with (
            Anvil(arguments=(NO_MINING, "--timestamp", born)) as anvil,
            open_sender(anvil, SHORT, transactions=tmp_path) as (node, sender),
        ):
            with pytest.raises(TransactionTimeout):
                await sender.send(to=friend, data=b"", value=1)
            assert len(await pending_hashes(node)) == 1
    assert _kept(tmp_path) == [0, 0]


async def test_a_transaction_that_lost_its_nonce_is_sent_with_the_next(anvil: Anvil) -> None:
    """Another client sends with the same key and nonce through another node, and is mined first."""
    account, friend = Account(anvil.private_keys[0]), unused_address()
    async with Node(anvil.url, timing=QUICK) as node:
        sending = asyncio.create_task(TransactionSender(node, account).send(to=friend, data=b"", value=5))
        await until_pending(node, 1)
        prices = {"type": 2, "maxFeePerGas": 100 * GWEI, "maxPriorityFeePerGas": 50 * GWEI}
        fields = {"to": friend, "data": "0x", "value": 70, "gas": 21_000, "chainId": node.chain_id, "nonce": 0}
        rival = account.sign_transaction(fields | prices)
        await node.request("eth_sendRawTransaction", "0x" + rival.raw.hex())
        await node.request("evm_mine")
        assert list(await until_pending(node, 1)) == [1]
        await node.request("evm_mine")
        await sending
        assert await node.eth_balance(friend) == 75


CHILD = """
import asyncio, sys
from pathlib import Path
from mesh.chain import Account, Node, TransactionSender, Timing
from mesh.chain.rpc import HttpTransport

class Forgetful(HttpTransport):
    async def make_request(self, method, params):
        if method == "eth_getTransactionCount":
            params = [params[0], "latest"]
        return await super().make_request(method, params)

async def main(url, key, friend, folder, count):
    wire = Forgetful(url)
    timing = Timing(poll_interval=0.05, receipt_interval=0.01)
    async with Node(wire, timing=timing, transactions=Path(folder)) as node:
        sender = TransactionSender(node, Account(bytes.fromhex(key)))
        await asyncio.gather(*(sender.send(to=friend, data=b"", value=1) for _ in range(int(count))))
    await wire.close()

asyncio.run(main(*sys.argv[1:]))
"""


async def test_processes_that_share_a_folder_never_use_the_same_nonce(tmp_path: Path) -> None:
    """Even where the node does not count what waits."""
    friend = unused_address()

    async def child(url: str, key: bytes) -> tuple[int | None, str]:
        arguments = (url, key.hex(), friend, str(tmp_path), "6")
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", CHILD, *arguments, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
        )
        out, _ = await process.communicate()
        return process.returncode, out.decode()

    async with Anvil(arguments=("--block-time", "1")) as anvil, Node(anvil.url, timing=QUICK) as node:
        ended = await asyncio.gather(*(child(anvil.url, anvil.private_keys[0]) for _ in range(3)))
        assert ended == [(0, "")] * 3
        assert await node.eth_balance(friend) == 18


async def test_a_folder_that_can_not_be_written_is_an_error(anvil: Anvil, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    async with open_sender(anvil, transactions=tmp_path / "file") as (_, sender):
        with raises_with(ConfigurationError, code="transactions-not-kept"):
            await sender.send(to=unused_address(), data=b"", value=1)
