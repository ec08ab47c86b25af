"""Looking for the next block: when it is due, once for all who wait, or pushed; and what a header says of logs."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import Node
from mesh.chain._node import Heads, Pace, encode_calls
from mesh.chain.answers import NO_TRANSACTIONS, BlockHeader
from mesh.chain.following import topics_of
from mesh.chain.rpc import HttpTransport
from schemas import keccak256
from schemas.address import address_bytes
from tests.mesh.chain.conftest import QUICK
from tests.support.chain.senders import NO_MINING
from tests.support.multicall import decode_calls
from tests.support.nodes import Anvil
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.mesh.chain.conftest import DeployedMarket


class Counting(HttpTransport):
    """A node whose calls are counted."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.calls: Counter[str] = Counter()

    async def make_request(self, method: str, params: Any) -> Any:
        self.calls[method] += 1
        return await super().make_request(method, params)


@pytest.fixture
async def anvil() -> AsyncIterator[Anvil]:
    async with Anvil(arguments=(NO_MINING,)) as anvil:
        yield anvil


def block(number: int, timestamp: int, **fields: Any) -> BlockHeader:
    made: Any = BlockHeader
    header: BlockHeader = made(number, number.to_bytes(32, "big"), bytes(32), timestamp, **fields)
    return header


def paced(*timestamps: int) -> Pace:
    pace = Pace(1.0)
    blocks = [block(number, timestamp) for number, timestamp in enumerate(timestamps)]
    for earlier, later in pairwise(blocks):
        pace.add(earlier, later)
    return pace


@pytest.mark.parametrize(
    ("timestamps", "seconds"),
    [
        ((0, 12, 24, 36), 12),
        ((0, 12, 24, 36, 60, 72), 12),  # a slot was missed
        ((0, 12, 25, 36, 48), 12),
        ((0, 12), None),
        ((0, 1, 2, 3, 4), None),  # faster than is worth waiting for
        ((0, 30, 42, 49, 90, 97), None),
        ((0, 13, 30, 31, 60, 72), None),
    ],
)
def test_the_pace_of_a_chain_is_that_of_its_latest_blocks(timestamps: tuple[int, ...], seconds: int | None) -> None:
    assert paced(*timestamps).seconds == seconds


def test_looks_come_close_to_the_time_when_a_block_is_there() -> None:
    """Blocks are there 3.3 s after their timestamps. In a minute there are five; six looks are the most."""
    pace, now, head, looks, late = paced(0, 12, 24, 36), 40.0, block(3, 36), 0, 0.0
    pace.found(head, now, waited=1.0)
    while head.number < 203:
        now += pace.pause(head, now)
        looks += 1
        following = block(head.number + 1, head.timestamp + 12)
        if now >= following.timestamp + 3.3:
            late = max(late, now - following.timestamp - 3.3) if head.number > 20 else 0.0
            pace.found(following, now, waited=12.0)
            head = following
        else:
            pace.missed()
    assert looks <= 200 * 6 / 5
    assert late < 1.3


def test_a_block_that_is_late_is_looked_for_less_and_less_often() -> None:
    pace, head = paced(0, 12, 24, 36), block(3, 36)
    pace.found(head, 36.0, waited=1.0)
    now, looks = 36.0, 0
    while now < 36 + 120:
        now += pace.pause(head, now)
        pace.missed()
        looks += 1
    assert looks < 45


async def test_all_who_wait_for_a_block_share_the_looks(anvil: Anvil) -> None:
    counting = Counting(anvil.url)
    async with Node(counting, timing=replace(QUICK, poll_interval=0.2)) as node:
        seen = (await node.heads.look()).hash
        waiting = [asyncio.create_task(node.heads.next(seen)) for _ in range(10)]
        begun = time.monotonic()
        await asyncio.sleep(1.0)
        await node.request("evm_mine")
        assert {head.number for head in await asyncio.gather(*waiting)} == {1}
        assert counting.calls["eth_getBlockByNumber"] < 2 * (time.monotonic() - begun) / 0.2
    await counting.close()


async def test_a_failed_look_fails_one_who_waits_and_the_others_look_again() -> None:
    answers: list[Any] = [block(1, 0), OSError("lost"), block(2, 12)]

    async def ask() -> BlockHeader:
        answer: BlockHeader | Exception = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def header(number: int) -> BlockHeader | None:
        return None

    heads = Heads(ask, header, interval=0.01)
    seen = (await heads.look()).hash
    ended = await asyncio.gather(*(heads.next(seen) for _ in range(3)), return_exceptions=True)
    assert [type(one) for one in ended] == [OSError, BlockHeader, BlockHeader]
    assert not answers


async def test_a_node_over_websocket_pushes_its_blocks(anvil: Anvil) -> None:
    timing = replace(QUICK, poll_interval=0.05)
    async with Node(anvil.url.replace("http", "ws", 1), timing=timing) as node:
        head = await node.heads.look()
        for number in (1, 2, 3):
            waiting = asyncio.create_task(node.heads.next(head.hash))
            await asyncio.sleep(0.2)
            await node.request("evm_mine")
            head = await waiting
            assert head.number == number

        async def pushed() -> bool:
            await node.request("evm_mine")
            return node.heads.is_pushed

        await until_found(pushed, what="a block that the node pushes")
        assert node.heads.are_timely


async def test_an_expected_block_is_looked_for_at_once(anvil: Anvil) -> None:
    async with Node(anvil.url, timing=replace(QUICK, poll_interval=30.0)) as node:
        head = await node.heads.look()
        waiting = asyncio.create_task(node.heads.next(head.hash))
        await asyncio.sleep(0)
        await node.request("evm_mine")
        node.heads.expect(1)
        async with asyncio.timeout(25):
            assert (await waiting).number == 1


def test_a_header_excludes_logs_that_its_bloom_filter_excludes() -> None:
    """The filter of a block with one log of one address and one topic, as the yellow paper defines it."""
    address, topic, other = b"\x11" * 20, b"\x22" * 32, b"\x33" * 32
    bloom = 0
    for member in (address, topic):
        digest = keccak256(member)
        for at in (0, 2, 4):
            bloom |= 1 << (int.from_bytes(digest[at : at + 2], "big") & 2047)
    header = block(1, 0, transactions_root=b"\x01" * 32, logs_bloom=bloom.to_bytes(256, "big"))
    assert header.may_log((address, topic))
    assert header.may_log((other,), (address,))
    assert not header.may_log((address, other))
    assert not header.may_log()
    empty = block(1, 0, transactions_root=NO_TRANSACTIONS, logs_bloom=bytes(256))
    assert not empty.may_log((address,))
    for unfilled in (None, bytes(256)):
        assert block(1, 0, transactions_root=b"\x01" * 32, logs_bloom=unfilled).may_log((address,))


async def test_the_bloom_filters_of_nodes_show_the_events_that_are_read(market: DeployedMarket) -> None:
    async with market.chain(market.provider) as chain:
        await chain.lighthouses.create(minimal_stake=1, timeout_blocks=1, name="bloom")
        header = await chain.node.heads.look()
        topics = topics_of("Factory")
        (log, *_) = await chain.node.logs(header.number, header.number, addresses=[chain.factory], topics=topics)
        assert header.has_transactions
        assert header.may_hold(["0x" + "11" * 32, "0x" + log.transaction_hash.hex()])
        assert not header.may_hold(["0x" + "11" * 32])
        assert block(1, 0).may_hold(["0x" + "11" * 32]), "a header that was pushed does not say"
        assert header.may_log((address_bytes(chain.factory), log.topics[0]))
        assert not header.may_log((address_bytes(chain.factory), bytes(32)))


async def test_many_functions_are_read_in_one_call(anvil: Anvil, market: DeployedMarket) -> None:
    async with market.chain() as chain:
        functions = chain.node.contract("XRT", chain.xrt)
        accounts = [market.provider.address, market.promisee.address, chain.factory] * 40
        calls = [functions.balanceOf(account) for account in accounts]
        requests: list[Any] = []
        call = chain.node.call

        async def counted(*arguments: Any, **options: Any) -> bytes:
            requests.append(arguments)
            return await call(*arguments, **options)

        chain.node.call = counted  # type: ignore[method-assign]
        assert await chain.node.read_all(calls, block="latest") == [await chain.node.read(one) for one in calls]
        assert len(requests) == 2 + len(calls)


def test_the_calls_in_a_multicall_can_be_read_back() -> None:
    calls = [("0x" + "11" * 20, b"\x01\x02"), ("0x" + "22" * 20, b"")]
    assert decode_calls(encode_calls(calls, gas=9, most=9)) == calls
    assert decode_calls(b"\x60\x00") is None
