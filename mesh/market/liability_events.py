"""The events of one lighthouse's liabilities, and what they change: book, withdrawals, messages under settlement."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import aclosing
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

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
from mesh.flood import KnownSenders
from mesh.log_context import liability_context, log_event
from mesh.outage_log import OutageLog
from mesh.retry import Backoff
from schemas import Demand, Offer, Result, address_bytes

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from mesh.chain import BlockEvents, Chain
    from mesh.market.book import OrderBook
    from mesh.market.earnings import EarningsLedger
    from mesh.market.unconfirmed import Unconfirmed
    from mesh.market.withdrawals import Withdrawals
    from schemas import Liability, Verified

log = logging.getLogger(__name__)

T = TypeVar("T")

OPEN_LIABILITIES: Final = 65_536
"""Records of liabilities that are kept until they are finalized; others are read when their result arrives."""
MISSING_CHECKS: Final = 3
"""Checks in a row that find no trace of a mined transaction before it is sent again: one node may be behind another."""


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
        forget: Callable[[Verified[Any]], None],
        open_limit: int = OPEN_LIABILITIES,
    ) -> None:
        self.head, self.read_at = head, time.monotonic()
        """The latest block that was read, and when, on the monotonic clock."""
        self.outages: Final = OutageLog(log, "chain")
        """Outages of the node while the chain is followed."""
        self.lookups: Final = OutageLog(log, "node")
        """Outages of the node while single facts are asked of it."""
        self.open: Final[dict[str, Liability]] = {}
        """Liabilities that were not finalized when they were read, by address; `open_limit` of them at most."""
        self._chain = chain
        self._lighthouse = lighthouse
        self._book = book
        self._unconfirmed = unconfirmed
        self._withdrawals = withdrawals
        self._earnings = earnings
        self._reverted = reverted
        self._forget = forget
        self.parties: Final = KnownSenders()
        """Accounts that a liability was created for."""
        self._open_limit = open_limit
        self._history = History(chain.node.timing.reorg_depth)

    async def follow(self) -> None:
        """Read until cancelled, through outages of the node."""
        backoff = Backoff(self._chain.node.timing.outage_retry)
        while True:
            try:
                blocks = self._chain.follow(self.head + 1, history=self._history, parties=(), outages=self.outages)
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

    async def is_confirmed(self, messages: Sequence[Verified[Any]], tx: str) -> bool:
        """Wait until the event that used the messages has its confirmations; False if their transaction vanished."""
        timing, missing = self._chain.node.timing, 0
        while missing < MISSING_CHECKS:
            if all(self._unconfirmed.is_read(one, until=self.head - timing.confirmations + 1) for one in messages):
                return True
            await asyncio.sleep(timing.poll_interval)
            is_there = all(self._unconfirmed.is_read(one, until=self.head) for one in messages)
            missing = 0 if is_there or await self._has_mined(tx) else missing + 1
        return False

    async def liability(self, address: str) -> Liability | None:
        """The record of a liability; None while the node knows none at that address."""
        if (known := self.open.get(address)) is not None:
            return known
        try:
            return await self._ask(partial(self._chain.liabilities.get, address))
        except (NotALiability, NoContracts, RequestRefused) as error:  # or a reorganisation took it
            log.debug("a result waits to be sent again: %s", error)
            return None

    async def is_used(self, order: Verified[Demand | Offer]) -> bool:
        """Whether an order became a liability, or was withdrawn on the chain."""
        liabilities = self._chain.liabilities
        try:
            if order.message.generation == 3:
                return await self._ask(partial(liabilities.is_order_used, order.hash, order.signer))
            return await self._ask(partial(liabilities.next_nonce, order.signer)) > int(order.message.nonce)
        except RequestRefused:
            return False  # a used order is rejected when its next match fails

    async def _ask(self, question: Callable[[], Awaitable[T]]) -> T:
        return await self._chain.retrying(question, outages=self.lookups, errors=(NodeUnreachable,))

    async def _has_mined(self, tx: str) -> bool:
        """Whether the node has a transaction, waiting or mined with success."""
        node = self._chain.node
        receipt = await self._chain.retrying(partial(node.receipt, tx), outages=self.lookups)
        if receipt is not None:
            return receipt.status == 1
        return await self._chain.retrying(partial(node.has_transaction, tx), outages=self.lookups)

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
                self._unconfirmed.finalized(event.liability, block.block_number)
        self.head, self.read_at = block.block_number, time.monotonic()
        self._unconfirmed.confirm(self.head)
        self._withdrawals.expire(self.head)
        for order in self._book.expire(self.head):
            self._forget(order)  # its deadline may be later than the book's limit
            expired = log_event("order-expired", order=order.hash.hex(), signer=order.signer)
            log.info("expired order %s of %s", order.hash.hex(), order.signer, extra=expired)

    def _take_created(self, liability: Liability, order_hashes: tuple[bytes, bytes], block: int) -> None:
        """Take the orders of a new liability, created in that block, out of the book."""
        if liability.lighthouse != self._lighthouse:
            return
        self.parties.add(liability.promisee)
        self.parties.add(liability.promisor)
        for digest, signer in zip(order_hashes, (liability.promisee, liability.promisor), strict=True):
            identity = digest + address_bytes(signer)
            order = self._book.remove(identity) or self._unconfirmed.get(identity)
            if order is not None:
                self._unconfirmed.created(liability.address, block, order)
        if not liability.is_finalized:
            self.open[liability.address] = liability
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
