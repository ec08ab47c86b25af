"""Settlement: creates liabilities from matching orders; `judgements` finalizes them by results.

Other providers do the same, and the chain may replace its last blocks, so a receipt settles nothing. A match or result
stays under settlement (`Unconfirmed`) until its event was read on the followed chain and is `Timing.confirmations`
deep; if the event vanishes, it is settled again. A message that leaves for another reason (a contract refused it,
another provider was first) is forgotten by its subscription, so that the next copy gets through.
"""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.chain import NodeUnreachable, RequestRefused, Reverted, TransactionTimeout
from mesh.errors import AiraError, InputError
from mesh.flood import UNFUNDED_POLLS
from mesh.log_context import liability_context, log_event
from mesh.market.book import Added, Match, order_id
from mesh.market.funding import Commitments, UnfundedOrders, creation_stakes
from mesh.market.judgements import ResultSettlement
from mesh.market.liability_events import OPEN_LIABILITIES, LiabilityEvents
from mesh.market.refusals import RETRIED, MatchWithdrawn, Refusal
from mesh.market.rejections import ORDER_USED, RejectionPublisher, at_fault, reason_of
from mesh.market.withdrawing import WithdrawalSettlement
from schemas import Result

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Awaitable, Callable, Mapping, Sequence

    from mesh.chain import Chain, Created, Funding, Holding
    from mesh.flood import Drops
    from mesh.market.book import Order, OrderBook
    from mesh.market.earnings import EarningsLedger
    from mesh.market.transaction_queue import TransactionQueue
    from mesh.market.versions import OrderVersions
    from mesh.market.withdrawals import Withdrawals
    from mesh.network import Channel
    from schemas import Verified

log = logging.getLogger(__name__)


class Settlement:
    """The settlement of one market by the chain's account, on the market's open `channel`; it begins after `head`.

    `matched` is called with each match. `forget` lets the next copy of a message through, as `Subscription.forget`.
    """

    blocked: frozenset[str] = frozenset()
    """The signers whose orders are not taken, as `block` was last called."""

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
        forget: Callable[..., None],
        withdrawals: Withdrawals,
        versions: OrderVersions,
        drops: Drops,
        open_limit: int = OPEN_LIABILITIES,
    ) -> None:
        assert chain.account is not None
        assert channel.address is not None
        self._chain = chain
        self._account = chain.account.address
        self._lighthouse = channel.address
        self._book = book
        self._queue = queue
        self._earnings = earnings
        self._matched = matched
        self._forget = forget
        self._withdrawals = withdrawals
        self._drops = drops
        self.rejections: Final = RejectionPublisher(channel, chain.account, earnings, drops)
        self._versions = versions
        self.events: Final = LiabilityEvents(
            chain,
            channel.address,
            book=book,
            versions=self._versions,
            withdrawals=withdrawals,
            earnings=earnings,
            head=head,
            forget=forget,
            open_limit=open_limit,
        )
        self._ask = partial(chain.retrying, outages=self.events.lookups)
        self._commitments = Commitments(self._funding)
        self.results: Final = ResultSettlement(
            chain,
            channel.address,
            queue=queue,
            earnings=earnings,
            events=self.events,
            commitments=self._commitments,
            rejections=self.rejections,
            forget=forget,
            drops=drops,
        )
        self._pause = UNFUNDED_POLLS * chain.node.timing.poll_interval
        self.withdrawn: Final = WithdrawalSettlement(
            withdrawals,
            book=book,
            events=self.events,
            versions=versions,
            rejections=self.rejections,
            forget=forget,
            drops=drops,
            pause=self._pause,
        )
        self._unfunded = UnfundedOrders(book, self.shortages, funded=self.add, interval=chain.node.timing.poll_interval)

    def start(self, tasks: asyncio.TaskGroup) -> None:
        """Follow the chain, and from now on settle what is added, in tasks of this group."""
        self._tasks = tasks
        self.results.start(tasks)
        self.withdrawn.start(tasks)
        tasks.create_task(self.events.follow(self._settle_again), name="provider chain")
        tasks.create_task(self._unfunded.run(), name="provider unfunded orders")

    def add(self, order: Verified[Order]) -> Refusal | None:
        """Add an order to the book, and settle the match that it completes.

        If the book refuses the order, returns why, and publishes a rejection unless the order is known already.
        """
        if order.signer in self.blocked:
            self._drop_blocked(order)
            return Refusal.BLOCKED
        self.events.note(order)
        outcome = self._refusal(order) or self._book.add(order)
        for evicted in outcome.evicted if isinstance(outcome, Added) else ():
            self._drops.count("book-full", evicted.signer)
            self._forget(evicted, after=2 * self._pause)  # in a flood, such copies cost the most
        if isinstance(outcome, Match):
            facts = {"demand": outcome.demand.hash.hex(), "offer": outcome.offer.hash.hex()}
            log.info("matched demand %(demand)s and offer %(offer)s", facts, extra=log_event("orders-matched", **facts))
            self._earnings.matched()
            self._matched(outcome)
            self.events.unconfirmed.begin(*outcome)
            self._tasks.create_task(self._create(outcome))
        elif isinstance(outcome, Refusal):
            is_no_promise = outcome is Refusal.WITHDRAWN and not self.withdrawn.may_promise(order_id(order))
            if outcome is not Refusal.DUPLICATE and not is_no_promise:
                self.rejections.reject(order, outcome.value, f"the order book refuses it: {outcome.value}")
            if outcome not in (Refusal.DUPLICATE, Refusal.WITHDRAWN):
                self._forget(order, after=self._pause if outcome in RETRIED else 0.0)
            return outcome
        return None

    def set_aside(self, order: Verified[Order], reason: str) -> None:
        """Keep an order whose maker can't pay, unmatched, until it can; `reason` is the contracts' error for that."""
        self.events.note(order)
        if self._refusal(order) is None and order_id(order) not in self._book:
            self._unfunded.add(order)
        if order in self._unfunded:  # each copy, because an earlier rejection may have been lost
            self.rejections.reject(order, reason, "its maker lacks the money, or the factory may not take it")
        self._forget(order, after=self._pause)

    def _settle_again(self, message: Verified[Any]) -> None:
        if isinstance(message.message, Result):
            self._tasks.create_task(self.results.add(message))
        else:
            self.add(message)

    def _refusal(self, order: Verified[Order]) -> Refusal | None:
        if order in self._unfunded:
            self._unfunded.hasten(order)
            self._forget(order, after=self._pause)
            return Refusal.DUPLICATE
        if order in self.events.unconfirmed:
            return Refusal.DUPLICATE
        return self._taken_back(order)

    def block(self, signers: frozenset[str]) -> None:
        """Take no orders of these signers, and drop those in the book. A transaction that was sent can't be stopped."""
        new, self.blocked = signers - self.blocked, signers
        for order in [order for signer in new for order in self._book.of(signer)]:
            self._book.remove(order_id(order))
            self._drop_blocked(order)

    def _drop_blocked(self, order: Verified[Order]) -> None:
        self._drops.count("blocked", order.signer)
        self._forget(order)

    async def _create(self, match: Match) -> None:
        demand, offer = match
        try:
            priority, stakes = self._chain.costs.worth(demand.message), creation_stakes(match, self._chain.costs)
            async with self._commitments.take(stakes, waiting=self._queue.counted(priority)):
                shortage = next(filter(None, await self.shortages(match)), "")  # which may be over by now
                if shortage and await self._set_aside_unfunded(match, shortage, "its maker can't pay any more"):
                    return
                created = await self._queue.send(self._creation(match), priority=priority)
        except MatchWithdrawn:
            self._put_back(match)
        except Reverted as error:
            if error.reason == ORDER_USED or not await self._set_aside_unfunded(match, reason_of(error), str(error)):
                await self._not_created(match, at_fault(match, error.reason, error.arguments), error)
        except (NodeUnreachable, RequestRefused, InputError) as error:
            left = self._chain.node.pending_transactions(self._account).abandoned  # the node may have one of these
            self._versions.vanished(match, left[-1].nonce if left else None, self.events.head)
            await self._not_created(match, match, error)
        else:
            self._versions.sent(match, created.nonce)
            self._earnings.created(created, fee=offer.message.lighthouse_fee)
            facts = {"gas": created.gas_used, "demand": demand.hash.hex(), "offer": offer.hash.hex()}
            with liability_context(created.liability):
                log.info("created, gas %(gas)d", facts, extra=log_event("contract-created", **facts))
            if not await self.events.is_confirmed(match, created.tx):
                self._earnings.creation_reverted(created.liability, created.tx)
                self._versions.vanished(match, created.nonce, self.events.head)
            self._put_back(match)
        finally:
            self._versions.ended(match, self.events.head)

    def _creation(self, match: Match) -> Callable[[], Awaitable[Created]]:
        """What sends the transaction of a match. It raises as `Liabilities.create`, and `MatchWithdrawn`."""
        may_be_sent = False

        async def attempt() -> Created:
            nonlocal may_be_sent
            if not may_be_sent and any(self._taken_back(one) or one.signer in self.blocked for one in match):
                raise MatchWithdrawn("an order was withdrawn or replaced before its contract was created")
            await self._versions.sending(match)
            try:
                return await self._chain.liabilities.create(self._lighthouse, match.demand.message, match.offer.message)
            except (NodeUnreachable, TransactionTimeout):
                may_be_sent = True
                raise
            except Reverted as error:
                if error.block:
                    self._versions.failed(match, error.nonce, max(error.block, self.events.head))
                raise

        return attempt

    def _taken_back(self, order: Verified[Order]) -> Refusal | None:
        if order_id(order) in self._withdrawals:
            return Refusal.WITHDRAWN
        return self._versions.refusal(order_id(order), self.events.head)

    def _put_back(self, match: Match) -> None:
        """No transaction of a match waits any more: put its orders back into the book unless they were used."""
        for order in match:
            if not self.events.unconfirmed.end(order):
                self.add(order)

    async def _set_aside_unfunded(self, match: Match, reason: str, detail: str) -> bool:
        """Keep the orders whose makers can't pay in the book, unmatched, and tell them; False if both can."""
        shortages = await self.shortages(match, fresh=True)
        unfunded = [order for order, shortage in zip(match, shortages, strict=True) if shortage]
        for order in match if unfunded else ():
            if self.events.unconfirmed.end(order):
                continue
            if order not in unfunded or order_id(order) in self._withdrawals:
                self.add(order)
                continue
            self._unfunded.add(order)
            self.rejections.reject(order, reason, detail)
            self._forget(order, after=self._pause)
        return bool(unfunded)

    async def shortages(self, orders: Sequence[Verified[Order]], *, fresh: bool = False) -> list[str]:
        """What makers of orders lack to pay for them: see `OrderCosts.shortages`. Asked until the node answers."""
        return await self._ask(partial(self._chain.costs.shortages, orders, fresh=fresh))

    async def _funding(self, holdings: Sequence[Holding]) -> Mapping[Holding, Funding | None]:
        return await self._ask(partial(self._chain.funds.of, holdings, fresh=True))

    async def _not_created(self, match: Match, rejected: tuple[Verified[Order], ...], error: AiraError) -> None:
        """Reject some orders of a match; put the other one back into the book, unless it was used meanwhile."""
        reason = reason_of(error)
        for order in match:
            was_used = self.events.unconfirmed.end(order)
            if order in rejected and (reason == ORDER_USED or not was_used):
                self.rejections.reject(order, reason, str(error))
            if was_used:
                continue
            if order in rejected or await self.events.is_used(order):
                self._forget(order)
            else:
                self.add(order)
