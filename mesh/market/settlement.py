"""Settlement: creating liabilities from matching orders, and finalizing them by results.

Other providers do the same, and the chain may replace its last blocks. So settlement follows the chain, and a receipt
settles nothing. Orders that others used leave the book. A match or result stays under settlement (`Unconfirmed`) until
its event was read on the followed chain and is `Timing.confirmations` deep; if it vanishes before, or is reverted
later, it is settled again. What leaves for another reason (it is refused, another provider was first) is forgotten by
its subscription, so that the copy that its sender repeats next gets through.
"""

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
    Reverted,
)
from mesh.errors import AiraError, InputError
from mesh.log_context import liability_context, log_event
from mesh.market.book import ORDER_USED, Match, Refusal, at_fault, reason_word
from mesh.market.rejections import RejectionPublisher
from mesh.market.unconfirmed import Unconfirmed
from mesh.outage_log import OutageLog
from mesh.retry import Backoff
from schemas import ZERO_ADDRESS, Demand, Offer, Result, address_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from mesh.chain import BlockEvents, Chain
    from mesh.market.book import Order, OrderBook
    from mesh.market.earnings import EarningsLedger
    from mesh.market.transaction_queue import TransactionQueue
    from mesh.network import Channel
    from schemas import Liability, Verified

log = logging.getLogger(__name__)

OPEN_LIABILITIES: Final = 65_536
"""Records of liabilities that are kept until they are finalized; others are read when their result arrives."""
MISSING_CHECKS: Final = 3
"""Checks in a row that find no trace of a mined transaction before it is sent again: one node may be behind another."""


class Settlement:
    """The settlement of one market by the chain's account, on the market's open `channel`; it begins after `head`.

    `matched` is called with each match. `forget` lets the next copy of a message through, as `Subscription.forget`.
    """

    def __init__(
        self,
        chain: Chain,
        channel: Channel,
        *,
        book: OrderBook,
        queue: TransactionQueue,
        earnings: EarningsLedger,
        head: int,
        matched: Callable[[Match], None],
        forget: Callable[[Verified[Any]], None],
        open_limit: int = OPEN_LIABILITIES,
    ) -> None:
        assert chain.account is not None
        assert channel.address is not None
        self.head, self.read_at = head, time.monotonic()
        """The latest block that was read, and when, on the monotonic clock."""
        self.following = OutageLog(log, "chain")
        """Outages of the node while the chain is followed."""
        self.reading = OutageLog(log, "node")
        """Outages of the node while the state of liabilities and orders is read."""
        self._chain = chain
        self._lighthouse = channel.address
        self._book = book
        self._queue = queue
        self._earnings = earnings
        self._matched = matched
        self._forget = forget
        self.reject: Final = RejectionPublisher(channel, chain.account, earnings).reject
        self._open_limit = open_limit
        self._open: dict[str, Liability] = {}
        self._unconfirmed = Unconfirmed(chain.node.timing.reorg_depth)
        self._history = History(chain.node.timing.reorg_depth)

    def start(self, tasks: asyncio.TaskGroup) -> None:
        """Follow the chain, and from now on settle what is added, in tasks of this group."""
        self._tasks = tasks
        tasks.create_task(self._follow(), name="provider chain")

    def add(self, order: Verified[Order]) -> Refusal | None:
        """Add an order to the book, and settle the match that it completes.

        If the book refuses the order, returns why, and publishes a rejection unless the order is known already.
        """
        outcome = Refusal.DUPLICATE if order in self._unconfirmed else self._book.add(order)
        if isinstance(outcome, Match):
            demand, offer = outcome.demand.hash.hex(), outcome.offer.hash.hex()
            event = log_event("orders-matched", demand=demand, offer=offer)
            log.info("matched demand %s and offer %s", demand, offer, extra=event)
            self._earnings.matched()
            self._matched(outcome)
            self._unconfirmed.begin(*outcome)
            self._tasks.create_task(self._create(outcome))
        elif isinstance(outcome, Refusal):
            if outcome is not Refusal.DUPLICATE:
                self.reject(order, outcome.value, f"the order book refuses it: {outcome.value}")
                self._forget(order)
            return outcome
        return None

    async def add_result(self, result: Verified[Result]) -> None:
        """Finalize the liability that a result names, if the result may do that."""
        with liability_context(result.message.liability):
            liability = await self._chain.retrying(partial(self._liability, result), outages=self.reading)
            if result in self._unconfirmed:
                return
            if liability is None or liability.is_finalized:  # which may not be confirmed either
                self._forget(result)
            elif result.signer != liability.promisor and liability.validator == ZERO_ADDRESS:
                self.reject(result, "WrongSigner", f"signed by {result.signer}, not by the promisor")
            else:
                self._unconfirmed.begin(result)
                self._tasks.create_task(self._finalize(result))

    async def _liability(self, result: Verified[Result]) -> Liability | None:
        """The record of the liability that a result names; None while the node knows none at that address."""
        address = result.message.liability
        try:
            return self._open.get(address) or await self._chain.liabilities.get(address)
        except (NotALiability, NoContracts, RequestRefused) as error:
            log.debug("a result waits to be sent again: %s", error)
            return None

    async def _create(self, match: Match) -> None:
        demand, offer = match
        create = partial(self._chain.liabilities.create, self._lighthouse, demand.message, offer.message)
        try:
            created = await self._queue.send(create)
        except Reverted as error:
            await self._not_created(match, at_fault(match, error.reason, error.arguments), error)
        except (NodeUnreachable, RequestRefused, InputError) as error:
            await self._not_created(match, match, error)
        else:
            self._earnings.created(created, fee=offer.message.lighthouse_fee)
            orders = {"demand": demand.hash.hex(), "offer": offer.hash.hex()}
            event = log_event("contract-created", gas=created.gas_used, **orders)
            with liability_context(created.liability):
                log.info("created, gas %d", created.gas_used, extra=event)
            if not await self._is_confirmed(match, created.tx):
                self._contract_reverted(created.liability, created.tx)
            for order in match:
                if not self._unconfirmed.end(order):
                    self.add(order)

    async def _not_created(self, match: Match, rejected: tuple[Verified[Order], ...], error: AiraError) -> None:
        """Reject some orders of a match; put the other one back into the book, unless it was used meanwhile."""
        reason = _reason(error)
        for order in match:
            was_used = self._unconfirmed.end(order)
            if order in rejected and (reason == ORDER_USED or not was_used):
                self.reject(order, reason, str(error))
            if was_used:
                continue
            if order in rejected or await self._chain.retrying(partial(self._is_used, order), outages=self.reading):
                self._forget(order)
            else:
                self.add(order)

    async def _is_confirmed(self, messages: Sequence[Verified[Any]], tx: str) -> bool:
        """Wait until the event that used the messages has its confirmations; False if their transaction vanished."""
        timing, missing = self._chain.node.timing, 0
        while missing < MISSING_CHECKS:
            if all(self._unconfirmed.is_read(one, until=self.head - timing.confirmations + 1) for one in messages):
                return True
            await asyncio.sleep(timing.poll_interval)
            is_there = all(self._unconfirmed.is_read(one, until=self.head) for one in messages)
            is_there = is_there or await self._chain.retrying(partial(self._is_on_chain, tx), outages=self.reading)
            missing = 0 if is_there else missing + 1
        return False

    async def _is_on_chain(self, tx: str) -> bool:
        """Whether the node has a transaction, waiting or mined with success."""
        receipt = await self._chain.node.receipt(tx)
        return await self._chain.node.has_transaction(tx) if receipt is None else receipt.status == 1

    async def _is_used(self, order: Verified[Order]) -> bool:
        try:
            if order.message.generation == 3:
                return await self._chain.liabilities.is_order_used(order.hash, order.signer)
            return await self._chain.liabilities.next_nonce(order.signer) > int(order.message.nonce)
        except RequestRefused:
            return False  # a used order is rejected when its next match fails

    async def _finalize(self, result: Verified[Result]) -> None:
        message = result.message
        with liability_context(message.liability):
            try:
                finalized = await self._queue.send(partial(self._chain.liabilities.finalize, self._lighthouse, message))
            except (Reverted, NodeUnreachable, RequestRefused) as error:
                if not isinstance(error, Reverted) or error.reason != "AlreadyFinalized":
                    self.reject(result, _reason(error), str(error))
                if not self._unconfirmed.end(result):
                    self._forget(result)
            else:
                self._earnings.finalized(finalized)
                event = log_event("contract-finalized", success=message.success, gas=finalized.gas_used)
                log.info("finalized, success %s, gas %d", message.success, finalized.gas_used, extra=event)
                if not await self._is_confirmed((result,), finalized.tx):
                    self._earnings.reverted(finalized.tx)
                if not self._unconfirmed.end(result):
                    await self.add_result(result)

    async def _follow(self) -> None:
        backoff = Backoff(self._chain.node.timing.outage_retry)
        while True:
            try:
                blocks = self._chain.follow(self.head + 1, history=self._history, outages=self.following)
                async with aclosing(blocks):
                    async for block in blocks:
                        if isinstance(block, Reorganisation):
                            self._revert(block)
                        else:
                            await self._take_block(block)
                        backoff.reset()
            except (NodeUnreachable, RequestRefused, NotALiability, NoContracts) as error:
                # A liability can't be read. If a reorganisation took it away, that is what comes next.
                self.following.failed(error, f"the chain can't be read on from block {self.head + 1}")
                await backoff.wait()

    async def _take_block(self, block: BlockEvents) -> None:
        for event in block.events:
            if isinstance(event, NewLiability | Finalized):
                self._earnings.mined(event.tx)
            if isinstance(event, NewLiability):
                await self._take_created(event.liability, block.block_number)
            elif isinstance(event, Finalized):
                self._open.pop(event.liability, None)
                self._unconfirmed.finalized(event.liability, block.block_number)
        self.head, self.read_at = block.block_number, time.monotonic()
        self._unconfirmed.confirm(self.head)
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
            self._open[address] = liability
            if len(self._open) > self._open_limit:
                del self._open[next(iter(self._open))]

    def _revert(self, block: Reorganisation) -> None:
        """Settle again what a reorganisation reverted. What happened again by itself, the contracts refuse."""
        self.head = block.block_number
        created = [event for event in block.reverted_events if isinstance(event, NewLiability)]
        finalized = [event for event in block.reverted_events if isinstance(event, Finalized)]
        counts = {"created": len(created), "finalized": len(finalized)}
        event = log_event("chain-reorganised", head=self.head, **counts)
        log.warning("a reorganisation reverted %d new contracts, %d finalizations", *counts.values(), extra=event)
        for creation in created:
            self._contract_reverted(creation.liability, creation.tx)
            self._open.pop(creation.liability, None)
            for order in self._unconfirmed.reverted(creation.liability, Demand, Offer):
                self.add(order)
        for end in finalized:
            self._earnings.reverted(end.tx)
            for result in self._unconfirmed.reverted(end.liability, Result):
                self._tasks.create_task(self.add_result(result))

    def _contract_reverted(self, address: str, tx: str) -> None:
        with liability_context(address):
            log.warning("a reorganisation reverted the contract", extra=log_event("contract-reverted"))
        self._earnings.reverted(tx)


def _reason(error: AiraError) -> str:
    """The machine-readable reason of a rejection."""
    return reason_word(error.reason if isinstance(error, Reverted) else type(error).__name__)
