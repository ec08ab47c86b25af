"""The events of one lighthouse's liabilities, and what they change: book, withdrawals, messages under settlement.

A message is under settlement while it is being sent to the chain, and afterwards until the event of its liability is so
deep in the followed chain that no reorganisation is expected to take it back.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from contextlib import aclosing
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.chain import (
    Finalized,
    History,
    NewLiability,
    NoContracts,
    NodeUnreachable,
    NotALiability,
    Reorganisation,
    RequestRefused,
)
from mesh.flood import BoundedDict, KnownSenders
from mesh.log_context import log_event
from mesh.market.book import order_id
from mesh.outage_log import OutageLog
from mesh.retry import Backoff
from schemas import Demand, Offer, Result, address_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from mesh.chain import BlockEvents, Chain
    from mesh.market.book import OrderBook
    from mesh.market.earnings import EarningsLedger
    from mesh.market.withdrawals import Withdrawals
    from schemas import Liability, Verified

log = logging.getLogger(__name__)

OPEN_LIABILITIES: Final = 65_536
"""Records of liabilities that are kept until they are finalized; others are read when their result arrives."""
USED_KEPT: Final = 8192
"""Used messages that are kept, at most: those of the blocks that a reorganisation may replace."""
MISSING_CHECKS: Final = 3
"""Checks in a row that find no trace of a mined transaction before it is sent again: one node may be behind another."""


@dataclass(slots=True)
class _Entry:
    message: Verified[Any]
    is_sending: bool = False
    """A transaction for the message waits, or waits for its event."""
    liability: str = ""
    block: int = 0
    """The block of the event that used the message; 0 while none was read."""


class Unconfirmed:
    """The messages under settlement; used ones are kept until their event is `depth` blocks deep, `limit` at most.

    `order_id` identifies a message.
    """

    def __init__(self, depth: int, *, limit: int = USED_KEPT) -> None:
        self._depth = depth
        self._limit = limit
        self._entries: dict[bytes, _Entry] = {}
        self._at: dict[str, set[bytes]] = {}
        """By liability: the messages that were used there, and the results for it."""
        self._used: deque[tuple[int, bytes]] = deque()
        """Block and message of each event that was read, the oldest first."""

    def __contains__(self, message: Verified[Any]) -> bool:
        return order_id(message) in self._entries

    def get(self, identity: bytes) -> Verified[Any] | None:
        """The message with this identity; None if it is not under settlement."""
        return entry.message if (entry := self._entries.get(identity)) else None

    def begin(self, *messages: Verified[Any]) -> None:
        """A transaction with these messages will be sent."""
        for message in messages:
            entry = self._entries.setdefault(order_id(message), _Entry(message))
            entry.is_sending = True
            if isinstance(message.message, Result):
                self._place(entry, message.message.liability)

    def end(self, message: Verified[Any]) -> bool:
        """No transaction with the message waits any more. It is forgotten, and False returned, unless it was used."""
        entry = self._entries[order_id(message)]
        entry.is_sending = False
        if entry.block:
            self._used.append((entry.block, order_id(message)))
        else:
            self._remove(entry)
        return entry.block > 0

    def created(self, liability: str, block: int, *orders: Verified[Any]) -> None:
        """The event of a new liability was read, which these orders were used for."""
        for order in orders:
            entry = self._entries.setdefault(order_id(order), _Entry(order))
            self._place(entry, liability)
            self._mark(entry, block)

    def finalized(self, liability: str, block: int) -> None:
        """The event of a liability's end was read."""
        for entry in self._entries_at(liability, (Result,)):
            self._mark(entry, block)

    def reverted(self, liability: str, *kinds: type[Any]) -> list[Verified[Any]]:
        """An event of the liability was reverted: its messages of these kinds that must be settled again, and leave.

        Those with a transaction that waits stay: its sender notices.
        """
        again = []
        for entry in self._entries_at(liability, kinds):
            entry.block = 0
            if not entry.is_sending:
                self._remove(entry)
                again.append(entry.message)
        return again

    def is_read(self, message: Verified[Any], *, until: int) -> bool:
        """Whether an event that used the message was read, in block `until` or before."""
        return 0 < self._entries[order_id(message)].block <= until

    def confirm(self, head: int) -> None:
        """Forget the messages whose event is so deep below block `head` that it stays."""
        while self._used and (self._used[0][0] <= head - self._depth or len(self._used) > self._limit):
            block, identity = self._used.popleft()
            entry = self._entries.get(identity)
            if entry is not None and entry.block == block and not entry.is_sending:
                self._remove(entry)

    def _mark(self, entry: _Entry, block: int) -> None:
        entry.block = block
        if not entry.is_sending:
            self._used.append((block, order_id(entry.message)))

    def _place(self, entry: _Entry, liability: str) -> None:
        """Note where a message is used; an empty `liability` means nowhere."""
        identity = order_id(entry.message)
        if (placed := self._at.get(entry.liability)) is not None:
            placed.discard(identity)
            if not placed:
                del self._at[entry.liability]
        entry.liability = liability
        if liability:
            self._at.setdefault(liability, set()).add(identity)

    def _remove(self, entry: _Entry) -> None:
        self._place(entry, "")
        del self._entries[order_id(entry.message)]

    def _entries_at(self, liability: str, kinds: tuple[type[Any], ...]) -> list[_Entry]:
        entries = [self._entries[identity] for identity in self._at.get(liability, ())]
        return [entry for entry in entries if isinstance(entry.message.message, kinds)]


class LiabilityEvents:
    """Reads the events of the liabilities at `lighthouse` (address) after block `head`."""

    def __init__(
        self,
        chain: Chain,
        lighthouse: str,
        *,
        book: OrderBook,
        withdrawals: Withdrawals,
        earnings: EarningsLedger,
        head: int,
        forget: Callable[[Verified[Any]], None],
        open_limit: int = OPEN_LIABILITIES,
    ) -> None:
        self.head, self.read_at = head, time.monotonic()
        """The latest block that was read, and when, on the monotonic clock."""
        self.outages, self.lookups = OutageLog(log, "chain"), OutageLog(log, "node")
        """Outages of the node while the chain is followed, and while single facts are asked of it."""
        self.open: Final[BoundedDict[str, Liability]] = BoundedDict(open_limit)
        """Liabilities that were not finalized when they were read, by address; `open_limit` of them at most."""
        self.unconfirmed: Final = Unconfirmed(chain.node.timing.reorg_depth)
        """The messages under settlement."""
        self._chain = chain
        self._lighthouse = lighthouse
        self._book = book
        self._withdrawals = withdrawals
        self._earnings = earnings
        self._forget = forget
        self.parties: Final = KnownSenders()
        """Accounts that a liability was created for."""
        self._history = History(chain.node.timing.reorg_depth)

    async def follow(self, reverted: Callable[[Verified[Any]], None]) -> None:
        """Read until cancelled, through outages of the node.

        `reverted` is called with each message that must be settled again, because a reorganisation reverted its effect.
        """
        backoff = Backoff(self._chain.node.timing.outage_retry)
        while True:
            try:
                blocks = self._chain.follow(self.head + 1, history=self._history, parties=(), outages=self.outages)
                async with aclosing(blocks):
                    async for block in blocks:
                        if isinstance(block, Reorganisation):
                            for message in self._revert(block):
                                reverted(message)
                        else:
                            await self._take_block(block)
                        backoff.reset()
            except (NodeUnreachable, RequestRefused, NotALiability, NoContracts) as error:
                # A liability can't be read. If a reorganisation took it away, that is what comes next.
                self.outages.failed(error, f"the chain can't be read on from block {self.head + 1}")
                await backoff.wait()

    async def is_confirmed(self, messages: Sequence[Verified[Any]], tx: str) -> bool:
        """Wait until the event that used the messages has its confirmations; False if their transaction vanished."""
        timing, missing = self._chain.node.timing, 0
        has_mined = partial(self._chain.node.has_mined, tx)
        while missing < MISSING_CHECKS:
            if all(self.unconfirmed.is_read(one, until=self.head - timing.confirmations + 1) for one in messages):
                return True
            await asyncio.sleep(timing.poll_interval)
            is_there = all(self.unconfirmed.is_read(one, until=self.head) for one in messages)
            missing = 0 if is_there or await self._chain.retrying(has_mined, outages=self.lookups) else missing + 1
        return False

    async def liability(self, address: str) -> Liability | None:
        """The record of a liability; None while the node knows none at that address."""
        if (known := self.open.get(address)) is not None:
            return known
        try:
            read = partial(self._chain.liabilities.get, address)
            return await self._chain.retrying(read, outages=self.lookups, errors=(NodeUnreachable,))
        except (NotALiability, NoContracts, RequestRefused) as error:  # or a reorganisation took it
            log.debug("a result waits to be sent again: %s", error)
            return None

    async def is_used(self, order: Verified[Demand | Offer]) -> bool:
        """Whether an order became a liability, or was withdrawn on the chain."""
        ask = partial(self._chain.liabilities.is_used, order.message, order_hash=order.hash, signer=order.signer)
        try:
            return await self._chain.retrying(ask, outages=self.lookups, errors=(NodeUnreachable,))
        except RequestRefused:
            return False  # a used order is rejected when its next match fails

    async def _take_block(self, block: BlockEvents) -> None:
        created = [event.liability for event in block.events if isinstance(event, NewLiability)]
        records = dict(zip(created, await self._chain.liabilities.get_all_with_orders(created), strict=True))
        for event in block.events:
            if isinstance(event, NewLiability | Finalized):
                self._earnings.mined(event.tx)
            if isinstance(event, NewLiability):
                self._take_created(*records[event.liability], block.block_number)
            elif isinstance(event, Finalized):
                self.open.pop(event.liability, None)
                self.unconfirmed.finalized(event.liability, block.block_number)
        self.head, self.read_at = block.block_number, time.monotonic()
        self.unconfirmed.confirm(self.head)
        self._withdrawals.expire(self.head)
        for order in self._book.expire(self.head):
            self._forget(order)  # its deadline may be later than the book's limit
            facts = {"order": order.hash.hex(), "signer": order.signer}
            log.info("expired order %(order)s of %(signer)s", facts, extra=log_event("order-expired", **facts))

    def _take_created(self, liability: Liability, order_hashes: tuple[bytes, bytes], block: int) -> None:
        """Take the orders of a new liability, created in that block, out of the book."""
        if liability.lighthouse != self._lighthouse:
            return
        for digest, signer in zip(order_hashes, (liability.promisee, liability.promisor), strict=True):
            self.parties.add(signer)
            identity = digest + address_bytes(signer)
            order = self._book.remove(identity) or self.unconfirmed.get(identity)
            if order is not None:
                self.unconfirmed.created(liability.address, block, order)
        if not liability.is_finalized:
            self.open[liability.address] = liability

    def _revert(self, block: Reorganisation) -> list[Verified[Any]]:
        """The messages whose effect a reorganisation reverted. The contracts refuse those that were used again."""
        self.head = block.block_number
        created = [event for event in block.reverted_events if isinstance(event, NewLiability)]
        finalized = [event for event in block.reverted_events if isinstance(event, Finalized)]
        facts = log_event("chain-reorganised", head=self.head, created=len(created), finalized=len(finalized))
        log.warning("a reorganisation reverted %d contracts, %d payments", len(created), len(finalized), extra=facts)
        again: list[Verified[Any]] = []
        for creation in created:
            self._earnings.creation_reverted(creation.liability, creation.tx)
            self.open.pop(creation.liability, None)
            again += self.unconfirmed.reverted(creation.liability, Demand, Offer)
        for end in finalized:
            self._earnings.reverted(end.tx)
            again += self.unconfirmed.reverted(end.liability, Result)
        return again
