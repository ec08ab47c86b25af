"""Settlement: creating liabilities from matching orders, and finalizing them by results.

Other providers do the same, and the chain may replace its last blocks. So settlement follows the chain: orders that
others used leave the book, and what a reorganisation reverts is done again.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
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
from mesh.outage_log import OutageLog
from mesh.retry import Backoff
from schemas import ZERO_ADDRESS, Demand, Offer, RejectKey, Result, address_bytes
from schemas.signing import Rejection

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from mesh.chain import BlockEvents, Chain
    from mesh.market.book import Order, OrderBook
    from mesh.market.earnings import EarningsLedger
    from mesh.market.transaction_queue import TransactionQueue
    from mesh.network import Channel, Subscription
    from schemas import Liability, Verified

log = logging.getLogger(__name__)

OPEN_LIABILITIES: Final = 65_536
"""Records of liabilities that are kept until they are finalized; others are read when their result arrives."""
REMEMBERED: Final = 4096
"""Liabilities whose messages are kept for a reorganisation, which replaces only the last blocks."""


class SettledMessages:
    """The orders and the result that the latest liabilities were created from and finalized by."""

    def __init__(self, limit: int = REMEMBERED) -> None:
        self._limit = limit
        self._messages: OrderedDict[str, list[Verified[Any]]] = OrderedDict()

    def add(self, liability: str, *messages: Verified[Any] | None) -> None:
        """Remember messages (None: unknown here) that were used at the liability's address."""
        kept = self._messages.setdefault(liability, [])
        kept.extend(message for message in messages if message is not None and message not in kept)
        if len(self._messages) > self._limit:
            self._messages.popitem(last=False)

    def pop(self, liability: str, *kinds: type[Any]) -> list[Verified[Any]]:
        """Remove and return the messages of these kinds, in the order in which they were added."""
        kept = self._messages.get(liability, [])
        popped = [message for message in kept if isinstance(message.message, kinds)]
        kept[:] = [message for message in kept if message not in popped]
        return popped


class Settlement:
    """The settlement of one market by the chain's account, on the market's open `channel`; it begins after `head`.

    `matched` is called with each match. `results` is where results come from: one that could not be used yet is
    forgotten there, so that it arrives again.
    """

    def __init__(
        self,
        chain: Chain,
        channel: Channel,
        *,
        book: OrderBook,
        queue: TransactionQueue,
        results: Subscription[Result],
        earnings: EarningsLedger,
        head: int,
        matched: Callable[[Match], None],
        open_limit: int = OPEN_LIABILITIES,
    ) -> None:
        assert chain.account is not None
        assert channel.address is not None
        self.head = head
        """The latest block that was read."""
        self.read_at = time.monotonic()
        """When it was read, on the monotonic clock."""
        self.following = OutageLog(log, "chain")
        """Outages of the node while the chain is followed."""
        self.reading = OutageLog(log, "node")
        """Outages of the node while the state of liabilities and orders is read."""
        self._chain = chain
        self._account = chain.account
        self._channel = channel
        self._lighthouse = channel.address
        self._book = book
        self._queue = queue
        self._results = results
        self._earnings = earnings
        self._matched = matched
        self._open_limit = open_limit
        self._open: dict[str, Liability] = {}
        self._settled = SettledMessages()
        self._history = History(chain.node.timing.reorg_depth)

    def start(self, tasks: asyncio.TaskGroup) -> None:
        """Follow the chain, and from now on settle what is added, in tasks of this group."""
        self._tasks = tasks
        tasks.create_task(self._follow(), name="provider chain")

    def add(self, order: Verified[Order]) -> Refusal | None:
        """Add an order to the book, and settle the match that it completes.

        If the book refuses the order, returns why, and publishes a rejection unless the order is in the book already.
        """
        outcome = self._book.add(order)
        if isinstance(outcome, Match):
            demand, offer = outcome.demand.hash.hex(), outcome.offer.hash.hex()
            event = log_event("orders-matched", demand=demand, offer=offer)
            log.info("matched demand %s and offer %s", demand, offer, extra=event)
            self._earnings.matched()
            self._matched(outcome)
            self._tasks.create_task(self._create(outcome))
        elif isinstance(outcome, Refusal):
            if outcome is not Refusal.DUPLICATE:
                self.reject(order, outcome.value, f"the order book refuses it: {outcome.value}")
            return outcome
        return None

    async def add_result(self, result: Verified[Result]) -> None:
        """Finalize the liability that a result names, if the result may do that."""
        with liability_context(result.message.liability):
            liability = await self._chain.retrying(partial(self._liability, result), outages=self.reading)
            if liability is None:
                self._results.forget(result)
            elif result.signer != liability.promisor and liability.validator == ZERO_ADDRESS:
                self.reject(result, "WrongSigner", f"signed by {result.signer}, not by the promisor")
            elif not liability.is_finalized:
                self._tasks.create_task(self._finalize(result))

    async def _liability(self, result: Verified[Result]) -> Liability | None:
        """The record of the liability that a result names; None while the node knows none at that address."""
        address = result.message.liability
        try:
            return self._open.get(address) or await self._chain.liabilities.get(address)
        except (NotALiability, RequestRefused) as error:
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
            self._settled.add(created.liability, demand, offer)
            event = log_event(
                "contract-created", demand=demand.hash.hex(), offer=offer.hash.hex(), gas=created.gas_used
            )
            with liability_context(created.liability):
                log.info("created, gas %d", created.gas_used, extra=event)

    async def _not_created(self, match: Match, rejected: tuple[Verified[Order], ...], error: AiraError) -> None:
        """Reject some orders of a match; put the other one back into the book, unless it was used meanwhile."""
        for order in match:
            if order in rejected:
                self.reject(order, _reason(error), str(error))
            elif not await self._chain.retrying(partial(self._is_used, order), outages=self.reading):
                self.add(order)

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
            except Reverted as error:
                if error.reason != "AlreadyFinalized":
                    self.reject(result, _reason(error), str(error))
            except (NodeUnreachable, RequestRefused) as error:
                # Perhaps not the result's fault; the promisor keeps sending it.
                self.reject(result, _reason(error), str(error))
                self._results.forget(result)
            else:
                self._earnings.finalized(message.liability, finalized)
                self._settled.add(message.liability, result)
                event = log_event("contract-finalized", success=message.success, gas=finalized.gas_used)
                log.info("finalized, success %s, gas %d", message.success, finalized.gas_used, extra=event)

    def reject(self, message: Verified[Any], reason: str, detail: str) -> None:
        """Count and publish a rejection. A used order's sender knows already that it became a contract."""
        self._earnings.rejected(reason)
        order = message.hash.hex()
        event = log_event("message-rejected", order=order, signer=message.signer, reason=reason)
        log.warning("rejected %s of %s: %s", order, message.signer, detail, extra=event)
        if reason != ORDER_USED:
            provider = self._account.address
            rejection = Rejection(order=order, reason=reason, detail=detail, provider=provider)
            key = str(RejectKey(self._channel.lighthouse, order, provider))
            self._channel.put(key, rejection.signed_by(self._account.signer).encode())

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
            if isinstance(event, NewLiability):
                await self._take_created(event.liability)
            elif isinstance(event, Finalized):
                self._open.pop(event.liability, None)
        self.head, self.read_at = block.block_number, time.monotonic()
        for order in self._book.expire(self.head):
            expired = log_event("order-expired", order=order.hash.hex(), signer=order.signer)
            log.info("expired order %s of %s", order.hash.hex(), order.signer, extra=expired)

    async def _take_created(self, address: str) -> None:
        """Take the orders of a new liability out of the book."""
        liability = await self._chain.liabilities.get(address)
        if liability.lighthouse != self._lighthouse:
            return
        demand_hash, offer_hash = await self._chain.liabilities.order_hashes(address)
        demand = self._book.remove(demand_hash + address_bytes(liability.promisee))
        offer = self._book.remove(offer_hash + address_bytes(liability.promisor))
        self._settled.add(address, demand, offer)
        if not liability.is_finalized:
            self._open[address] = liability
            if len(self._open) > self._open_limit:
                del self._open[next(iter(self._open))]

    def _revert(self, block: Reorganisation) -> None:
        """Do again what a reorganisation reverted. What happened again by itself, the contracts refuse."""
        self.head = block.block_number
        created = [event.liability for event in block.reverted_events if isinstance(event, NewLiability)]
        finalized = [event.liability for event in block.reverted_events if isinstance(event, Finalized)]
        reorganised = log_event("chain-reorganised", head=self.head, created=len(created), finalized=len(finalized))
        log.warning(
            "a reorganisation reverted %d new contracts and %d finalizations",
            len(created),
            len(finalized),
            extra=reorganised,
        )
        for address in created:
            with liability_context(address):
                log.warning("a reorganisation reverted the contract", extra=log_event("contract-reverted"))
            self._open.pop(address, None)
            self._earnings.liability_reverted(address)
            for order in self._settled.pop(address, Demand, Offer):
                self.add(order)
        for address in finalized:
            self._earnings.finalization_reverted(address)
            for result in self._settled.pop(address, Result):
                self._tasks.create_task(self._finalize(result))


def _reason(error: AiraError) -> str:
    """The machine-readable reason of a rejection."""
    return reason_word(error.reason if isinstance(error, Reverted) else type(error).__name__)
