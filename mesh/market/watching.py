"""What the chain says of a market: contracts that were made and have ended, and what it takes back."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import aclosing
from typing import TYPE_CHECKING, Final

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
from mesh.market.sending import RETRY
from mesh.outage_log import OutageLog
from mesh.telemetry.context import liability_context, log_event
from schemas import Demand, Offer, Result, address_bytes

if TYPE_CHECKING:
    from mesh.chain import BlockEvents, Chain
    from mesh.market.book import OrderBook
    from mesh.market.contracting import Contracting, ProviderCallbacks
    from mesh.market.earnings import EarningsLedger
    from mesh.market.settled import SettledMessages
    from schemas import Liability

log = logging.getLogger(__name__)

OPEN: Final = 65_536
"""Records of contracts that are kept until they end; those of older ones are read again when their Result comes."""


class Watching:
    """Reads the chain for the provider of the lighthouse at the address `lighthouse`, from after block `head`."""

    def __init__(
        self,
        chain: Chain,
        lighthouse: str,
        desk: ProviderCallbacks,
        *,
        head: int,
        book: OrderBook,
        contracting: Contracting,
        books: EarningsLedger,
        used: SettledMessages,
    ) -> None:
        self.head = head
        """The latest block that was read."""
        self.read_at = time.monotonic()
        """When that was, on the monotonic clock."""
        self._chain = chain
        self._lighthouse = lighthouse
        self._desk = desk
        self._book = book
        self._contracting = contracting
        self._books = books
        self._used = used
        self._history = History(chain.node.timing.reorg_depth)
        self._open: dict[str, Liability] = {}
        self._trouble = OutageLog(log, "chain")

    async def run(self) -> None:
        """Read until cancelled: orders that others made into contracts, and those whose time has passed, leave the
        book; what the chain takes back is done again."""
        while True:
            try:
                async with aclosing(
                    self._chain.follow(self.head + 1, history=self._history, outages=self._trouble)
                ) as blocks:
                    async for block in blocks:
                        self._trouble.recovered(f"the chain can be read again, from block {block.block_number}")
                        if isinstance(block, Reorganisation):
                            self._take_back(block)
                        else:
                            await self._take_block(block)
            except (NodeUnreachable, RequestRefused, NotALiability, NoContracts) as error:
                # The latter two of a contract in a block that the chain has replaced meanwhile: that is told next.
                self._trouble.failed(error, f"the chain can't be read on from block {self.head + 1}")
                await asyncio.sleep(RETRY)

    @property
    def waits(self) -> bool:
        """Whether the chain can't be read just now."""
        return self._trouble.is_down

    async def liability(self, address: str) -> Liability:
        """The record of a liability. Raises `NotALiability`, `NodeUnreachable`, `RequestRefused`."""
        return self._open.get(address) or await self._chain.liabilities.get(address)

    async def _take_block(self, block: BlockEvents) -> None:
        for event in block.events:
            if isinstance(event, NewLiability):
                await self._forget_orders(event.liability)
            elif isinstance(event, Finalized):
                self._open.pop(event.liability, None)
        self.head, self.read_at = block.block_number, time.monotonic()
        for order in self._book.expire(self.head):
            known = log_event("unnamed", order=order.hash.hex(), signer=order.signer)
            log.info("expired order %s of %s", order.hash.hex(), order.signer, extra=known)

    async def _forget_orders(self, address: str) -> None:
        liability = await self._chain.liabilities.get(address)
        if liability.lighthouse != self._lighthouse:
            return
        demand_hash, offer_hash = await self._chain.liabilities.order_hashes(address)
        demand = self._book.remove(demand_hash + address_bytes(liability.promisee))
        offer = self._book.remove(offer_hash + address_bytes(liability.promisor))
        self._used.add(address, demand, offer)
        if not liability.is_finalized:
            self._open[address] = liability
            if len(self._open) > OPEN:
                del self._open[next(iter(self._open))]

    def _take_back(self, block: Reorganisation) -> None:
        """What the chain has undone is done again, unless it comes again by itself: then the contracts say so."""
        self.head = block.block_number
        created = [event.liability for event in block.reverted_events if isinstance(event, NewLiability)]
        finalized = [event.liability for event in block.reverted_events if isinstance(event, Finalized)]
        log.warning("the chain took back %d contracts and %d endings", len(created), len(finalized))
        for address in created:
            with liability_context(address):
                log.warning("the chain took the contract back")
            self._open.pop(address, None)
            self._books.unmade(address)
            for order in self._used.pop(address, Demand, Offer):
                self._desk.put_back(order)
        for address in finalized:
            self._books.unended(address)
            for result in self._used.pop(address, Result):
                self._contracting.end(result)
