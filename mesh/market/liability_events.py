"""The events of one lighthouse's liabilities, and what they change: book, withdrawals, messages under settlement."""

from __future__ import annotations

import logging
import time
from contextlib import aclosing
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
from mesh.log_context import liability_context, log_event
from mesh.outage_log import OutageLog
from mesh.retry import Backoff
from schemas import Demand, Offer, Result, address_bytes

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.chain import BlockEvents, Chain
    from mesh.market.book import OrderBook
    from mesh.market.earnings import EarningsLedger
    from mesh.market.unconfirmed import Unconfirmed
    from mesh.market.withdrawals import Withdrawals
    from schemas import Liability, Verified

log = logging.getLogger(__name__)

OPEN_LIABILITIES: Final = 65_536
"""Records of liabilities that are kept until they are finalized; others are read when their result arrives."""


class LiabilityEvents:
    """Reads the events of the liabilities at `lighthouse` (address) after block `head`: `await events.follow()`.

    `reverted` is called with each message that must be settled again, because a reorganisation reverted its effect.
    """

    def __init__(
        self,
        chain: Chain,
        lighthouse: str,
        *,
        book: OrderBook,
        unconfirmed: Unconfirmed,
        withdrawals: Withdrawals,
        earnings: EarningsLedger,
        head: int,
        reverted: Callable[[Verified[Any]], None],
        open_limit: int = OPEN_LIABILITIES,
    ) -> None:
        self.head, self.read_at = head, time.monotonic()
        """The latest block that was read, and when, on the monotonic clock."""
        self.outages: Final = OutageLog(log, "chain")
        """Outages of the node while the chain is followed."""
        self.open: Final[dict[str, Liability]] = {}
        """Liabilities that were not finalized when they were read, by address; `open_limit` of them at most."""
        self._chain = chain
        self._lighthouse = lighthouse
        self._book = book
        self._unconfirmed = unconfirmed
        self._withdrawals = withdrawals
        self._earnings = earnings
        self._reverted = reverted
        self._open_limit = open_limit
        self._history = History(chain.node.timing.reorg_depth)

    async def follow(self) -> None:
        """Read until cancelled, through outages of the node."""
        backoff = Backoff(self._chain.node.timing.outage_retry)
        while True:
            try:
                blocks = self._chain.follow(self.head + 1, history=self._history, outages=self.outages)
                async with aclosing(blocks):
                    async for block in blocks:
                        if isinstance(block, Reorganisation):
                            self._revert(block)
                        else:
                            await self._take_block(block)
                        backoff.reset()
            except (NodeUnreachable, RequestRefused, NotALiability, NoContracts) as error:
                # A liability can't be read. If a reorganisation took it away, that is what comes next.
                self.outages.failed(error, f"the chain can't be read on from block {self.head + 1}")
                await backoff.wait()

    def creation_reverted(self, address: str, tx: str) -> None:
        """A reorganisation reverted the liability that a transaction created."""
        with liability_context(address):
            log.warning("a reorganisation reverted the contract", extra=log_event("contract-reverted"))
        self._earnings.reverted(tx)

    async def _take_block(self, block: BlockEvents) -> None:
        for event in block.events:
            if isinstance(event, NewLiability | Finalized):
                self._earnings.mined(event.tx)
            if isinstance(event, NewLiability):
                await self._take_created(event.liability, block.block_number)
            elif isinstance(event, Finalized):
                self.open.pop(event.liability, None)
                self._unconfirmed.finalized(event.liability, block.block_number)
        self.head, self.read_at = block.block_number, time.monotonic()
        self._unconfirmed.confirm(self.head)
        self._withdrawals.expire(self.head)
        for order in self._book.expire(self.head):
            expired = log_event("order-expired", order=order.hash.hex(), signer=order.signer)
            log.info("expired order %s of %s", order.hash.hex(), order.signer, extra=expired)

    async def _take_created(self, address: str, block: int) -> None:
        """Take the orders of a new liability, created in that block, out of the book."""
        liability = await self._chain.liabilities.get(address)
        if liability.lighthouse != self._lighthouse:
            return
        demand_hash, offer_hash = await self._chain.liabilities.order_hashes(address)
        for digest, signer in ((demand_hash, liability.promisee), (offer_hash, liability.promisor)):
            identity = digest + address_bytes(signer)
            order = self._book.remove(identity) or self._unconfirmed.get(identity)
            if order is not None:
                self._unconfirmed.created(address, block, order)
        if not liability.is_finalized:
            self.open[address] = liability
            if len(self.open) > self._open_limit:
                del self.open[next(iter(self.open))]

    def _revert(self, block: Reorganisation) -> None:
        """Settle again what a reorganisation reverted. What happened again by itself, the contracts refuse."""
        self.head = block.block_number
        created = [event for event in block.reverted_events if isinstance(event, NewLiability)]
        finalized = [event for event in block.reverted_events if isinstance(event, Finalized)]
        counts = {"created": len(created), "finalized": len(finalized)}
        event = log_event("chain-reorganised", head=self.head, **counts)
        log.warning("a reorganisation reverted %d new contracts, %d finalizations", *counts.values(), extra=event)
        again: list[Verified[Any]] = []
        for creation in created:
            self.creation_reverted(creation.liability, creation.tx)
            self.open.pop(creation.liability, None)
            again += self._unconfirmed.reverted(creation.liability, Demand, Offer)
        for end in finalized:
            self._earnings.reverted(end.tx)
            again += self._unconfirmed.reverted(end.liability, Result)
        for message in again:
            self._reverted(message)
