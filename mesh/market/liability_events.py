"""The events of one lighthouse's liabilities, and what they change: book, withdrawals, messages under settlement."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import aclosing
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
from mesh.flood import BoundedDict
from mesh.log_context import log_event
from mesh.market.unconfirmed import Unconfirmed
from mesh.outage_log import OutageLog
from mesh.retry import Backoff
from schemas import Demand, Offer, Result, address_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from mesh.chain import BlockEvents, Chain
    from mesh.market.book import OrderBook
    from mesh.market.earnings import EarningsLedger
    from mesh.market.versions import OrderVersions
    from mesh.market.withdrawals import Withdrawals
    from schemas import Liability, Verified

log = logging.getLogger(__name__)

OPEN_LIABILITIES: Final = 65_536
"""Records of liabilities that are kept until they are finalized; others are read when their result arrives."""
MISSING_CHECKS: Final = 3
"""Checks in a row that find no trace of a mined transaction before it is sent again: one node may be behind another."""


class LiabilityEvents:
    """Reads the events of the liabilities at `lighthouse` (address) after block `head`."""

    def __init__(
        self,
        chain: Chain,
        lighthouse: str,
        *,
        book: OrderBook,
        versions: OrderVersions,
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
        self._versions = versions
        self._withdrawals = withdrawals
        self._earnings = earnings
        self._forget = forget
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

    def note(self, order: Verified[Demand | Offer]) -> None:
        """Remember which version of an order this is. The one that it replaces leaves the book."""
        if (replaced := self._versions.note(order)) is not None:
            self._book.remove(replaced)

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

    async def liabilities(self, addresses: Sequence[str]) -> Mapping[str, Liability]:
        """The records of the liabilities that the node knows among these addresses."""
        known = {address: liability for address in addresses if (liability := self.open.get(address)) is not None}
        unknown = [address for address in dict.fromkeys(addresses) if address not in known]
        if not unknown:
            return known
        try:
            read = partial(self._chain.liabilities.find_all, unknown)
            return known | await self._chain.retrying(read, outages=self.lookups, errors=(NodeUnreachable,))
        except (NoContracts, RequestRefused) as error:  # or a reorganisation took one
            log.debug("results wait to be sent again: %s", error)
            return known

    async def is_used(self, order: Verified[Demand | Offer]) -> bool:
        """Whether an order became a liability, or was withdrawn on the chain."""
        ask = partial(self._chain.liabilities.is_used, order.message, order_hash=order.hash, signer=order.signer)
        try:
            return await self._chain.retrying(ask, outages=self.lookups, errors=(NodeUnreachable,))
        except RequestRefused:
            return False  # a used order is rejected when its next match fails

    async def _take_block(self, block: BlockEvents) -> None:
        await self._count_transactions(block.block_number)
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
        await self._versions.expire(block.block_number)
        self.head, self.read_at = block.block_number, time.monotonic()
        self.unconfirmed.confirm(self.head)
        self._withdrawals.expire(self.head - self._chain.node.timing.reorg_depth)
        for order in self._book.expire(self.head):
            self._forget(order)  # its deadline may be later than the book's limit
            facts = {"order": order.hash.hex(), "signer": order.signer}
            log.info("expired order %(order)s of %(signer)s", facts, extra=log_event("order-expired", **facts))

    async def _count_transactions(self, head: int) -> None:
        """Note which transactions of the account are not mined at a block, if an order waits for one."""
        account = self._chain.account
        if account is None or not self._versions.need_count():
            return
        count = partial(self._chain.node.transaction_count, account.address)
        mined, pending = 0, None
        try:
            mined, waiting = await asyncio.gather(count(block=head), count(block="pending"))
        except RequestRefused as error:  # a node that is behind, or met a reorganisation
            log.debug("the account's transactions can't be counted: %s", error)
        else:
            # While later ones wait, a transaction that the node has lost is sent again.
            pending = None if self._chain.node.pending_transactions(account.address).taken else waiting
        self._versions.counted(mined, pending, head)

    def _take_created(self, liability: Liability, order_hashes: tuple[bytes, bytes], block: int) -> None:
        """Take the orders of a new liability, created in that block, out of the book."""
        if liability.lighthouse != self._lighthouse:
            return
        for digest, signer in zip(order_hashes, (liability.promisee, liability.promisor), strict=True):
            self._book.known.add(signer)
            identity = digest + address_bytes(signer)
            if (newest := self._versions.use(identity, liability.address)) is not None:
                self._book.remove(newest)
            order = self._book.remove(identity) or self.unconfirmed.get(identity)
            if order is not None:
                self.unconfirmed.created(liability.address, block, order)
        if not liability.is_finalized:
            self.open[liability.address] = liability

    def _revert(self, block: Reorganisation) -> list[Verified[Any]]:
        """The messages whose effect a reorganisation reverted. The contracts refuse those that were used again."""
        before, self.head = self.head, block.block_number
        self._versions.reorganised(self.head, before)
        created = [event for event in block.reverted_events if isinstance(event, NewLiability)]
        finalized = [event for event in block.reverted_events if isinstance(event, Finalized)]
        facts = log_event("chain-reorganised", head=self.head, created=len(created), finalized=len(finalized))
        log.warning("a reorganisation reverted %d contracts, %d payments", len(created), len(finalized), extra=facts)
        again: list[Verified[Any]] = []
        for creation in created:
            self._earnings.creation_reverted(creation.liability, creation.tx)
            self.open.pop(creation.liability, None)
            self._versions.free(creation.liability, before)
            again += self.unconfirmed.reverted(creation.liability, Demand, Offer)
        for end in finalized:
            self._earnings.reverted(end.tx)
            again += self.unconfirmed.reverted(end.liability, Result)
        return again
