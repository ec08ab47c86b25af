"""Trading: signs and posts the orders of an account, follows them over restarts, and waits for their contracts."""

from __future__ import annotations

import asyncio
import logging
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.agent.contract import Contract, WatchedContracts, fail_future
from mesh.agent.covering import CoveredOrders
from mesh.agent.demands import current_buyer
from mesh.agent.offers import OpenOffers
from mesh.agent.orders import Order, OrderState, TradedOrder
from mesh.agent.progress import Progress, report, seen_offers
from mesh.agent.statements import received_declines, received_rejections
from mesh.agent.terms import TermsWriter
from mesh.agent.versions import earlier_version
from mesh.agent.withdrawing import ChainWithdrawals
from mesh.background import Background
from mesh.chain import Allowances, OrderAlreadyUsed
from mesh.errors import AiraError, ClosedError
from mesh.flood import SENDERS, KnownSenders
from mesh.log_context import log_event
from mesh.market.refusals import Refusal
from mesh.market.versions import lasting_hash
from mesh.role import Lifecycle
from mesh.work.database import LedgerUnusable
from schemas import Demand, Offer, Withdrawal, decode

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AsyncExitStack

    from mesh.agent.components import AgentComponents
    from mesh.agent.progress import OnProgress
    from mesh.agent.reports import ContractReports
    from mesh.agent.terms import Terms
    from schemas import Liability
    from schemas.signing import Rejection

log = logging.getLogger(__name__)
ENDED: Final = partial(ClosedError, "the agent has ended", hint="run it again: orders stay open until their deadline")


class Trader(Lifecycle):
    """Trades for one account: `async with Trader(components) as trader`.

    Entering takes up the ledger's orders, those of earlier runs and of the account's other programs, and sends them
    once their allowance is ensured. Leaving ends every wait with `ClosedError`; open orders stay in the ledger.
    """

    title = "trader"

    def __init__(self, parts: AgentComponents, reports: ContractReports) -> None:
        self._parts = parts
        self._chain = parts.chain
        self._address = parts.signer.address
        self._allowances = Allowances(parts.chain.tokens, parts.chain.factory, self._address)
        self._orders: dict[str, TradedOrder] = {}
        self._covered = CoveredOrders(parts, self._orders, self._allowances)
        self.writer = TermsWriter(parts, self._orders)
        self._hear_declines: Callable[[], None] = lambda: None
        self.answers = OpenOffers()
        self._changing = asyncio.Lock()
        self._chain_withdrawals = ChainWithdrawals(parts, self._orders)
        self.contracts = WatchedContracts(parts, reports)
        self.customers = KnownSenders()
        """Who demanded the contracts of this account."""

    def orders(self, *states: OrderState) -> list[Order]:
        """The orders that can still become contracts, oldest first: open or withdrawn."""
        by_age = sorted(self._orders.values(), key=lambda order: order.posted)
        return [order.shown(self) for order in by_age if order.state in states]

    async def _open(self, stack: AsyncExitStack) -> None:
        stack.push_async_callback(self._close)
        for promisee in await self._parts.ledger.promisees(SENDERS):
            self.customers.add(promisee)
        self._hear_declines = await stack.enter_async_context(received_declines(self._parts, self._orders))
        resumed = [order for order in await self.load() if order.is_open]
        for order in resumed:
            if isinstance(order.signed, Offer):
                await self._give_up(self.answers.add(order, "", pays=False))
            facts = log_event("order-resumed", order=order.identity, kind=order.signed.kind, deadline=order.deadline)
            log.info("the %s of an earlier run is open until block %d", order, order.deadline, extra=facts)
        await stack.enter_async_context(received_rejections(self._parts, self._orders, self._rejected))
        self._tasks = self._covered.tasks = await stack.enter_async_context(Background())
        self._covered.send([order for order in resumed if order.is_open])

    async def _close(self) -> None:
        for order in self._orders.values():
            fail_future(order.created, ENDED())
        self.contracts.fail(ENDED())

    async def post(self, kind: type[Demand | Offer], terms: Terms, answers: Demand | None = None, **fee: Any) -> Order:
        """Sign an order, which perhaps answers a demand, ensure its allowance, and post it. Cancelling withdraws it.

        Raises `InsufficientTokens`, and `TooManyOffers` for an offer that answers a demand.
        """
        order = TradedOrder(await self.writer.sign(kind, terms, **fee), time.time())
        if kind is Offer and (buyer := current_buyer()) is not None:
            await self._give_up(self.answers.add(order, buyer.maker, pays=buyer.pays))
        self._orders[order.identity] = order
        if kind is Demand:
            self._hear_declines()
        try:
            await self._allowances.ensure(order, self._chain.costs.of(order.signed))
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
        self.answers.answer(answers, order)
        return order.shown(self)

    async def contract_of(self, order: TradedOrder, on_progress: OnProgress) -> Contract:
        """See `Order.contract`."""
        if order.state is OrderState.MATCHED:
            contract = await self.contracts.read(order.liability)
        elif not (order.is_open and self.is_open):
            raise ENDED() if order.is_open else order.why_closed
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
        if order.state is OrderState.WITHDRAWN:  # also if it was before: the disk may have failed then
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
        """A contract was created from orders with these hashes: stop sending ours.

        In generation 3 another account may have signed the same terms; our order, with the same hash, is still open.
        """
        demand = demand_hash.hex() if liability.promisee == self._address else ""
        offer = offer_hash.hex() if liability.promisor == self._address else ""
        if offer:
            self.customers.add(liability.promisee)
        orders = {identity: self._orders.get(identity) for identity in (demand, offer) if identity}
        if demand and orders[demand] is None:
            orders[demand] = earlier_version(self._orders.values(), liability, demand)
        lasting = [lasting_hash(order.signed) if order else identity for identity, order in orders.items()]
        known = self.contracts.created(liability, next(iter(lasting), ""))
        for (identity, order), lasts in zip(orders.items(), lasting, strict=True):
            if order is not None:
                log.info("matched our %s %s", order.state, order, extra=log_event("contract-created", order=identity))
                order.state, order.liability = OrderState.MATCHED, liability.address
                self._forget(order)
            await self._parts.outbox.spend(identity if order is None else order.identity, liability.address)
            if order is not None:
                if order.created is not None and not order.created.done():
                    order.created.set_result(known or self.contracts.watch(liability, order=lasts))
                is_earlier = order.nonce is not None and order.identity != identity
                await self._renew_overtaken(order.nonce - 1 if is_earlier and order.nonce else order.nonce)

    async def liability_reverted(self, address: str) -> None:
        """A reorganisation reverted the contract at `address`: its orders are open again, and sent when covered."""
        orders = await self._parts.outbox.unspend(address)
        if not orders:
            return
        self.contracts.reverted(address, min(order.deadline or 0 for order in orders))
        again = [order for order in await self.load() if order.is_open]
        self._covered.send(again)
        await self._parts.outbox.release({order.identity for order in orders} - {order.identity for order in again})

    def reorganised(self) -> None:
        """A reorganisation may have reverted the allowance of open orders, which wait for it, and withdrawals."""
        self._covered.send([order for order in self._orders.values() if order.is_open])
        if self.is_open:
            self._tasks.start(self._chain_withdrawals.make_again(), "withdraw again on the chain")

    async def new_head(self, block: int) -> None:
        """The chain has block `block`: orders, and reverted contracts, with an earlier deadline have expired."""
        for order in list(self._orders.values()):
            if order.deadline <= block:
                self._forget(order)
                if order.is_open:
                    order.close(OrderState.EXPIRED)
        self.contracts.expire(block)
        await self.load()

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
        """A provider says that it can't use an order, or honours its withdrawal. An open order stays valid.

        A generation-5 nonce may be used; by which order is known when this agent has read the chain that far.
        """
        identity, provider, reason = rejection.order, rejection.provider, rejection.reason
        order = self._orders.get(identity)
        if order is not None and reason == Refusal.WITHDRAWN:
            order.reject(rejection)
        if order is None or not order.is_open:
            return
        used = 0 if order.nonce is None else await self._chain.liabilities.next_nonce(self._address)
        await self._parts.chain_head.reached(await self._chain.block_number())
        if (order := self._orders.get(identity)) is None or not order.is_open:
            return
        if reason == "ERC20InsufficientAllowance" and not order.is_overtaken(used - 1):
            # A reorganisation took the allowance in a block that was not read here.
            self._covered.send([order])
        if order.nonce is not None and order.nonce > used:
            self._tasks.start(self._chain_withdrawals.use_up_nonces(order), f"use up the nonces before {identity}")
        if order.is_overtaken(used - 1):
            await self._renew_overtaken(used - 1)
        elif order.reject(rejection):
            facts = log_event("order-rejected", order=identity, provider=provider, reason=reason)
            log.warning("%s can't use the %s now (%s: %s)", provider, order, reason, rejection.detail, extra=facts)

    async def _renew_overtaken(self, used: int | None) -> None:
        """Sign the orders of generation 5 again whose nonce another order of the account has used."""
        for order in [one for one in self._orders.values() if one.is_open and one.is_overtaken(used)]:
            try:
                await self._chain.retrying(partial(self._renew, order), outages=self._parts.outages)
            except AiraError as error:
                self._forget(order)
                await self._parts.outbox.settle(order.identity)
                fail_future(order.created, error)
                order.close(OrderState.WITHDRAWN)
                facts = log_event("order-abandoned", order=order.identity, code=error.code)
                log.warning("the %s can't be signed again: %s", order, error, extra=facts)

    async def _renew(self, order: TradedOrder) -> None:
        """Replace an order by one with the same terms and a fresh nonce."""
        async with self._changing:
            signed = await self.writer.sign_again(order.signed)
            await self._allowances.ensure(order, self._chain.costs.of(order.signed))
            identity = order.identity
            if not order.is_open or self._orders.pop(identity, None) is None:
                return
            order.signed = signed
            self._orders[order.identity] = order
            await self._parts.outbox.replace(identity, signed)
        facts = log_event("order-renewed", order=identity, renewed=order.identity)
        log.info("the order %s is signed again as %s", identity, order.identity, extra=facts)

    async def _give_up(self, offer: TradedOrder | None) -> None:
        """Stop sending an offer. Providers that have it may still create its contract."""
        if offer is not None and offer.is_open:
            self._forget(offer)
            offer.close(OrderState.WITHDRAWN)
            await self._parts.outbox.settle(offer.identity)

    def _forget(self, order: TradedOrder) -> None:
        self._orders.pop(order.identity, None)
        self.answers.discard(order)
        self._allowances.release(order)
