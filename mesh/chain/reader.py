"""Reading a chain's events block by block from a cursor.

By `eth_getLogs` over ranges of blocks: no filters are kept by the node, so nothing is missed across its restarts or
ours. What was read last is remembered with its block hashes, so that blocks which the chain replaced are taken back.
"""

from __future__ import annotations

import asyncio
from contextlib import aclosing
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, cast

from web3.exceptions import BlockNotFound

from mesh.chain.errors import ChainWentBack, NodeUnreachable, ReorganisedTooDeep, RequestRefused
from mesh.chain.events import ChainEvent, NewLiability, decode_log, topics_of
from mesh.chain.history import History, Remembered
from schemas.address import parse_address

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Collection, Iterable, Sequence

    from web3.types import BlockIdentifier, FilterParams

    from mesh.chain.node import Node

MAX_RANGE: Final = 2_000
"""Blocks asked for at once; halved as often as a node refuses, and grown again by a quarter as often as it answers."""


@dataclass(frozen=True, slots=True)
class BlockEvents:
    """The events of a block, in order. All blocks up to `block_number` have been read: the next cursor is one more."""

    block_number: int
    events: tuple[ChainEvent, ...]


@dataclass(frozen=True, slots=True)
class Reorganisation(BlockEvents):
    """The chain replaced what came after `block_number`: all events of `events_taken_back` did not happen.

    They are those told of the blocks above, the newest first, which is the order to undo them in. `events` is empty;
    the next cursor is `block_number + 1` as ever, and the blocks that are there instead come next. An event that
    happened on both sides is taken back and told again.
    """

    events_taken_back: tuple[ChainEvent, ...] = ()

    @property
    def back_to(self) -> int:
        """The last block that is as it was told."""
        return self.block_number


@dataclass(frozen=True, slots=True, kw_only=True)
class Sources:
    """Whose events are read: the factory, a token, any lighthouses, and all liabilities of the factory."""

    factory: str
    token: str
    lighthouses: tuple[str, ...] = ()
    is_liability: Callable[[str], Awaitable[bool]]
    recognise: Callable[[str], None]
    """Told of each liability that the factory's events name, before `is_liability` is asked of what comes with it."""


class Head(NamedTuple):
    """A block as the chain has it now."""

    number: int
    hash: bytes
    parent: bytes


class _ReplacedMeanwhile(Exception):
    """The chain was reorganised between two questions: the answers don't belong together."""


Read: TypeAlias = "Callable[[int, int], Awaitable[list[Remembered]]]"
"""Reads the blocks from one to another, both included, as `read_range` does."""


async def read_blocks(
    node: Node, read: Read, from_block: int, *, history: History | None = None
) -> AsyncGenerator[BlockEvents, None]:
    """Events from `from_block` on, for ever; block numbers only grow, but for `Reorganisation`.

    A block without events comes where nothing else would tell how far was read. With the `history` of an earlier
    reading, blocks that were replaced since then are taken back first. Raises `ChainWentBack` at the start,
    `ReorganisedTooDeep`, `NodeUnreachable`, `RequestRefused`; reading goes on from the cursor with a new iterator.
    """
    history = history or History(node.timing.reorg_depth)
    ranges = _Ranges(node, read)
    head = await _head(node)
    await _check_start(node, history, from_block=from_block, head=head)
    cursor = from_block
    while True:
        replaced = await _find_replaced(node, history, head)
        if replaced is not None:
            cursor = min(cursor, replaced.block_number + 1)
            yield replaced
        history.forget_above(cursor - 1)
        await _remember_start(node, history, cursor, head)
        try:
            async with aclosing(ranges.read_to(cursor, head)) as blocks:
                async for block in blocks:
                    if block.block_hash:
                        history.remember(block)
                    cursor = block.block_number + 1
                    yield BlockEvents(block.block_number, block.events)
        except _ReplacedMeanwhile:
            pass
        await asyncio.sleep(node.timing.poll_interval)
        head = await _head(node)


async def read_once(node: Node, read: Read, from_block: int) -> AsyncGenerator[Remembered, None]:
    """Events from a block to the latest, as it is now. Raises `NodeUnreachable`, `RequestRefused`."""
    async with aclosing(_Ranges(node, read).read_to(from_block, await _head(node))) as blocks:
        async for block in blocks:
            yield block


class _Ranges:
    """Reads ranges of blocks, as long as the node answers them."""

    def __init__(self, node: Node, read: Read) -> None:
        self._node = node
        self._read = read
        self._span = MAX_RANGE

    async def read_to(self, first: int, head: Head) -> AsyncGenerator[Remembered, None]:
        """The events from a block to the head; the hash of an eventless block is empty where nobody needs it."""
        while first <= head.number:
            last = min(head.number, first + self._span - 1)
            try:
                blocks = await self._read(first, last)
            except (RequestRefused, NodeUnreachable) as error:
                if first == last:
                    raise
                if isinstance(error, NodeUnreachable):
                    # A node may give up on a long range without a word; one that is gone raises again here.
                    await self._node.block_number()
                self._span = (last - first + 1) // 2
                continue
            for block in blocks:
                yield _with_hash_of(block, head)
            first = last + 1
            self._span = min(MAX_RANGE, self._span + max(1, self._span // 4))


async def read_range(node: Node, sources: Sources, first: int, last: int) -> list[Remembered]:
    """The events of the blocks from `first` to `last`, both included; an empty one stands for an eventless last.

    Raises `_ReplacedMeanwhile` when a block's logs are of two different blocks.
    """
    addresses = [sources.factory, sources.token, *sources.lighthouses]
    ours = await _logs(node, first, last, addresses=addresses, topics=topics_of("Factory", "XRT", "Lighthouse"))
    for log in ours:
        if isinstance(event := decode_log(log), NewLiability) and parse_address(log["address"]) == sources.factory:
            sources.recognise(event.liability)
    finals = await _logs(node, first, last, addresses=(), topics=topics_of("Liability"))
    finals = [log for log in finals if await sources.is_liability(parse_address(log["address"]))]
    return _by_block((*ours, *finals), last)


async def read_made(node: Node, factory: str, first: int, last: int) -> list[Remembered]:
    """As `read_range`, of the factory alone."""
    return _by_block(await _logs(node, first, last, addresses=[factory], topics=topics_of("Factory")), last)


def _by_block(logs: Iterable[Any], last: int) -> list[Remembered]:
    ordered = sorted(logs, key=lambda log: (log["blockNumber"], log["logIndex"]))
    blocks = []
    for number, group in groupby(ordered, key=lambda log: int(log["blockNumber"])):
        of_block = list(group)
        hashes = {bytes(log["blockHash"]) for log in of_block}
        if len(hashes) > 1:
            raise _ReplacedMeanwhile
        events = tuple(event for log in of_block if (event := decode_log(log)) is not None)
        blocks.append(Remembered(number, hashes.pop(), events))
    if not blocks or blocks[-1].block_number != last:
        blocks.append(Remembered(last, b"", ()))
    return blocks


async def _check_start(node: Node, history: History, *, from_block: int, head: Head) -> None:
    """Raise `ChainWentBack` if the cursor is past the head, but for a node that is a few blocks behind another."""
    if from_block <= head.number + 1:
        return
    if from_block - 1 - head.number <= history.depth:
        for block in reversed(history.blocks):
            if block.block_number <= head.number and await _is_there(node, block, head):
                return
    raise ChainWentBack(from_block, head.number)


async def _find_replaced(node: Node, history: History, head: Head) -> Reorganisation | None:
    """What was told of blocks that the chain has replaced; None as long as it only grew.

    A chain that is shorter than what is remembered has not replaced anything yet: the node may only be behind.
    """
    known = [block for block in history.blocks if block.block_number <= head.number]
    for block in reversed(known):
        if await _is_there(node, block, head):
            if block is known[-1]:
                return None
            return Reorganisation(block.block_number, (), history.forget_above(block.block_number))
    if known:
        raise ReorganisedTooDeep(known[0].block_number, head.number)
    return None


async def _remember_start(node: Node, history: History, cursor: int, head: Head) -> None:
    """Remember the block before the first one that is read, as what a reorganisation can go back to."""
    if not history.blocks and 0 < cursor <= head.number + 1:
        before = await _block(node, cursor - 1)
        if before is not None:
            history.remember(Remembered(before.number, before.hash, ()))


async def _is_there(node: Node, block: Remembered, head: Head) -> bool:
    """Whether the chain that ends at `head` has the block."""
    if block.block_number == head.number:
        return block.block_hash == head.hash
    if block.block_number == head.number - 1:
        return block.block_hash == head.parent
    now = await _block(node, block.block_number)
    return now is not None and now.hash == block.block_hash


def _with_hash_of(block: Remembered, head: Head) -> Remembered:
    if block.block_number != head.number or block.block_hash == head.hash:
        return block
    if block.block_hash:
        raise _ReplacedMeanwhile
    return Remembered(block.block_number, head.hash, block.events)


async def _head(node: Node) -> Head:
    head = await _block(node, "latest")
    if head is None:
        raise NodeUnreachable(node.endpoint, "it has no blocks")
    return head


async def _block(node: Node, identifier: BlockIdentifier) -> Head | None:
    try:
        block = await node.web3.eth.get_block(identifier)
    except BlockNotFound:
        return None
    return Head(int(block["number"]), bytes(block["hash"]), bytes(block["parentHash"]))


async def _logs(node: Node, first: int, last: int, *, addresses: Collection[str], topics: Sequence[str]) -> list[Any]:
    query: dict[str, Any] = {"fromBlock": first, "toBlock": last, "topics": [list(topics)]}
    if addresses:
        query["address"] = list(addresses)
    return list(await node.web3.eth.get_logs(cast("FilterParams", query)))
