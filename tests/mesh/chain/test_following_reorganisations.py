"""Following the chain through reorganisations."""

from __future__ import annotations

import asyncio
from contextlib import aclosing, asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import (
    Account,
    Approval,
    BlockEvents,
    Chain,
    ChainWentBack,
    History,
    Node,
    Reorganisation,
    deploy,
)
from mesh.chain.following import SeenBlock
from mesh.dev import EmbeddedChain
from mesh.errors import InputError
from tests.mesh.chain.conftest import QUICK
from tests.support.log_events import logged_events
from tests.support.nodes import Anvil, written_state
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Callable
    from pathlib import Path

    from mesh.chain import ChainEvent


class Fork:
    """A chain whose last blocks can be replaced, with contracts and an account that approves allowances."""

    def __init__(self, chain: Chain, friend: str) -> None:
        self.chain = chain
        self.friend = friend

    async def approve(self, value: int) -> int:
        """Make one event, in a separate block; the number of the block."""
        await self.chain.tokens.approve(self.friend, value)
        return await self.chain.block_number()

    async def replace_last(self, blocks: int) -> None:
        """Forget that many blocks, and make one eventless block more than that."""
        head = await self.chain.block_number()
        if self.is_embedded:
            await self.request("evm_revert", hex(head - blocks))
            await self.request("evm_mine", blocks + 1)
        else:
            await self.request("anvil_reorg", blocks, [])
            await self.request("evm_mine")

    @property
    def is_embedded(self) -> bool:
        return "embedded" in self.chain.node.endpoint

    async def request(self, method: str, *params: object) -> None:
        await self.chain.node.request(method, *params)


@pytest.fixture(params=["embedded", "anvil"])
async def fork(request: pytest.FixtureRequest) -> AsyncIterator[Fork]:
    if request.param == "embedded":
        async with EmbeddedChain() as node:
            account, friend = (Account(key) for key in node.funded_keys[:2])
            await deploy(node.provider, account)
            async with Chain(node.provider, account=account, timing=QUICK) as chain:
                yield Fork(chain, friend.address)
    else:
        async with Anvil() as anvil:
            account, friend = (Account(key) for key in anvil.private_keys[:2])
            await deploy(anvil.url, account)
            async with Chain(anvil.url, account=account, timing=QUICK) as chain:
                yield Fork(chain, friend.address)


async def _until(
    events: AsyncGenerator[BlockEvents, None], is_last: Callable[[BlockEvents], bool]
) -> list[BlockEvents]:
    """The blocks up to and including the first one for which `is_last` is true."""
    blocks: list[BlockEvents] = []
    async with asyncio.timeout(60):
        async for block in events:
            blocks.append(block)
            if is_last(block):
                return blocks
    raise AssertionError("the events ended")


def _reaches(number: int) -> Callable[[BlockEvents], bool]:
    return lambda block: block.block_number >= number


def _is_reorganised(block: BlockEvents) -> bool:
    return isinstance(block, Reorganisation)


def _values(events: tuple[ChainEvent, ...]) -> list[int]:
    return [event.value for event in events if isinstance(event, Approval)]


async def test_events_of_replaced_blocks_are_reverted_newest_first_before_the_new_ones(fork: Fork) -> None:
    chain = fork.chain
    start = await fork.approve(1)
    async with aclosing(chain.follow(start)) as events:
        first = await _until(events, _reaches(start))
        for value in (2, 3):
            head = await fork.approve(value)
        await _until(events, _reaches(head))
        await fork.replace_last(2)
        *_, back = await _until(events, _is_reorganised)
        assert isinstance(back, Reorganisation)
        assert (back.block_number, back.events) == (start, ())
        assert _values(back.reverted_events) == [3, 2]
        head = await fork.approve(4)
        new = await _until(events, _reaches(head))
    assert [_values(block.events) for block in first] == [[1]]
    assert [value for block in new for value in _values(block.events)] == [4]
    assert min(block.block_number for block in new) > back.block_number


async def test_a_reorganisation_while_stopped_is_yielded_first_with_a_saved_history(fork: Fork) -> None:
    chain, history = fork.chain, History()
    start = await fork.approve(1)
    async with aclosing(chain.follow(start, history=history)) as events:
        await _until(events, _reaches(start))
        head = await fork.approve(2)
        await _until(events, _reaches(head))
    await fork.replace_last(1)
    kept = History.decode(history.encode())
    async with aclosing(chain.follow(head + 1, history=kept)) as events:
        back = await anext(events)
        assert isinstance(back, Reorganisation)
        assert (back.block_number, _values(back.reverted_events)) == (start, [2])
        assert await anext(events) == BlockEvents(head + 1, ())


async def test_without_a_history_earlier_reorganisations_go_unnoticed(fork: Fork) -> None:
    head = await fork.approve(1)
    await fork.replace_last(1)
    async with aclosing(fork.chain.follow(head + 1)) as events:
        assert await anext(events) == BlockEvents(head + 1, ())


async def test_a_reorganisation_that_begins_before_the_start_is_followed(fork: Fork) -> None:
    for value in (1, 2):
        head = await fork.approve(value)
    async with aclosing(fork.chain.follow(head + 1)) as events:
        await fork.request("evm_mine")
        await _until(events, _reaches(head + 1))
        await fork.replace_last(2)
        *_, back = await _until(events, _is_reorganised)
        assert isinstance(back, Reorganisation)
        assert back.block_number < head
        assert back.reverted_events == ()
        head = await fork.approve(3)
        new = await _until(events, _reaches(head))
    assert [value for block in new for value in _values(block.events)][-1] == 3


async def test_a_reorganisation_of_blocks_without_events_reverts_nothing(fork: Fork) -> None:
    start = await fork.approve(1)
    async with aclosing(fork.chain.follow(start)) as events:
        await _until(events, _reaches(start))
        await fork.request("evm_mine")
        await _until(events, _reaches(start + 1))
        await fork.replace_last(1)
        *_, back = await _until(events, _is_reorganised)
    assert back == Reorganisation(start, (), ())


async def test_a_reorganisation_of_the_whole_depth_is_reverted_and_a_deeper_one_is_an_error(fork: Fork) -> None:
    chain, history = fork.chain, History(depth=3)
    start = await fork.approve(1)
    async with aclosing(chain.follow(start, history=history)) as events:
        await _until(events, _reaches(start))
        for value in (2, 3, 4):
            head = await fork.approve(value)
            await _until(events, _reaches(head))
        await fork.replace_last(3)
        *_, back = await _until(events, _is_reorganised)
        assert isinstance(back, Reorganisation)
        assert (back.block_number, _values(back.reverted_events)) == (start, [4, 3, 2])
        for value in (5, 6, 7, 8):
            head = await fork.approve(value)
            await _until(events, _reaches(head))
        await fork.replace_last(4)
        with raises_with(ChainWentBack, code="reorganised-too-deep") as caught:
            await _until(events, _reaches(head + 10))
    assert (caught.value.cursor, caught.value.head) == (head - 3, head + 1)


@pytest.mark.parametrize("fork", ["embedded"], indirect=True)
async def test_no_event_is_lost_if_blocks_are_replaced_while_several_are_read(
    fork: Fork, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The block before them, which had no event, is replaced by one that has."""
    chain, node = fork.chain, fork.chain.node
    start = await fork.approve(1)
    async with aclosing(chain.follow(start)) as events:
        await _until(events, _reaches(start))
        await fork.request("evm_mine")
        await _until(events, _reaches(start + 1))
        await fork.request("evm_mine", 2)
        original, replaced = node.header, list[int]()

        async def header(block: int | str) -> Any:
            if block == start + 2 and not replaced:
                replaced.append(start + 2)
                await fork.request("evm_revert", hex(start))
                await fork.approve(8)
                await fork.approve(9)
                await fork.request("evm_mine", 2)
            return await original(block)

        monkeypatch.setattr(node, "header", header)
        blocks = await _until(events, _reaches(start + 4))
    assert replaced == [start + 2]
    assert [value for block in blocks for value in _values(block.events)] == [8, 9]


async def test_a_list_is_read_again_if_blocks_are_replaced_meanwhile(
    fork: Fork, monkeypatch: pytest.MonkeyPatch
) -> None:
    node, asked, replace_at = fork.chain.node, list[int](), 0
    await fork.approve(1)
    original = node.block_logs

    async def block_logs(block: Any, **options: Any) -> Any:
        asked.append(block.number)
        if len(asked) == replace_at:
            await fork.replace_last(1)
        return await original(block, **options)

    monkeypatch.setattr(node, "block_logs", block_logs)
    before = await fork.chain.lighthouses.list()
    once, replace_at = asked.copy(), len(asked) + 1
    assert await fork.chain.lighthouses.list() == before
    assert asked == 3 * once


async def test_a_block_that_was_not_handled_completely_is_yielded_again_or_reverted(fork: Fork) -> None:
    """The cursor of a reader that fell over in the middle of a block is behind the history."""
    chain, history = fork.chain, History()
    start = await fork.approve(1)
    for wanted in ([1], [1]):
        async with aclosing(chain.follow(start, history=history)) as events:
            assert _values((await anext(events)).events) == wanted
    await fork.replace_last(1)
    async with aclosing(chain.follow(start, history=history)) as events:
        back = await anext(events)
    assert isinstance(back, Reorganisation)
    assert (back.block_number, _values(back.reverted_events)) == (start - 1, [1])


async def test_a_node_that_is_behind_is_waited_for(fork: Fork) -> None:
    """After one of several nodes fell out, the next may not know the last blocks yet."""
    chain, history = fork.chain, History()
    for value in (1, 2, 3):
        head = await fork.approve(value)
    async with aclosing(chain.follow(head - 2, history=history)) as events:
        await _until(events, _reaches(head))
    history.remember(SeenBlock(head + 2, bytes(32), ()))
    with pytest.raises(ChainWentBack):
        await anext(chain.follow(head + 3))
    async with aclosing(chain.follow(head + 3, history=history)) as events:
        waiting = asyncio.create_task(anext(events))
        await asyncio.sleep(10 * QUICK.poll_interval)
        assert not waiting.done()
        await fork.request("evm_mine")
        await fork.request("evm_mine")
        back = await waiting
    assert isinstance(back, Reorganisation)
    assert back.block_number == head


@asynccontextmanager
async def _anvil_with_state(folder: Path) -> AsyncIterator[Anvil]:
    """An anvil that keeps its chain in a file, a second at most behind, and takes it up when it is started again."""
    arguments = ("--state", str(folder / "state.json"), "--state-interval", "1", "--preserve-historical-states")
    async with Anvil(arguments=arguments) as anvil:
        yield anvil


async def test_events_that_a_killed_node_lost_are_reverted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    state = tmp_path / "state.json"
    async with _anvil_with_state(tmp_path) as anvil:
        account, friend = (Account(key) for key in anvil.private_keys[:2])
        await deploy(anvil.url, account)
        history = History()
        async with Chain(anvil.url, account=account, timing=replace(QUICK, attempts=1)) as chain:
            fork = Fork(chain, friend.address)
            kept = await fork.approve(1)
            async with aclosing(chain.follow(kept, history=history)) as events:
                await _until(events, _reaches(kept))
                written = await asyncio.to_thread(written_state, state, kept)
                lost = await fork.approve(2)
                await _until(events, _reaches(lost))
                await asyncio.to_thread(anvil.kill)
                state.write_bytes(written)  # it may have been quick enough to write the block as well
                following = asyncio.create_task(_until(events, _reaches(lost)))
                await until(lambda: "chain-outage" in logged_events(caplog))
                await asyncio.to_thread(anvil.start)
                assert await chain.block_number() == kept
                await fork.approve(3)
                back, new = await following
    assert isinstance(back, Reorganisation)
    assert (back.block_number, _values(back.reverted_events)) == (kept, [2])
    assert (new.block_number, _values(new.events)) == (lost, [3])


async def test_a_chain_that_was_restarted_from_nothing_is_an_error() -> None:
    history = History()
    async with Anvil() as anvil, Node(anvil.url, timing=QUICK) as node:
        account = Account(anvil.private_keys[0])
        await deploy(node, account)
        async with Chain(node) as chain, aclosing(chain.follow(5, history=history)) as events:
            await _until(events, _reaches(await chain.block_number()))
            head = await chain.block_number()
        await asyncio.to_thread(anvil.stop)
        await asyncio.to_thread(anvil.start)
        # Started within the same second, it would come to the same blocks again.
        await node.request("evm_mine")
        await deploy(node, account)
        async with Chain(node) as chain:
            with raises_with(ChainWentBack, code="reorganised-too-deep") as caught:
                await anext(chain.follow(head + 1, history=history))
    assert caught.value.cursor == 4
    assert "data_dir" in caught.value.hint


def test_a_history_is_encoded_and_decoded_and_invalid_ones_are_refused() -> None:
    history = History(depth=2)
    for number in (5, 6, 9):
        history.remember(SeenBlock(number, number.to_bytes(32, "big"), (Approval("a", "b", 2**256 - 1, "0x"),)))
    again = History.decode(history.encode())
    assert (again.depth, again.blocks) == (2, history.blocks)
    assert [block.block_number for block in again.blocks] == [6, 9]
    for data in (b"", b"[]", history.encode().replace(b"Approval", b"Denial"), history.encode()[:-1]):
        with pytest.raises(InputError):
            History.decode(data)
