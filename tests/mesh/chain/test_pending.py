"""Transactions that wait: stuck, replaced, lost, left behind by an earlier life, confirmed."""

from __future__ import annotations

import asyncio
import sys
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import (
    GWEI,
    Account,
    FeePolicy,
    Node,
    NodeUnreachable,
    Sender,
    TransactionTimeout,
    new_private_key,
)
from mesh.chain.transports import HttpTransport
from mesh.errors import ConfigurationError
from tests.mesh.chain.conftest import QUICK
from tests.support.nodes import Anvil

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from web3.types import RPCEndpoint, RPCResponse

    from mesh.chain import Timing

SHORT = replace(QUICK, receipt_timeout=0.3)
NEVER = "--no-mining"


@pytest.fixture
async def anvil() -> AsyncIterator[Anvil]:
    """A node that mines only when it is told to."""
    async with Anvil(arguments=(NEVER,)) as anvil:
        yield anvil


@asynccontextmanager
async def _life(anvil: Anvil, timing: Timing = QUICK, **options: Any) -> AsyncIterator[tuple[Node, Sender]]:
    """One life of a process that sends for anvil's first account."""
    async with Node(anvil.url, timing=timing, **options) as node:
        yield node, Sender(node, Account.from_key(anvil.private_keys[0]))


def _stranger() -> str:
    return Account.from_key(new_private_key()).address


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


async def _ask(node: Node, method: str, *params: Any) -> Any:
    return (await node.web3.provider.make_request(method, list(params)))["result"]


async def _waiting(node: Node) -> dict[int, str]:
    """The hashes of the node's pending transactions, by number."""
    senders = (await _ask(node, "txpool_content"))["pending"].values()
    return {int(number): sent["hash"] for by_number in senders for number, sent in by_number.items()}


async def _until_waiting(node: Node, count: int) -> dict[int, str]:
    async with asyncio.timeout(10):
        while len(waiting := await _waiting(node)) < count:
            await asyncio.sleep(0.01)
    return waiting


async def test_a_stuck_transaction_is_replaced_by_a_dearer_one_and_its_effect_happens_once(anvil: Anvil) -> None:
    async with _life(anvil, replace(QUICK, replace_after=0.1)) as (node, sender):
        friend = _stranger()
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        first = (await _until_waiting(node, 1))[0]
        offered = int((await _ask(node, "eth_getTransactionByHash", first))["maxFeePerGas"], 16)
        # No block takes the first any more.
        await _ask(node, "anvil_setNextBlockBaseFeePerGas", hex(offered + 1))
        async with asyncio.timeout(10):
            while not sending.done():
                await _ask(node, "evm_mine")
                await asyncio.sleep(0.05)
        receipt = await sending
        paid = await _ask(node, "eth_getTransactionByHash", receipt.tx)
        assert receipt.tx != first
        assert int(paid["maxFeePerGas"], 16) > offered
        assert await node.eth_balance(friend) == 5


class _Swallowing(HttpTransport):
    """A node that takes transactions, and from some moment on only says so."""

    swallows = False

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.swallowed: list[str] = []

    async def make_request(self, method: RPCEndpoint, params: Any) -> RPCResponse:
        if method == "eth_sendRawTransaction" and self.swallows:
            self.swallowed.append(params[0])
            return {"jsonrpc": "2.0", "id": 1, "result": "0x"}
        return await super().make_request(method, params)


async def test_the_version_that_was_replaced_may_be_the_one_that_is_mined(anvil: Anvil) -> None:
    wire, friend = _Swallowing(anvil.url), _stranger()
    async with Node(wire, timing=replace(QUICK, replace_after=0.05)) as node:
        sending = asyncio.create_task(
            Sender(node, Account.from_key(anvil.private_keys[0])).send(to=friend, data=b"", value=5)
        )
        first = (await _until_waiting(node, 1))[0]
        wire.swallows = True
        async with asyncio.timeout(10):
            while not wire.swallowed:
                await asyncio.sleep(0.01)
        await _ask(node, "evm_mine")
        assert (await sending).tx == first
        assert await node.eth_balance(friend) == 5
    await wire.close()


async def test_at_the_ceiling_the_same_transaction_is_sent_again_to_a_node_that_lost_it(anvil: Anvil) -> None:
    timing = replace(QUICK, replace_after=0.2)
    async with _life(anvil, timing, fees=FeePolicy(ceiling=3 * GWEI)) as (node, sender):
        friend = _stranger()
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        first = (await _until_waiting(node, 1))[0]
        await _ask(node, "anvil_dropTransaction", first)
        assert await _until_waiting(node, 1) == {0: first}
        await _ask(node, "evm_mine")
        assert (await sending).tx == first


async def test_a_transaction_waits_for_its_confirmations(anvil: Anvil) -> None:
    async with _life(anvil, replace(QUICK, confirmations=3)) as (node, sender):
        sending = asyncio.create_task(sender.send(to=_stranger(), data=b"", value=5))
        await _until_waiting(node, 1)
        for _ in range(2):
            await _ask(node, "evm_mine")
        await asyncio.sleep(10 * QUICK.poll_interval)
        assert not sending.done()
        await _ask(node, "evm_mine")
        receipt = await sending
        assert await node.block_number() == receipt.block_number + 2


async def test_a_transaction_whose_block_was_replaced_is_sent_again(anvil: Anvil) -> None:
    async with _life(anvil, replace(QUICK, confirmations=3)) as (node, sender):
        friend = _stranger()
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        first = (await _until_waiting(node, 1))[0]
        for _ in range(2):
            await _ask(node, "evm_mine")
        await asyncio.sleep(10 * QUICK.poll_interval)
        await _ask(node, "anvil_reorg", 2, [])
        assert await node.eth_balance(friend) == 0
        assert await _until_waiting(node, 1) == {0: first}
        for _ in range(3):
            await _ask(node, "evm_mine")
        assert (await sending).block_number == 3
        assert await node.eth_balance(friend) == 5


class _Indexing(HttpTransport):
    """A node that is still busy with its index, and says so when it is asked for a receipt."""

    asked = 0

    async def make_request(self, method: RPCEndpoint, params: Any) -> RPCResponse:
        if method == "eth_getTransactionReceipt":
            self.asked += 1
            if self.asked < 5:
                error = {"code": -32000, "message": "transaction indexing is in progress"}
                return {"jsonrpc": "2.0", "id": 1, "error": error}  # type: ignore[typeddict-item]
        return await super().make_request(method, params)


async def test_a_node_that_is_still_indexing_is_asked_for_the_receipt_again(anvil: Anvil) -> None:
    wire, friend = _Indexing(anvil.url), _stranger()
    async with Node(wire, timing=QUICK) as node:
        await _ask(node, "evm_setAutomine", True)
        await Sender(node, Account.from_key(anvil.private_keys[0])).send(to=friend, data=b"", value=5)
        assert await node.eth_balance(friend) == 5
        assert wire.asked == 5
    await wire.close()


async def test_after_a_lost_answer_sending_the_same_again_means_the_first(anvil: Anvil) -> None:
    """The node takes the transaction and is gone before it says so; the caller tries again when it is back."""
    wire, friend = _Deaf(anvil.url), _stranger()
    async with Node(wire, timing=QUICK) as node:
        sender = Sender(node, Account.from_key(anvil.private_keys[0]))
        wire.loses = True
        with pytest.raises(NodeUnreachable):
            await sender.send(to=friend, data=b"", value=5)
        wire.loses = False
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        await _ask(node, "evm_mine")
        await sending
        assert await node.eth_balance(friend) == 5
        again = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        await _until_waiting(node, 1)
        await _ask(node, "evm_mine")
        await again
        assert await node.eth_balance(friend) == 10, "the outcome of the first was learned: this is another one"
    await wire.close()


class _Deaf(HttpTransport):
    """A way to a node that can lose the answers to what is sent."""

    loses = False

    async def make_request(self, method: RPCEndpoint, params: Any) -> RPCResponse:
        response = await super().make_request(method, params)
        if method == "eth_sendRawTransaction" and self.loses:
            raise ConnectionResetError("the answer was lost")
        return response


async def test_after_giving_up_the_same_is_waited_for_even_if_it_is_mined_by_then(anvil: Anvil) -> None:
    async with _life(anvil, SHORT) as (node, sender):
        friend = _stranger()
        with pytest.raises(TransactionTimeout) as caught:
            await sender.send(to=friend, data=b"", value=5)
        await _ask(node, "evm_mine")
        assert (await sender.send(to=friend, data=b"", value=5)).tx == caught.value.tx
        assert await node.eth_balance(friend) == 5


async def test_what_was_mined_long_ago_is_not_what_is_meant_now(anvil: Anvil) -> None:
    async with _life(anvil, replace(SHORT, repeat_within=0)) as (node, sender):
        friend = _stranger()
        with pytest.raises(TransactionTimeout):
            await sender.send(to=friend, data=b"", value=5)
        await _ask(node, "evm_mine")
        await _ask(node, "evm_setAutomine", True)
        await sender.send(to=friend, data=b"", value=5)
        assert await node.eth_balance(friend) == 10


async def test_what_an_earlier_life_left_in_the_pool_is_not_collided_with(anvil: Anvil) -> None:
    friend = _stranger()
    async with _life(anvil, SHORT) as (_, sender):
        with pytest.raises(TransactionTimeout):
            await sender.send(to=friend, data=b"", value=1)
    async with _life(anvil) as (node, sender):
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=2))
        assert sorted(await _until_waiting(node, 2)) == [0, 1]
        await _ask(node, "evm_mine")
        await sending
        assert await node.eth_balance(friend) == 3


async def test_the_journal_tells_a_later_life_what_the_node_forgot(anvil: Anvil, tmp_path: Path) -> None:
    friend = _stranger()
    async with _life(anvil, SHORT, journal=tmp_path) as (node, sender):
        with pytest.raises(TransactionTimeout) as caught:
            await sender.send(to=friend, data=b"", value=5)
        await _ask(node, "anvil_dropTransaction", caught.value.tx)
    async with _life(anvil, journal=tmp_path) as (node, sender):
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=5))
        assert await _until_waiting(node, 1) == {0: caught.value.tx}
        await _ask(node, "evm_mine")
        assert (await sending).tx == caught.value.tx
        assert await node.eth_balance(friend) == 5
    assert _files(tmp_path) == [], "what is settled is not kept"


async def test_a_forgotten_transaction_gives_its_number_to_another(anvil: Anvil, tmp_path: Path) -> None:
    friend = _stranger()
    async with _life(anvil, SHORT, journal=tmp_path) as (node, sender):
        with pytest.raises(TransactionTimeout) as caught:
            await sender.send(to=friend, data=b"", value=5)
        await _ask(node, "anvil_dropTransaction", caught.value.tx)
    async with _life(anvil, journal=tmp_path) as (node, sender):
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=7))
        assert list(await _until_waiting(node, 1)) == [0]
        await _ask(node, "evm_mine")
        await sending
        assert await node.eth_balance(friend) == 7


async def test_what_waits_behind_a_stuck_transaction_of_an_earlier_life_gets_it_moving(
    anvil: Anvil, tmp_path: Path
) -> None:
    friend = _stranger()
    async with _life(anvil, SHORT, journal=tmp_path) as (node, sender):
        with pytest.raises(TransactionTimeout) as stuck:
            await sender.send(to=friend, data=b"", value=1)
    async with _life(anvil, replace(QUICK, replace_after=0.1), journal=tmp_path) as (node, sender):
        sending = asyncio.create_task(sender.send(to=friend, data=b"", value=2))
        async with asyncio.timeout(10):
            while (await _until_waiting(node, 2))[0] == stuck.value.tx:
                await asyncio.sleep(0.01)
        await _ask(node, "evm_mine")
        await sending
        assert await node.eth_balance(friend) == 3


async def test_a_journal_is_of_one_chain(tmp_path: Path) -> None:
    """A development chain that is started afresh has the same chain id, and none of the old transactions."""
    friend = _stranger()
    for born in ("1700000000", "1700000001"):
        async with (
            Anvil(arguments=(NEVER, "--timestamp", born)) as anvil,
            _life(anvil, SHORT, journal=tmp_path) as (node, sender),
        ):
            with pytest.raises(TransactionTimeout):
                await sender.send(to=friend, data=b"", value=1)
            assert len(await _waiting(node)) == 1
    assert [path.name for path in _files(tmp_path)] == ["000000000000.jsonl"] * 2


async def test_a_number_that_another_transaction_took_at_last_is_replaced(anvil: Anvil) -> None:
    """Somebody sends with the same key and number through another node, and wins."""
    account, friend = Account.from_key(anvil.private_keys[0]), _stranger()
    async with Node(anvil.url, timing=QUICK) as node:
        sending = asyncio.create_task(Sender(node, account).send(to=friend, data=b"", value=5))
        await _until_waiting(node, 1)
        prices = {"type": 2, "maxFeePerGas": 100 * GWEI, "maxPriorityFeePerGas": 50 * GWEI}
        fields = {"to": friend, "data": "0x", "value": 70, "gas": 21_000, "chainId": node.chain_id, "nonce": 0}
        rival = account.sign_transaction(fields | prices)
        await _ask(node, "eth_sendRawTransaction", "0x" + rival.raw.hex())
        await _ask(node, "evm_mine")
        assert list(await _until_waiting(node, 1)) == [1]
        await _ask(node, "evm_mine")
        await sending
        assert await node.eth_balance(friend) == 75


CHILD = """
import asyncio, sys
from pathlib import Path
from mesh.chain import Account, Node, Sender, Timing
from mesh.chain.transports import HttpTransport

class Forgetful(HttpTransport):
    async def make_request(self, method, params):
        if method == "eth_getTransactionCount":
            params = [params[0], "latest"]
        return await super().make_request(method, params)

async def main(url, key, friend, journal, count):
    wire = Forgetful(url)
    timing = Timing(poll_interval=0.05, receipt_interval=0.01)
    async with Node(wire, timing=timing, journal=Path(journal)) as node:
        sender = Sender(node, Account.from_key(bytes.fromhex(key)))
        await asyncio.gather(*(sender.send(to=friend, data=b"", value=1) for _ in range(int(count))))
    await wire.close()

asyncio.run(main(*sys.argv[1:]))
"""


async def test_processes_that_share_a_journal_never_take_the_same_number(tmp_path: Path) -> None:
    """Even where the node does not count what waits."""
    friend = _stranger()

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


async def test_a_journal_that_can_not_be_written_is_one_clear_error(anvil: Anvil, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    async with _life(anvil, journal=tmp_path / "file") as (_, sender):
        with pytest.raises(ConfigurationError, match="can't keep sent transactions"):
            await sender.send(to=_stranger(), data=b"", value=1)
