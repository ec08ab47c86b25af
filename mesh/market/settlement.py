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
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.chain import (
    NodeUnreachable,
    RequestRefused,
    Reverted,
)
from mesh.errors import AiraError, InputError
from mesh.log_context import liability_context, log_event
from mesh.market.book import ORDER_USED, Match, Refusal, at_fault, order_id, reason_word
from mesh.market.creation import Creation, MatchWithdrawn
from mesh.market.liability_events import OPEN_LIABILITIES, LiabilityEvents
from mesh.market.rejections import RejectionPublisher
from mesh.market.settlement_state import SettlementState
from mesh.market.unconfirmed import Unconfirmed
from mesh.market.unfunded import UnfundedOrders
from mesh.market.withdrawals import withdrawn_id
from schemas import ZERO_ADDRESS, Result

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from mesh.chain import Chain
    from mesh.market.book import Order, OrderBook
    from mesh.market.earnings import EarningsLedger
    from mesh.market.transaction_queue import TransactionQueue
    from mesh.market.withdrawals import Withdrawals
    from mesh.network import Channel
    from schemas import Verified, Withdrawal

log = logging.getLogger(__name__)

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
        withdrawals: Withdrawals,
        open_limit: int = OPEN_LIABILITIES,
    ) -> None:
        assert chain.account is not None
        assert channel.address is not None
        self.state: Final = SettlementState(chain)
        self._chain = chain
        self._lighthouse = channel.address
        self._book = book
        self._queue = queue
        self._earnings = earnings
        self._matched = matched
        self._forget = forget
        self._withdrawals = withdrawals
        self._publisher = RejectionPublisher(channel, chain.account, earnings)
        self.reject: Final = self._publisher.reject
        self._unconfirmed = Unconfirmed(chain.node.timing.reorg_depth)
        self._unfunded = UnfundedOrders(book, self.state, funded=self.add, interval=chain.node.timing.poll_interval)
        self.events: Final = LiabilityEvents(
            chain,
            channel.address,
            book=book,
            unconfirmed=self._unconfirmed,
            withdrawals=withdrawals,
            earnings=earnings,
            head=head,
            reverted=self._settle_again,
            open_limit=open_limit,
        )

    def start(self, tasks: asyncio.TaskGroup) -> None:
        """Follow the chain, and from now on settle what is added, in tasks of this group."""
        self._tasks = tasks
        tasks.create_task(self.events.follow(), name="provider chain")
        tasks.create_task(self._unfunded.run(), name="provider unfunded orders")

    def add(self, order: Verified[Order]) -> Refusal | None:
        """Add an order to the book, and settle the match that it completes.

        If the book refuses the order, returns why, and publishes a rejection unless the order is known already.
        """
        outcome = self._refusal(order) or self._book.add(order)
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
            if outcome not in (Refusal.DUPLICATE, Refusal.WITHDRAWN):
                self._forget(order)
            return outcome
        return None

    def _settle_again(self, message: Verified[Any]) -> None:
        if isinstance(message.message, Result):
            self._tasks.create_task(self.add_result(message))
        else:
            self.add(message)

    def _refusal(self, order: Verified[Order]) -> Refusal | None:
        if order in self._unfunded:
            self._unfunded.hasten(order)
            self._forget(order)
            return Refusal.DUPLICATE
        if order in self._unconfirmed:
            return Refusal.DUPLICATE
        return Refusal.WITHDRAWN if order_id(order) in self._withdrawals else None

    def withdraw(self, withdrawal: Verified[Withdrawal]) -> None:
        """Honour a withdrawal: its order leaves the book, and is refused until its deadline.

        A transaction that was sent already can't be stopped. If it was not, or fails, the order is refused then.
        """
        if not self._withdrawals.add(withdrawal):
            self.reject(withdrawal, Refusal.FULL.value, "too many withdrawals")
            self._forget(withdrawal)
            return
        identity = withdrawn_id(withdrawal)
        self._book.remove(identity)
        if self._unconfirmed.get(identity) is None:
            self._publisher.honour(withdrawal)

    async def add_result(self, result: Verified[Result]) -> None:
        """Finalize the liability that a result names, if the result may do that."""
        with liability_context(result.message.liability):
            address = result.message.liability
            liability = self.events.open.get(address) or await self.state.liability(address)
            if result in self._unconfirmed:
                return
            if liability is None or liability.is_finalized:  # which may not be confirmed either
                self._forget(result)
            elif result.signer != liability.promisor and liability.validator == ZERO_ADDRESS:
                self.reject(result, "WrongSigner", f"signed by {result.signer}, not by the promisor")
            else:
                self._unconfirmed.begin(result)
                self._tasks.create_task(self._finalize(result))

    async def _create(self, match: Match) -> None:
        demand, offer = match
        try:
            created = await self._queue.send(Creation(self._chain, self._lighthouse, match, self._withdrawals).attempt)
        except MatchWithdrawn:
            self._put_back(match)
        except Reverted as error:
            if error.reason == ORDER_USED or not await self._set_aside_unfunded(match, error):
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
                self.events.creation_reverted(created.liability, created.tx)
            self._put_back(match)

    def _put_back(self, match: Match) -> None:
        """No transaction of a match waits any more: put its orders back into the book unless they were used."""
        for order in match:
            if not self._unconfirmed.end(order):
                self.add(order)

    async def _set_aside_unfunded(self, match: Match, error: Reverted) -> bool:
        """Keep the orders whose makers can't pay in the book, unmatched, and tell them; False if both can."""
        unfunded = [order for order in match if not await self.state.can_pay(order)]
        for order in match if unfunded else ():
            if self._unconfirmed.end(order):
                continue
            if order not in unfunded or order_id(order) in self._withdrawals:
                self.add(order)
                continue
            self._unfunded.add(order)
            self.reject(order, _reason(error), str(error))
            self._forget(order)
        return bool(unfunded)

    async def _not_created(self, match: Match, rejected: tuple[Verified[Order], ...], error: AiraError) -> None:
        """Reject some orders of a match; put the other one back into the book, unless it was used meanwhile."""
        reason = _reason(error)
        for order in match:
            was_used = self._unconfirmed.end(order)
            if order in rejected and (reason == ORDER_USED or not was_used):
                self.reject(order, reason, str(error))
            if was_used:
                continue
            if order in rejected or await self.state.is_used(order):
                self._forget(order)
            else:
                self.add(order)

    async def _is_confirmed(self, messages: Sequence[Verified[Any]], tx: str) -> bool:
        """Wait until the event that used the messages has its confirmations; False if their transaction vanished."""
        timing, missing = self._chain.node.timing, 0
        while missing < MISSING_CHECKS:
            if all(
                self._unconfirmed.is_read(one, until=self.events.head - timing.confirmations + 1) for one in messages
            ):
                return True
            await asyncio.sleep(timing.poll_interval)
            is_there = all(self._unconfirmed.is_read(one, until=self.events.head) for one in messages)
            missing = 0 if is_there or await self.state.has_mined(tx) else missing + 1
        return False

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


def _reason(error: AiraError) -> str:
    """The machine-readable reason of a rejection."""
    return reason_word(error.reason if isinstance(error, Reverted) else type(error).__name__)
