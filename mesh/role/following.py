"""Following the chain as a role does: from where it stopped, through outages, each block once, until cancelled.

A role says what events mean to it (`FollowsChain`), and `follow_chain` does the rest:

    position          where to go on: the cursor and the history that the role has stored (`RoleLedger`)
    for each block    a reorganisation: `on_revert` for each event that it reverts, the newest first; `on_reorganised`
                      the records of new liabilities are read in one call
                      `on_event` for each event, in the order of the chain
                      the cursor is stored (of quick blocks now and then), the head advances, `on_head`
    a failure         of the node, or a liability that it can't read any more: position again, after a delay

Handling is idempotent. Before the events of a block are handled, the history that has them is stored with the cursor
before it: after a crash the block is handled again, and if it is replaced by then, it is reverted like others.

**Without a stored cursor** (`store=None`), as for a provider, which begins at the head that it finds, the position is
that of the process: begin at `ChainHead(await chain.block_number())`, and pass it. After a failure the block that was
handled in part is handled again, as with a store. What a provider must know of blocks that were replaced while it was
away it asks of the chain when it meets an order.
"""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import aclosing
from typing import TYPE_CHECKING, Final, Protocol, Unpack

from mesh.base.log_context import log_event
from mesh.base.retry import Backoff
from mesh.chain import (
    ChainWentBack,
    History,
    NewLiability,
    NoContracts,
    NodeUnreachable,
    NotALiability,
    Reorganisation,
    RequestRefused,
)
from mesh.chain.following import FOLLOW_PACE, history_at
from mesh.telemetry.metrics import gauge

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from mesh.base.database import RoleLedger
    from mesh.base.outage_log import OutageLog
    from mesh.chain import BlockEvents, Chain, ChainEvent
    from mesh.chain.following import Selection
    from mesh.telemetry.metrics import MetricFamily
    from schemas import Liability

    Created = tuple[Liability, tuple[bytes, bytes]]

log = logging.getLogger(__name__)


class ChainHead:
    """How far a role has handled the chain: the number of its last block, and when that was.

    Events and reorganisations are of blocks of the chain, so compare them with `head`. Deadlines, refunds and turns are
    of blocks as contracts count them (`ContractBlocks`), so compare these with `contract_block`.
    """

    def __init__(self, head: int, contract_block: int | None = None) -> None:
        self._advanced = asyncio.Event()
        self.head = head
        self.advance_to(head, contract_block)
        self._handled = -1

    @classmethod
    async def at(cls, chain: Chain, block: int) -> ChainHead:
        """That of a role which begins after `block`. Raises the errors of the node."""
        return cls(block, await chain.node.contract_blocks.last(block))

    @property
    def contract_block(self) -> int:
        """The number of the last block as contracts count it."""
        return self.head if self._other is None else self._other

    def begin_after(self, block: int) -> None:
        """All blocks up to `block` were handled in earlier runs, or are older than this role."""
        self._handled = block
        self.head = max(self.head, block)
        self._advance()

    def advance_to(self, block: int, contract_block: int | None = None) -> None:
        """All of `block` has been handled. After a reorganisation it may be lower than before."""
        self.head = self._handled = block
        self._other = None if contract_block == block else contract_block
        self._advanced_at = time.monotonic()
        self._advance()

    async def reached(self, block: int) -> None:
        """Return when `block` has been handled."""
        while self._handled < block:
            await self._advanced.wait()

    def families(self) -> tuple[MetricFamily, ...]:
        """How far the chain was read, and when."""
        return (
            gauge("aira_chain_head_block", "The last block that was read", self.head),
            gauge(
                "aira_chain_read_age_seconds", "Seconds since a block was read", time.monotonic() - self._advanced_at
            ),
        )

    def _advance(self) -> None:
        self._advanced.set()
        self._advanced = asyncio.Event()


SAVE_SECONDS: Final = 5.0
"""How often a role saves how far it has read, where blocks are quick and nothing happens."""


class FollowsChain(Protocol):
    """What events mean to a role. All may be called again for the same event."""

    async def on_event(self, event: ChainEvent, created: Created | None, block: int) -> None:
        """Act on an event of a block. `created` is the record of a `NewLiability`, and the hashes of its two orders."""

    async def on_revert(self, event: ChainEvent) -> None:
        """Undo an event that a reorganisation has reverted."""

    async def on_reorganised(self, block: int) -> None:
        """The chain replaced all blocks after `block`: `on_revert` was called with all that this reverts."""

    async def on_head(self, block: int) -> None:
        """All of `block` was handled."""


async def first_position(store: RoleLedger, chain: Chain, *, lookback: int | None = None) -> int:
    """The last block that a role has handled. Later ones may concern what it did before.

    A new role begins at the head, or `lookback` blocks before, and remembers that block before it does anything: if it
    is replaced, what the role does next can be in an earlier one. With a `lookback` no role reads more blocks than
    that. Raises `ChainWentBack` if the chain lacks blocks that were handled, and more than it may replace.
    """
    (handled, _), head = await store.cursor(), await chain.block_number()
    start = max(head - (lookback or 0), 0)
    if handled is None or (lookback is not None and handled < start):
        await store.set_cursor(start, history=(await history_at(chain.node, start)).encode())
        return start
    if handled > head + chain.node.timing.reorg_depth:
        raise ChainWentBack(handled + 1, head)
    return handled


async def follow_chain(
    role: FollowsChain,
    chain: Chain,
    head: ChainHead,
    outages: OutageLog,
    *,
    store: RoleLedger | None = None,
    read: Callable[[Sequence[str]], Awaitable[Sequence[Created]]] | None = None,
    **selection: Unpack[Selection],
) -> None:
    """Tell a role what happens, until cancelled. Events are selected as in `Chain.follow`, by default of no `parties`.

    `read` reads the records of new liabilities, by default all in one call.

    Raises `ChainWentBack`, and what the role raises, but for a node that is away.
    """
    read = read or chain.liabilities.get_all_with_orders
    selection.setdefault("parties", ())
    kept, backoff = History(chain.node.timing.reorg_depth), Backoff(chain.node.timing.outage_retry)
    pace, save_at = SAVE_SECONDS if chain.node.profile.block_seconds < FOLLOW_PACE.quick else 0.0, 0.0
    while True:
        last, history = await _position(chain, head, kept, store)
        try:
            blocks = chain.follow(last + 1, history=history, outages=outages, **selection)
            async with aclosing(blocks):
                async for block in blocks:
                    contract_block = await chain.node.contract_blocks.last(block.block_number)  # first: it may fail
                    await _take_block(role, read, block, history, store)
                    is_news = bool(block.events) or isinstance(block, Reorganisation)
                    if store is not None and (is_news or time.monotonic() >= save_at):
                        await store.set_cursor(block.block_number, history=history.encode())
                        save_at = time.monotonic() + pace
                    head.advance_to(block.block_number, contract_block)
                    await role.on_head(block.block_number)
                    backoff.reset()
        except (NodeUnreachable, RequestRefused, NotALiability, NoContracts) as error:
            # If a liability can't be read because a reorganisation took it away, that is what comes next.
            outages.failed(error, f"the chain can't be read on from block {head.head + 1}")
            await backoff.wait()


async def _position(chain: Chain, head: ChainHead, kept: History, store: RoleLedger | None) -> tuple[int, History]:
    """The last block that was handled, and the history up to it."""
    if store is None:
        return head.head, kept
    last, encoded = await store.cursor()
    assert last is not None, "`first_position` sets it"
    depth = chain.node.timing.reorg_depth
    history = History.decode(encoded) if encoded else History(depth)
    history.depth = depth  # the setting may have changed
    head.begin_after(last)
    return last, history


async def _take_block(
    role: FollowsChain,
    read: Callable[[Sequence[str]], Awaitable[Sequence[Created]]],
    block: BlockEvents,
    history: History,
    store: RoleLedger | None,
) -> None:
    if isinstance(block, Reorganisation):
        facts = log_event("chain-reorganised", block=block.block_number, events=len(block.reverted_events))
        log.warning("the chain replaced all blocks after %d", block.block_number, extra=facts)
        for event in block.reverted_events:
            await role.on_revert(event)
        await role.on_reorganised(block.block_number)
    if block.events:
        if store is not None:
            await store.set_cursor(block.block_number - 1, history=history.encode())
        new = [event.liability for event in block.events if isinstance(event, NewLiability)]
        created = dict(zip(new, await read(new), strict=True)) if new else {}
        for event in block.events:
            record = created[event.liability] if isinstance(event, NewLiability) else None
            await role.on_event(event, record, block.block_number)
