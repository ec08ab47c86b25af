"""Nodes and contracts whose answers have the right type and can't be true."""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import aclosing, suppress
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import Account, Chain, NewLighthouse, TransactionSender, deploy
from mesh.chain.answers import Address, Count, Data, InvalidAnswer, Log, Word, explain
from mesh.chain.following import decode_log
from mesh.dev import EmbeddedChain
from mesh.dev._embedded import EmbeddedProvider
from schemas import keccak256
from tests.mesh.chain.conftest import QUICK, events_of, read_to
from tests.support.log_events import logged_events
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable


FAR = 2**62
SPAM = 40


class _Lying(EmbeddedProvider):
    """An embedded chain whose answers go through `lies`, by method."""

    def __init__(self, chain: EmbeddedChain) -> None:
        super().__init__(chain)
        self.lies: dict[str, Callable[[Any], Any]] = {}
        self.asked: Counter[str] = Counter()

    async def make_request(self, method: str, params: Any) -> Any:
        self.asked[method] += 1
        response = await super().make_request(method, params)
        if (lie := self.lies.get(method)) is not None and response.get("result"):
            response["result"] = lie(response["result"])
        return response


@pytest.fixture
async def node() -> AsyncIterator[EmbeddedChain]:
    async with EmbeddedChain() as node:
        await deploy(node.provider, Account(node.funded_keys[0]))
        yield node


async def test_a_head_that_is_not_there_is_not_read_towards_for_ever(
    node: EmbeddedChain, caplog: pytest.LogCaptureFixture
) -> None:
    wire = _Lying(node)
    async with Chain(wire, timing=QUICK) as chain:
        head = await chain.block_number()
        wire.lies["eth_getBlockByNumber"] = lambda block: block | {"number": hex(FAR)}
        read: list[int] = []

        async def follow() -> None:
            async with aclosing(chain.follow(head)) as blocks:
                async for block in blocks:
                    read.append(block.block_number)

        following = asyncio.create_task(follow())
        await until(lambda: "chain-outage" in logged_events(caplog))
        assert read == []
        wire.lies.clear()
        await until(lambda: read)
        following.cancel()
        with suppress(asyncio.CancelledError):
            await following
    assert read == [head]


async def test_a_block_with_another_number_is_refused(node: EmbeddedChain) -> None:
    wire = _Lying(node)
    async with Chain(wire, timing=QUICK) as chain:
        wire.lies["eth_getBlockByNumber"] = lambda block: block | {"number": "0x5"}
        with pytest.raises(InvalidAnswer):
            await chain.node.header(3)
        assert await chain.node.header(5) is not None


async def test_logs_of_other_blocks_are_refused(node: EmbeddedChain) -> None:
    wire = _Lying(node)
    async with Chain(wire, timing=QUICK) as chain:
        wire.lies["eth_getLogs"] = lambda logs: [log | {"blockNumber": hex(FAR)} for log in logs]
        with pytest.raises(InvalidAnswer):
            await chain.lighthouses.list()


async def test_a_contract_that_logs_often_costs_one_question(node: EmbeddedChain) -> None:
    """The factory is asked once whether a contract is its liability, however many endings that contract logs."""
    wire = _Lying(node)
    topic = keccak256(b"Finalized(bool,bytes)").hex()
    runtime = ("7f" + topic + "60006000a1") * SPAM
    code = f"61{len(runtime) // 2:04x}80600c6000396000f3" + runtime
    async with Chain(wire, timing=QUICK) as chain:
        sender = TransactionSender(chain.node, Account(node.funded_keys[1]))
        spammer = await sender.send(to=None, data=bytes.fromhex(code))
        spam = await sender.send(to=spammer.contract, data=b"")
        assert len(spam.logs) == SPAM
        wire.asked.clear()
        assert events_of(await read_to(chain, spam.block_number, spam.block_number)) == []
        assert wire.asked["eth_call"] == 1


@pytest.mark.parametrize(("length", "is_event"), [(255, True), (256, False)])
def test_a_lighthouse_with_an_endless_name_is_no_event(length: int, is_event: bool) -> None:
    name = b"a" * length
    log = Log(
        address=Address("0x" + "12" * 20),
        topics=[Word(keccak256(b"NewLighthouse(address,string)")), Word(bytes(32))],
        data=Data((32).to_bytes(32, "big") + length.to_bytes(32, "big") + name + bytes(-length % 32)),
        block_number=Count(1),
        block_hash=Word(bytes(32)),
        transaction_hash=Word(bytes(32)),
        log_index=Count(0),
    )
    assert isinstance(decode_log(log), NewLighthouse) is is_event


def test_a_contracts_reason_is_cut_off() -> None:
    said = b"no" * 10_000
    words = (32).to_bytes(32, "big") + len(said).to_bytes(32, "big") + said + bytes(-len(said) % 32)
    assert explain(bytes.fromhex("08c379a0") + words).reason == "no" * 500


async def test_a_node_can_not_name_another_contract_as_the_one_that_was_deployed(node: EmbeddedChain) -> None:
    wire, account = _Lying(node), Account(node.funded_keys[0])
    async with Chain(wire, account=account, timing=QUICK) as chain:
        wire.lies["eth_getTransactionReceipt"] = lambda receipt: receipt | {"contractAddress": chain.factory}
        made = await chain.validators.deploy([account.address], 1)
        assert made.address != chain.factory
        jury = await chain.validators.jury(made.address)
        assert jury is not None
        assert jury.jurors == (account.address,)
