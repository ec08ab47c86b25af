"""Trading: signs and posts the orders of an account, follows them over restarts, and waits for their contracts."""

from __future__ import annotations

import asyncio
import logging
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.agent.contract import Contract, WatchedContracts, fail_future
from mesh.agent.demands import current_buyer
from mesh.agent.offers import OpenOffers
from mesh.agent.orders import Order, OrderState, TermsWriter, TradedOrder
from mesh.agent.progress import Progress, report, seen_offers
from mesh.agent.statements import received_declines, received_rejections
from mesh.background import Background
from mesh.chain import Allowances, OrderAlreadyUsed
from mesh.errors import AiraError, ClosedError
from mesh.flood import KnownSenders
from mesh.log_context import log_event
from mesh.market.book import Refusal
from mesh.role import Lifecycle
from mesh.work.database import LedgerUnusable
from mesh.work.ledger import Phase
from schemas import Demand, Offer, Withdrawal, decode

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from contextlib import AsyncExitStack

    from mesh.agent.components import AgentComponents
    from mesh.agent.orders import Terms
    from mesh.agent.progress import OnProgress
    from schemas import Liability
    from schemas.signing import Rejection

log = logging.getLogger(__name__)

ENDED: Final = partial(ClosedError, "the agent has ended", hint="run it again: orders stay open until their deadline")


class Trader(Lifecycle):
    """Trades for one account: `async with Trader(components) as trader`.

    The orders of the ledger are open again when it opens: those of an earlier run, which are sent once their allowance
    is ensured, and those of other programs of the account. Leaving fails everything that is waited for with
    `ClosedError`; open orders stay in the ledger. The runtime reports what happens on the chain.
    """

    title = "trader"

    def __init__(self, parts: AgentComponents) -> None:
        self._parts = parts
        self._chain = parts.chain
        self._address = parts.signer.address
        self._allowances = Allowances(parts.chain.tokens, parts.chain.factory, self._address)
        self.writer = TermsWriter(parts)
        self._orders: dict[str, TradedOrder] = {}
        self._hear_declines: Callable[[], None] = lambda: None
        self._answers = OpenOffers()
        self._changing = asyncio.Lock()
        self.contracts = WatchedContracts(parts)
        self.customers = KnownSenders()
        """Who demanded the contracts of this account."""

    def orders(self, *states: OrderState) -> list[Order]:
        """The orders that can still become contracts, oldest first: open or withdrawn."""
        chosen = [order for order in self._orders.values() if order.state in states]
        return [order.shown(self) for order in sorted(chosen, key=lambda order: order.posted)]

    async def _open(self, stack: AsyncExitStack) -> None:
        stack.push_async_callback(self._close)
        for job in await self._parts.ledger.jobs(Phase):
            self.customers.add(job.liability.promisee)
        self._hear_declines = await stack.enter_async_context(received_declines(self._parts, self._orders))
        resumed = [order for order in await self.load() if order.is_open]
        for order in resumed:
            if isinstance(order.signed, Offer):
                await self._give_up(self._answers.add(order.identity, "", pays=False))
            facts = log_event("order-resumed", order=order.identity, kind=order.signed.kind, deadline=order.deadline)
            log.info("the %s of an earlier run is open until block %d", order, order.deadline, extra=facts)
        await stack.enter_async_context(received_rejections(self._parts, self._orders, self._rejected))
        self._tasks = await stack.enter_async_context(Background())
        self._send_when_covered([order for order in resumed if order.is_open])

    async def _close(self) -> None:
        for order in self._orders.values():
            fail_future(order.created, ENDED())
        self.contracts.fail(ENDED())

    async def post(self, kind: type[Demand | Offer], terms: Terms, **fee: Any) -> Order:
        """Sign an order, ensure its allowance, and post it. Cancelling withdraws it.

        Raises `InsufficientTokens`, and `TooManyOffers` for an offer that answers a demand.
        """
        order = TradedOrder(await self.writer.sign(kind, terms, **fee), time.time())
        if kind is Offer and (buyer := current_buyer()) is not None:
            await self._give_up(self._answers.add(order.identity, buyer.maker, pays=buyer.pays))
        self._orders[order.identity] = order
        if kind is Demand:
            self._hear_declines()
        try:
            await self._ensure_allowance(order)
        except BaseException:
            self._forget(order)
            raise
        try:
            if order.is_open:
                await self._parts.outbox.post(order.signed)
        except asyncio.CancelledError:
            await self.withdraw(order)
            raise
        except LedgerUnusable:
            self._forget(order)
            raise
        return order.shown(self)

    async def contract_of(self, order: TradedOrder, on_progress: OnProgress) -> Contract:
        """See `Order.contract`."""
        if order.state is OrderState.MATCHED:
            contract = await self.contracts.read(order.liability)
        elif not order.is_open:
            raise order.why_closed
        elif not self.is_open:
            raise ENDED()
        else:
            async with seen_offers(self._parts.channel, order.signed, on_progress):
                contract = await order.contract(on_progress)
        report(on_progress, Progress(kind="contract", agent=contract.liability.promisor, detail=contract.address))
        return contract

    async def withdraw(self, order: TradedOrder) -> Order:
        """See `Order.withdraw`."""
        if order.state is OrderState.MATCHED:
            raise order.why_closed
        if order.is_open:
            self._allowances.withdraw(order)
            order.close(OrderState.WITHDRAWN)
            facts = log_event("order-withdrawn", order=order.identity, deadline=order.deadline)
            log.info("the %s is withdrawn", order, extra=facts)
            withdrawal = Withdrawal(order=order.identity, lighthouse=order.signed.lighthouse, deadline=order.deadline)
            await self._parts.outbox.withdraw(self._parts.signer.sign(withdrawal))
        return order.shown(self)

    async def withdraw_on_chain(self, order: TradedOrder) -> Order:
        """See `Order.withdraw_on_chain`."""
        await self.withdraw(order)
        try:
            tx = (await self._chain.liabilities.withdraw(order.signed)).tx
        except OrderAlreadyUsed:
            await self._parts.chain_head.reached(await self._chain.block_number())
            await self.withdraw(order)  # raises if the order became a contract
            tx = "an earlier transaction"
        await self._parts.ledger.use_up(order.identity, tx)
        self._forget(order)
        return order.shown(self)

    async def matched(self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes) -> None:
        """A contract was created from these orders: stop sending ours.

        In generation 3 somebody else may have signed the terms of ours; ours then has the same hash and is still open.
        """
        demand = demand_hash.hex() if liability.promisee == self._address else ""
        offer = offer_hash.hex() if liability.promisor == self._address else ""
        if offer:
            self.customers.add(liability.promisee)
        known = self.contracts.created(liability, demand or offer)
        for identity in filter(None, (demand, offer)):
            if (order := self._orders.get(identity)) is not None:
                log.info(
                    "created from our %s %s", order.state, order, extra=log_event("contract-created", order=identity)
                )
                order.state, order.liability = OrderState.MATCHED, liability.address
                self._forget(order)
            await self._parts.outbox.spend(identity, liability.address)
            if order is not None:
                if order.created is not None and not order.created.done():
                    order.created.set_result(known or self.contracts.watch(liability, order=identity))
                await self._renew_overtaken(order.nonce)

    async def liability_reverted(self, address: str) -> None:
        """A reorganisation reverted the contract at `address`: its orders are open again, until their deadline.

        It may have reverted the approval of their allowance too: they are sent once that is ensured.
        """
        orders = await self._parts.outbox.unspend(address)
        if not orders:
            return
        self.contracts.reverted(address, min(order.deadline or 0 for order in orders))
        again = [order for order in await self.load() if order.is_open]
        self._send_when_covered(again)
        await self._parts.outbox.release({order.identity for order in orders} - {order.identity for order in again})

    def reorganised(self) -> None:
        """A reorganisation may have reverted the approval of open orders' allowance: they wait until it is ensured."""
        orders = [order for order in self._orders.values() if order.is_open]
        self._send_when_covered([order for order in orders if any(self._chain.costs.of(order.signed).values())])

    async def new_head(self, block: int) -> None:
        """The chain has block `block`: orders, and reverted contracts, with an earlier deadline have expired."""
        for order in list(self._orders.values()):
            if order.deadline <= block:
                self._forget(order)
                if order.is_open:
                    order.close(OrderState.EXPIRED)
        self.contracts.expire(block)
        await self.load()

    async def _ensure_allowance(self, order: TradedOrder) -> None:
        await self._allowances.ensure(order, self._chain.costs.of(order.signed))

    def _send_when_covered(self, orders: Collection[TradedOrder]) -> None:
        """Send these orders of the ledger when the factory has the allowance for them, in a task."""
        self._parts.outbox.hold(order.identity for order in orders)
        costly = [order for order in orders if any(self._chain.costs.of(order.signed).values())]
        free = {order.identity for order in orders} - {order.identity for order in costly}
        if free:
            self._tasks.start(self._parts.outbox.release(free), "resume free orders")
        for order in costly:
            self._tasks.start(self._cover_and_send(order), f"resume {order.identity}")

    async def _cover_and_send(self, order: TradedOrder) -> None:
        try:
            await self._chain.retrying(partial(self._ensure_allowance, order), outages=self._parts.outages)
        except AiraError as error:
            facts = log_event("order-not-covered", order=order.identity, code=error.code)
            log.warning("the %s is open, but no provider can use it now: %s", order, error, extra=facts)
        if order.identity not in self._orders:
            self._allowances.release(order)
        await self._parts.outbox.release([order.identity])

    async def load(self) -> list[TradedOrder]:
        """Take up the orders of the ledger that are not known yet, and what other programs have withdrawn."""
        new = []
        async with self._changing:
            for stored in await self._parts.ledger.orders():
                order, signed = self._orders.get(stored.identity), decode(stored.payload)
                assert isinstance(signed, Demand | Offer)
                if signed.deadline <= self._parts.chain_head.head:
                    continue
                if order is None:
                    order = self._orders[stored.identity] = TradedOrder(signed, stored.posted)
                    self._allowances.count(order, self._chain.costs.of(signed))
                    if isinstance(signed, Demand):
                        self._hear_declines()
                    new.append(order)
                if stored.is_withdrawn and order.is_open:
                    self._allowances.withdraw(order)
                    order.close(OrderState.WITHDRAWN)
        return new

    async def _rejected(self, rejection: Rejection) -> None:
        """A provider says that it can't use an order, or honours its withdrawal. An order that is open stays valid.

        In generation 5 the nonce may be used; whether by this order is known once this agent has read the chain up to
        the block at which the nonce was read.
        """
        identity, provider, reason = rejection.order, rejection.provider, rejection.reason
        order = self._orders.get(identity)
        if order is not None and reason == Refusal.WITHDRAWN:
            order.reject(rejection)
        if order is None or not order.is_open:
            return
        used = await self._chain.liabilities.next_nonce(self._address) if order.nonce is not None else 0
        await self._parts.chain_head.reached(await self._chain.block_number())
        if (order := self._orders.get(identity)) is None or not order.is_open:
            return
        if order.is_overtaken(used - 1):
            await self._renew_overtaken(used - 1)
        elif order.reject(rejection):
            facts = log_event("order-rejected", order=identity, provider=provider, reason=reason)
            why = f"{reason}: {rejection.detail}"
            log.warning("provider %s can't use the %s now (%s)", provider, order, why, extra=facts)

    async def _renew_overtaken(self, used: int | None) -> None:
        """Sign the orders of generation 5 again whose nonce another order of the account has used."""
        for order in [one for one in self._orders.values() if one.is_open and one.is_overtaken(used)]:
            try:
                await self._chain.retrying(partial(self._renew, order), outages=self._parts.outages)
            except AiraError as error:
                self._forget(order)
                await self._parts.outbox.settle(order.identity)
                fail_future(order.created, error)
                facts = log_event("order-abandoned", order=order.identity, code=error.code)
                log.warning("the %s can't be signed again: %s", order, error, extra=facts)

    async def _renew(self, order: TradedOrder) -> None:
        """Replace an order by one with the same terms and a fresh nonce."""
        async with self._changing:
            signed = await self.writer.sign_again(order.signed)
            await self._ensure_allowance(order)
            identity = order.identity
            if not order.is_open or self._orders.pop(identity, None) is None:
                return
            order.signed = signed
            self._orders[order.identity] = order
            await self._parts.outbox.replace(identity, signed)
        facts = log_event("order-renewed", order=identity, renewed=order.identity)
        log.info("the order %s is signed again as %s", identity, order.identity, extra=facts)

    async def _give_up(self, identity: str) -> None:
        """Don't send an offer any more. What providers have of it may still become a contract."""
        if (order := self._orders.get(identity)) is not None:
            self._forget(order)
            order.close(OrderState.WITHDRAWN)
            await self._parts.outbox.settle(identity)

    def _forget(self, order: TradedOrder) -> None:
        self._orders.pop(order.identity, None)
        self._answers.discard(order.identity)
        self._allowances.release(order)
