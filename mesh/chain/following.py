"""Following the chain, and what happens in a reorganisation. Whatever reads events as they happen does it here.

    async with aclosing(chain.follow(cursor, history=history)) as blocks:
        async for block in blocks:
            if isinstance(block, Reorganisation):
                undo(block.reverted_events)
            handle(block.events)
            save(block.block_number + 1, history.encode())

**What is yielded.** A `BlockEvents` for each block that has events, with its events in the order of the chain, and for
some blocks that have none, so that the consumer knows how far the chain was read. Block numbers only grow, except
after a reorganisation. A block is yielded as soon as the node has it: waiting for confirmations is up to the consumer.

**In a reorganisation** the chain replaces its last blocks. A `Reorganisation` is then yielded before anything else.
Its `block_number` is the last block that is still as it was yielded; its `reverted_events` are all events that were
yielded from later blocks, the newest first. The consumer must undo them in that order. The blocks that replace the
old ones follow: an event that happened on both sides is reverted first and then yielded again. A chain that is only
shorter has replaced nothing yet (the node may be behind), so nothing is reverted before the new blocks are there.

**The cursor** is the next block to read: always `block.block_number + 1` of what was yielded last, also for a
`Reorganisation`. A consumer that fails while it handles a block starts again from the cursor it saved, and gets that
block again: handling must be idempotent.

**The history** (`History`) holds the hashes and events of the last `Timing.reorg_depth` blocks that were yielded.
Hashes are compared with the chain's to notice a reorganisation; the events are what it reverts. `follow` fills the
history that it is given. Save it with the cursor and pass it again after a restart: blocks that were replaced in the
meantime are then reverted first. Without one, only a reorganisation that happens while following is noticed:
`history_at` is for a consumer that must know of each since it decided where to begin.

**When the node fails**, the failure is logged once (`OutageLog`) and reading continues from the cursor as soon as the
node answers, with the backoff `Timing.outage_retry`. What stops `follow` is a chain that can't be the one that was
read: `ChainWentBack` (the cursor is past its end) and `ReorganisedTooDeep` (no block of the history is on it).
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import aclosing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from mesh.chain.errors import ChainWentBack, NoContracts, NodeUnreachable, ReorganisedTooDeep, RequestRefused
from mesh.chain.events import EVENT_CLASSES, ChainEvent
from mesh.chain.policy import REORG_DEPTH
from mesh.chain.reader import RangeReader, ReplacedWhileReading, SeenBlock
from mesh.errors import ConfigurationError, InputError
from mesh.outage_log import OutageLog
from mesh.retry import Backoff

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable

    from mesh.chain.answers import BlockHeader
    from mesh.chain.node import Node
    from mesh.chain.reader import ReadRange
    from mesh.errors import AiraError

log = logging.getLogger(__name__)

T = TypeVar("T")

NODE_ERRORS: Final = (NodeUnreachable, RequestRefused)
"""A node that is gone, or that can't answer for now."""

READ_ERRORS: Final = (*NODE_ERRORS, NoContracts)
"""A node that is behind the one that was asked before also lacks its newest contracts."""


@dataclass(frozen=True, slots=True)
class BlockEvents:
    """The events of a block, in order. Everything up to `block_number` has been read: the next cursor is one more."""

    block_number: int
    events: tuple[ChainEvent, ...]


@dataclass(frozen=True, slots=True)
class Reorganisation(BlockEvents):
    """The chain replaced all blocks after `block_number`; `reverted_events`, the newest first, did not happen.

    `events` is empty. The blocks that replace the old ones are yielded next.
    """

    reverted_events: tuple[ChainEvent, ...] = ()


class History:
    """The last blocks that `follow` yielded, back to `depth` blocks behind the newest.

    It holds every block with events, and the newest one without. One more block is kept below the depth: what a
    reorganisation of the whole depth goes back to. Raises `ConfigurationError` for a depth below 1.
    """

    def __init__(self, depth: int = REORG_DEPTH) -> None:
        if depth < 1:
            raise ConfigurationError("a history remembers at least one block")
        self.depth = depth
        self._blocks: list[SeenBlock] = []

    @property
    def blocks(self) -> tuple[SeenBlock, ...]:
        """The remembered blocks, the oldest first."""
        return tuple(self._blocks)

    def remember(self, block: SeenBlock) -> None:
        """Add a block, unless it is not newer than the others, and forget those that are now too old."""
        if self._blocks and block.block_number <= self._blocks[-1].block_number:
            return
        self._blocks.append(block)
        oldest = block.block_number - self.depth
        while len(self._blocks) > 1 and self._blocks[1].block_number <= oldest:
            del self._blocks[0]

    def forget_above(self, block_number: int) -> tuple[ChainEvent, ...]:
        """Forget the blocks above a number; their events, the newest first."""
        gone = [block for block in self._blocks if block.block_number > block_number]
        del self._blocks[len(self._blocks) - len(gone) :]
        return tuple(event for block in reversed(gone) for event in reversed(block.events))

    def encode(self) -> bytes:
        """The history as JSON."""
        blocks = [
            (block.block_number, block.block_hash.hex(), [(type(event).__name__, event) for event in block.events])
            for block in self._blocks
        ]
        return msgspec.json.encode({"depth": self.depth, "blocks": blocks})

    @classmethod
    def decode(cls, data: bytes) -> History:
        """The history that `encode` returned as `data`. Raises `InputError` for anything else."""
        try:
            decoded = msgspec.json.decode(data)
            history = cls(decoded["depth"])
            for number, block_hash, events in decoded["blocks"]:
                of_block: Any = tuple(msgspec.convert(fields, EVENT_CLASSES[name]) for name, fields in events)
                history.remember(SeenBlock(int(number), bytes.fromhex(block_hash), of_block))
        except (msgspec.MsgspecError, KeyError, TypeError, ValueError, ConfigurationError) as error:
            raise InputError(f"this is not a chain history ({error})", hint="start with an empty one") from None
        return history


async def history_at(node: Node, block_number: int) -> History:
    """The history of a consumer that has read nothing yet and begins after a block: `follow` notices its replacement.

    It holds that block and earlier ones, at twice the distance each time and at last a whole depth below it. If blocks
    are replaced, reading goes back to the newest of these that was not. Raises `NodeUnreachable` if the node lacks one.
    """
    history = History(node.timing.reorg_depth)
    distances = [0, *(1 << power for power in range(history.depth.bit_length())), history.depth]
    numbers = sorted({block_number - min(distance, history.depth, block_number) for distance in distances})
    for number, block_hash in zip(numbers, await asyncio.gather(*map(node.block_hash, numbers)), strict=True):
        history.remember(SeenBlock(number, block_hash, ()))
    return history


async def follow(
    node: Node, read: ReadRange, cursor: int, *, history: History | None = None, outages: OutageLog | None = None
) -> AsyncGenerator[BlockEvents, None]:
    """The events from the block `cursor` on, as `read` finds them, without end; see the module.

    Raises `ChainWentBack` and `ReorganisedTooDeep`. Other failures of the node are retried and logged to `outages`.
    """
    follower = _Follower(node, read, cursor, history or History(node.timing.reorg_depth))
    outages = outages or OutageLog(log, "chain")
    backoff = Backoff(node.timing.outage_retry)
    while True:
        try:
            async with aclosing(follower.read_to_head()) as blocks:
                async for block in blocks:
                    outages.recovered(f"the chain can be read again, from block {block.block_number}")
                    backoff.reset()
                    yield block
        except READ_ERRORS as error:
            outages.failed(error, f"the chain can't be read on from block {follower.cursor}, trying again")
            follower.must_check_cursor = True
            await backoff.wait()
        else:
            outages.recovered(f"the chain can be read again, from block {follower.cursor}")
            backoff.reset()


async def retrying(
    node: Node,
    question: Callable[[], Awaitable[T]],
    *,
    outages: OutageLog | None = None,
    errors: tuple[type[AiraError], ...] = NODE_ERRORS,
) -> T:
    """The answer to a question to the node, asked again after each of `errors` with `Timing.outage_retry`.

    The outage is logged to `outages`. Other errors are raised.
    """
    outages = outages or OutageLog(log, "chain")
    backoff = Backoff(node.timing.outage_retry)
    while True:
        try:
            answer = await question()
        except errors as error:
            outages.failed(error, "the chain can't be read, trying again")
            await backoff.wait()
        else:
            outages.recovered("the chain can be read again")
            return answer


class _Follower:
    """The state of one `follow`: its cursor and its history."""

    def __init__(self, node: Node, read: ReadRange, cursor: int, history: History) -> None:
        self.cursor = cursor
        self.must_check_cursor = True
        self._seen = b""
        """The hash of the head that was read last."""
        self._node = node
        self._history = history
        self._ranges = RangeReader(node, read)

    async def read_to_head(self) -> AsyncGenerator[BlockEvents, None]:
        """Wait for a new head, and read to it: first what the chain has replaced, then the new blocks."""
        head = await (self._node.heads.look() if self.must_check_cursor else self._node.heads.next(self._seen))
        self._seen = head.hash
        if self.must_check_cursor:
            await self._check_cursor(head)
            self.must_check_cursor = False
        replaced = await self._find_replaced(head)
        if replaced is not None:
            self.cursor = min(self.cursor, replaced.block_number + 1)
            yield replaced
        self._history.forget_above(self.cursor - 1)
        if not self._history.blocks and 0 < self.cursor <= head.number + 1:
            for block in (await history_at(self._node, self.cursor - 1)).blocks:
                self._history.remember(block)
        try:
            async with aclosing(self._ranges.read_to(self.cursor, head)) as blocks:
                async for block in blocks:
                    if block.block_hash:
                        self._history.remember(block)
                    self.cursor = block.block_number + 1
                    yield BlockEvents(block.block_number, block.events)
        except ReplacedWhileReading:
            self.must_check_cursor = True  # the next call finds what was replaced
            await asyncio.sleep(self._node.timing.poll_interval)

    async def _check_cursor(self, head: BlockHeader) -> None:
        """Raise `ChainWentBack` if the cursor is past the head, unless the node is a few blocks behind another."""
        if self.cursor <= head.number + 1:
            return
        if self.cursor - 1 - head.number <= self._history.depth:
            for block in reversed(self._history.blocks):
                if block.block_number <= head.number and await self._is_on_chain(block, head):
                    return
        raise ChainWentBack(self.cursor, head.number)

    async def _find_replaced(self, head: BlockHeader) -> Reorganisation | None:
        """What the chain has replaced of the history; None if it only grew, or is shorter. Raises as `follow` does."""
        known = [block for block in self._history.blocks if block.block_number <= head.number]
        for block in reversed(known):
            if await self._is_on_chain(block, head):
                if block is known[-1]:
                    return None
                return Reorganisation(block.block_number, (), self._history.forget_above(block.block_number))
        if known:
            raise ReorganisedTooDeep(known[0].block_number, head.number)
        return None

    async def _is_on_chain(self, block: SeenBlock, head: BlockHeader) -> bool:
        """Whether the chain that ends at `head` has the block."""
        if block.block_number == head.number:
            return block.block_hash == head.hash
        if block.block_number == head.number - 1:
            return block.block_hash == head.parent_hash
        return await self._node.block_hash(block.block_number) == block.block_hash
