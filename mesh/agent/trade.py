"""Trading: signs and posts the orders of an account, follows them over restarts, and waits for their contracts.

A demand outlives its program; an offer does not: a robot that is off must not collect contracts. So offers are
withdrawn when the agent ends, and those of an earlier run, which was killed, when it begins. Orders are sent again once
the factory may take what they cost. Withdrawals on the chain that a reorganisation reverts are made
again, and the nonces that it freed used up.
"""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from mesh.agent.contracts import (
    ENDED,
    Contract,
    Progress,
    WatchedContracts,
    fail_future,
    nothing,
    received,
    report,
    request_stop,
    seen_offers,
)
from mesh.agent.handlers import Declined
from mesh.agent.hiring import DemandDeclined, Hiring
from mesh.agent.orders import (
    ALONE,
    DEMAND_TAKEN,
    EQUAL_DECLINED,
    HANDLED_FOR,
    AnsweredDemand,
    AnsweredDemands,
    OpenOffers,
    OrderState,
    OtherRobot,
    TermsWriter,
    TradedOrder,
    demand_taken,
    earlier_version,
    withdrawal_of,
)
from mesh.base.background import Background
from mesh.base.database import LedgerUnusable
from mesh.base.flood import SENDERS, KnownSenders, Rate, RateLimiter
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.chain import Allowances, OrderAlreadyUsed, permit_fee
from mesh.errors import AiraError, ChainError
from mesh.network import PresentAgents
from schemas import Demand, Offer, Withdrawal, decode
from schemas.messages import equal_terms, lasting_hash
from schemas.signing import Decline, Refusal, Rejection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Container, Iterable, Mapping
    from contextlib import AsyncExitStack

    from mesh.agent.components import AgentComponents
    from mesh.agent.contracts import ContractReports, JobAttempts, OnProgress
    from mesh.agent.ledger import StoredOrder
    from mesh.agent.orders import Terms
    from mesh.chain import Chain
    from mesh.network import Channel
    from schemas import Liability, Verified


log = logging.getLogger(__name__)

OnSigned: TypeAlias = "Callable[[Demand | Offer], Awaitable[object]]"
PER_AGENT: Final = Rate(per_second=1.0, burst=32)
"""Declines by one agent that are looked at: it may decline many demands."""
HEARD: Final = Rate(per_second=20.0, burst=200)
"""Declines in all that are looked at."""


@asynccontextmanager
async def received_rejections(
    parts: AgentComponents, orders: Container[str], on_rejection: Callable[[Rejection], Awaitable[None]]
) -> AsyncIterator[None]:
    """Meanwhile call `on_rejection` with each rejection of one of `orders` that a provider of the lighthouse signed.

    A full order book is only logged. It is called again if it raises that the node is away.
    """

    async def check(rejection: Rejection) -> None:
        lighthouse = await parts.chain.lighthouses.get(parts.settings.lighthouse_contract)
        order, signer, reason = rejection.order, rejection.provider, rejection.reason
        if signer not in lighthouse.stakes:
            facts = log_event("rejection-ignored", signer=signer, reason=reason)
            log.warning("%s is not a provider, but rejects: %s", signer, reason, extra=facts)
        elif reason == Refusal.FULL:
            facts = log_event("order-deferred", order=order, provider=signer, reason=reason)
            log.warning("provider %s has no room for the order %s now", signer, order, extra=facts)
        else:
            await on_rejection(rejection)

    async def check_until_known(rejection: Rejection) -> None:
        await parts.chain.retrying(partial(check, rejection), outages=parts.outages)

    async with received(parts, "reject", Rejection, lambda one: one.order in orders, check_until_known) as subscribe:
        subscribe()
        yield


@asynccontextmanager
async def received_declines(
    parts: AgentComponents, orders: Mapping[str, TradedOrder]
) -> AsyncIterator[Callable[[], None]]:
    """Meanwhile report to the waiters of `orders` each decline that an agent or a bridge signed that is present.

    Yields a function to call when there is a demand: a robot that never demands does not subscribe.
    """
    agents, limiter = PresentAgents(parts.channel), RateLimiter(per_sender=PER_AGENT, total=HEARD)

    async def check(decline: Decline) -> None:
        if not limiter.allow(decline.agent) or not await agents.is_present(decline.agent):
            parts.drops.count("declines", decline.agent)
            return
        await parts.robots.find(decline.agent)  # for those who show its name
        if (order := orders.get(decline.order)) is not None and order.is_open and order.decline(decline):
            facts = log_event("order-declined", order=decline.order, agent=decline.agent, code=decline.code)
            log.info("agent %s declines the %s (%s)", decline.agent, order, decline.code, extra=facts)

    async with received(parts, "decline", Decline, lambda one: one.order in orders, check) as subscribe:
        yield subscribe


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """An order of the agent's account at one moment: `agent.orders()`, `agent.order(…)`."""

    message: Demand | Offer
    """The signed demand or offer."""
    hash: str
    """Its hash: 64 hexadecimal digits."""
    state: OrderState
    posted: float
    """When it was posted first: Unix time."""
    liability: str
    """The address of the contract that it became; empty if it became none."""
    _traded: TradedOrder = field(repr=False, compare=False)
    _trader: Trader = field(repr=False, compare=False)

    def __repr__(self) -> str:
        terms = f"model={self.message.model}, objective={self.message.objective}, cost={self.message.cost}"
        became = f", liability={self.liability}" if self.liability else ""
        return f"Order({self.kind} {self.hash}, {self.state}, {terms}, deadline={self.deadline}{became})"

    @property
    def kind(self) -> str:
        """`demand` or `offer`."""
        return self.message.kind

    @property
    def deadline(self) -> int:
        """The block before which it can become a contract."""
        return self.message.deadline

    @property
    def robot(self) -> str:
        """The only robot (address) that it is for; empty for any."""
        return self._traded.robot

    @property
    def honoured_by(self) -> frozenset[str]:
        """The providers (addresses) that have signed that they honour its withdrawal, as of now."""
        return self._traded.honoured_by

    async def withdraw(self) -> Order:
        """Withdraw the order; returns it in its new state. `honoured_by` names the providers that obey.

        A signed withdrawal is sent until the deadline, instead of the order. A provider that is creating its contract,
        or does not know or obey the withdrawal, may still use it, so the allowance covers it until the deadline. Raises
        `OrderClosed` if the order has become a contract.
        """
        return await self._trader.withdraw(self._traded)

    async def call_off(self) -> None:
        """Withdraw the demand; while this agent runs, the job of a contract that is made of it all the same is stopped.

        Its robot is asked once; one that can't be reached may still do the job, and is paid for it then.

        Raises `OrderClosed` if it has become a contract before.
        """
        await self._trader.call_off(self._traded)

    async def withdraw_on_chain(self) -> Order:
        """Withdraw the order by a transaction too, after which no provider can create its contract.

        In generation 5 the transaction uses up the order's nonce. Raises `OrderClosed` if the order has become a
        contract, `NotOffered` if the contracts are the originals, and the errors of sending a transaction.
        """
        return await self._trader.withdraw_on_chain(self._traded)

    async def contract(self, *, on_progress: OnProgress = nothing, wait: bool = True) -> Contract:
        """Wait until the order is a contract. Cancelling the wait changes nothing.

        Without `wait`, a demand is withdrawn once all robots of its model that are present have declined, and
        `DemandDeclined` has their reasons.

        `on_progress` is called with offers for a demand, agents' declines, providers' rejections (both also earlier
        ones), and the contract. After a decline or a rejection the order stays valid. Raises `OrderClosed` if the order
        was withdrawn, `OrderExpired` at its deadline, `ClosedError` if the agent ends first.
        """
        if wait or self.kind == "offer":
            return await self._trader.contract_of(self._traded, on_progress)
        return await self._trader.contract_unless_declined(self._traded, on_progress)


UNCOVERED: Final = ("ERC20InsufficientAllowance", "FeeNotPermitted")
"""Rejections of an order whose allowance or permit is gone."""


async def are_permits_carried(channel: Channel, chain: Chain, account: str) -> bool:
    """Whether a provider here takes permits: those of 2018, behind a bridge, don't. Without ether, hope for one.

    Raises `NodeUnreachable`, `RequestRefused`.
    """
    return bool(await channel.present("provider")) or not await chain.tokens.eth_balance(account)


STOP_SECONDS: Final = 3.0
"""For which an agent that ends waits until the providers have confirmed that they use none of its offers."""


class Trader(Lifecycle):
    """Trades for one account: `async with Trader(components) as trader`.

    Entering takes up the ledger's orders, those of earlier runs and of the account's other programs, and sends the
    demands once their allowance is ensured. Leaving withdraws the offers of this run, for `STOP_SECONDS` at most; what
    no provider has heard by then is sent by the next run. It ends every wait with `ClosedError`; demands stay open.
    """

    title = "trader"
    _hear_declines: Callable[[], None] | None = None
    """Subscribes to declines, once there is a demand; None before it is open: `aira order` only reads and withdraws."""

    def __init__(self, parts: AgentComponents, reports: ContractReports) -> None:
        self._parts = parts
        self._chain = parts.chain
        self._address = parts.signer.address
        are_carried = partial(are_permits_carried, parts.channel, parts.chain, self._address)
        self._allowances = Allowances(
            parts.chain.tokens, parts.chain.factory, self._address, parts.chain.permits, are_carried
        )
        self._orders: dict[str, TradedOrder] = {}
        self.writer = TermsWriter(parts, self._orders)
        self.answers = OpenOffers()
        self.answered = AnsweredDemands()
        self.ask_again: Callable[[Verified[Demand]], object] = lambda _demand: None
        """Called with a demand whose offer was taken back, or used for another one: its handlers decide again."""
        self.on_offer: Callable[[Offer, str], object] = lambda _offer, _customer: None
        """Called with an offer that was posted, and the customer (address; empty: anybody) whose demand it answers."""
        self.full: Callable[[], Declined | None] = lambda: None
        """Returns the refusal of one more job, if the agent has no place for it."""
        self._heard = asyncio.Event()
        """Set when a provider has said that it honours a withdrawal."""
        self._changing = asyncio.Lock()
        self._withdrawing = asyncio.Lock()
        """Held while it withdraws on the chain unasked."""
        self._renewing = asyncio.Lock()
        """Held while it asks which nonces are used."""
        self.contracts = WatchedContracts(parts, reports)
        self.customers = KnownSenders()
        """Who demanded the contracts of this account."""

    def orders(self, *states: OrderState) -> list[Order]:
        """The orders that can still become contracts, oldest first: open or withdrawn."""
        by_age = sorted(self._orders.values(), key=lambda order: order.posted)
        return [self._shown(order) for order in by_age if order.state in states]

    def _shown(self, order: TradedOrder) -> Order:
        return Order(
            message=order.signed,
            hash=order.identity,
            state=order.state,
            posted=order.posted,
            liability=order.liability,
            _traded=order,
            _trader=self,
        )

    async def _open(self, stack: AsyncExitStack) -> None:
        stack.push_async_callback(self._close)
        for promisee in await self._parts.ledger.promisees(SENDERS):
            self.customers.add(promisee)
        self._hear_declines = await stack.enter_async_context(received_declines(self._parts, self._orders))
        for kind in ("demand", "offer") if self._parts.settings.generation == 5 else ():
            for payload, _ in reversed(await self._parts.ledger.contracts(kind)):  # the newest are kept longest
                signed = decode(payload)
                assert isinstance(signed, Demand | Offer)
                self.writer.remember(signed)
        resumed = [order for order in await self.load() if order.is_open]
        offers = [order for order in resumed if isinstance(order.signed, Offer)]
        self._parts.outbox.hold(order.identity for order in offers)  # those of another program, it sends
        resumed = [order for order in resumed if order not in offers]
        for order in resumed:
            facts = log_event("order-resumed", order=order.identity, kind=order.signed.kind, deadline=order.deadline)
            log.info("the %s of an earlier run is open until block %d", order, order.deadline, extra=facts)
        await stack.enter_async_context(received_rejections(self._parts, self._orders, self._rejected))
        self._tasks = await stack.enter_async_context(Background())
        self.hiring = Hiring(self._parts, self._tasks, rejected=self._pair_rejected, declined=self._pair_declined)
        self._parts.outbox.send_alone = self.hiring.send
        self._parts.outbox.permit_for = lambda demand: self._chain.permits.own(demand.token)
        self._send_covered(resumed)
        stack.push_async_callback(self._withdraw_at_end)

    async def withdraw_earlier_offers(self) -> None:
        """Withdraw the offers of an earlier run, which was killed: what handlers still agree to is offered again."""
        await self._withdraw([order for order in self._offers() if not order.is_ours])

    async def _withdraw_at_end(self) -> None:
        """Withdraw the offers of this run, and wait until the providers that are present have confirmed that."""
        offers = [order for order in self._offers() if order.is_ours]
        if not offers:
            return
        try:
            async with asyncio.timeout(STOP_SECONDS):
                await self._withdraw(offers)
                if self._parts.network.connected:
                    present = {key.agent for key in await self._parts.channel.present("provider")}
                    while not all(present <= {one.lower() for one in order.honoured_by} for order in offers):
                        self._heard.clear()
                        await self._heard.wait()
        except (TimeoutError, AiraError) as error:
            facts = log_event("offers-not-withdrawn", offers=len(offers), code=getattr(error, "code", "timeout"))
            text = "not all providers confirmed to use none of the %d offers; the next start withdraws them again"
            log.warning(text, len(offers), extra=facts)

    def _offers(self) -> list[TradedOrder]:
        return [order for order in self._orders.values() if order.is_open and isinstance(order.signed, Offer)]

    async def _close(self) -> None:
        for order in self._orders.values():
            fail_future(order.created, ENDED())
        self.contracts.fail(ENDED())

    async def post(
        self,
        kind: type[Demand | Offer],
        terms: Terms,
        answers: AnsweredDemand | None = None,
        *,
        robot: str = "",
        attempts: JobAttempts | None = None,
        on_signed: OnSigned | None = None,
        **fee: Any,
    ) -> Order:
        """Sign an order, which perhaps answers a demand, ensure its allowance, and post it.

        Cancelling calls a demand off and withdraws an offer. A demand for one `robot` (address) alone is posted once
        that has agreed; raises `DemandDeclined`, `RemoteError`.

        `attempts` are what follows when the contract of a demand fails. `on_signed` is awaited with the signed order
        before anybody else gets that.

        Raises `InsufficientTokens`, and for an offer that answers a demand `TooManyOffers`, the error of a demand that
        is taken, and `Declined` while a demand with equal terms is open that the agent has declined, or the agent has
        no place for one more job.
        """
        order = TradedOrder(await self.writer.sign(kind, terms, **fee), time.time(), robot=robot, is_ours=True)
        if isinstance(order.signed, Demand) and robot:
            await self._agree(order)
        if attempts is not None:
            attempts.ordered(order.identity, order.deadline)
            order.attempts, order.created = attempts, asyncio.get_running_loop().create_future()
        if on_signed is not None:
            await on_signed(order.signed)
        if kind is Offer and (asked := ALONE.get()) is not None:
            if equal_terms(order.signed) != equal_terms(asked.demand.message):
                raise Declined("other-terms", f"it asks for other terms: a cost of {order.signed.cost}")
            order.robot, answers = self._address, asked
        if answers is not None:
            if answers.is_over:
                raise demand_taken(answers.demand.hash.hex())
            for declined in self.answered.declined_like(order.signed):
                if declined is not answers:
                    text = f"it declined the demand {declined.demand.hash.hex()[:16]}… with equal terms, which is open"
                    raise Declined(EQUAL_DECLINED, text)
        if kind is Offer and (buyer := HANDLED_FOR.get()) is not None:
            if (full := self.full()) is not None:  # other handlers may have offered since this one was called
                raise full
            await self._give_up(self.answers.add(order, buyer.maker, pays=buyer.pays))
        self._orders[order.identity] = order
        if answers is not None:
            answers.offer, answers.is_declined = order, False
        if kind is Demand and self._hear_declines is not None:
            self._hear_declines()
        try:
            await self._ensure(order)
        except BaseException:
            self._forget(order)
            raise
        try:
            if order.is_open:
                await self._parts.outbox.post(order.signed, robot=order.robot)
                if isinstance(order.signed, Offer):
                    self.on_offer(order.signed, "" if answers is None else answers.demand.signer)
        except asyncio.CancelledError:
            await self.call_off(order)
            raise
        except LedgerUnusable:
            self._forget(order)
            raise
        return self._shown(order)

    async def _agree(self, order: TradedOrder) -> None:
        """Get the robot's offer for a demand; one of generation 5 is signed again if its nonce was used meanwhile.

        Another program of the account has used it then, and the robot says that the demand is taken.
        """
        while True:
            assert isinstance(order.signed, Demand)
            try:
                return await self.hiring.agree(order.signed, order.robot)
            except DemandDeclined as error:
                if error.declines[0].code != DEMAND_TAKEN or order.nonce is None:
                    raise
                ask = partial(self._chain.liabilities.next_nonce, self._address)
                if await self._chain.retrying(ask, outages=self._parts.outages) <= order.nonce:
                    raise
                order.signed = await self.writer.sign_again(order.signed)

    async def require_open(self, answered: AnsweredDemand) -> None:
        """Raise the error of a demand that is taken if one has become a contract, or was withdrawn on the chain.

        What happens after this call is noticed: by then the demand is one of `answered`.
        """
        demand, digest, maker = answered.demand.message, answered.demand.hash, answered.demand.signer
        ask = partial(self._chain.liabilities.is_used, demand, order_hash=digest, signer=maker)
        if answered.is_over or await self._chain.retrying(ask, outages=self._parts.outages):
            self.answered.forget(answered)
            raise demand_taken(digest.hex())

    async def decline(self, declined: AnsweredDemand) -> None:
        """The handlers have declined a demand: withdraw the offers with equal terms, which match it, too.

        The handlers decide again on the other demands that these offers answered.
        """
        declined.is_declined, terms = True, equal_terms(declined.demand.message)
        offers = [order for order in self._offers() if equal_terms(order.signed) == terms]
        await self._take_back(offers, "a demand with equal terms was declined")
        for order in offers:
            self._ask_again(self.answered.offered_by(order), declined)

    async def taken(self, liability: Liability, demand: bytes, offer: TradedOrder | None = None) -> None:
        """A demand became a contract, with our `offer` or another's: withdraw an offer of ours that is left over.

        If our offer was made for another demand with equal terms, what was made for this one now answers that.
        """
        taken = self.answered.find(liability.promisee, demand.hex(), liability)
        left = None if taken is None else taken.offer
        if taken is not None:
            self._end(taken)
        if offer is not None and offer is not left and (other := self.answered.offered_by(offer)) is not None:
            other.offer, left = left, None
            if not other.is_answered:
                self._ask_again(other)
        if left is not None and left is not offer:
            await self._take_back([left], "its demand became a contract with another offer")

    async def demand_withdrawn(self, withdrawal: Verified[Withdrawal]) -> None:
        """The maker of a demand has withdrawn it: withdraw the offer that answers it."""
        known = self.answered.find(withdrawal.signer, withdrawal.message.order)
        if known is not None:
            self._end(known)
            await self._take_back([known.offer] if known.offer else [], "its demand was withdrawn")

    def _end(self, known: AnsweredDemand) -> None:
        known.is_over = True
        self.answered.forget(known)

    def _ask_again(self, answered: AnsweredDemand | None, but: AnsweredDemand | None = None) -> None:
        if answered is not None and answered is not but:
            self.ask_again(answered.demand)

    async def take_back_offers(self, why: str) -> None:
        await self._take_back(self._offers(), why)

    async def _take_back(self, offers: Iterable[TradedOrder], why: str) -> None:
        """Withdraw the open ones of these offers."""
        left = [offer for offer in offers if offer.is_open]
        for offer in left:
            log.debug("%s is taken back: %s", offer, why)
        try:
            await self._withdraw(left)
        except LedgerUnusable as error:
            self._parts.outbox.hold(offer.identity for offer in left)
            facts = log_event("offers-not-withdrawn", offers=len(left), code=error.code)
            log.warning("%d offers are sent no more, but can't be withdrawn now: %s", len(left), error, extra=facts)

    def _send_covered(self, orders: Collection[TradedOrder]) -> None:
        """Send these orders of the ledger when the factory has the allowance for them, in a task."""
        outbox, cost_of = self._parts.outbox, self._chain.funds.cost_of
        outbox.hold(order.identity for order in orders)
        costly = [order for order in orders if any(cost_of(order.signed).values())]
        if free := {order.identity for order in orders} - {order.identity for order in costly}:
            self._tasks.start(outbox.release(free), "resume free orders")
        for order in costly:
            self._tasks.start(self._cover_and_send(order), f"resume {order.identity}")

    async def _ensure(self, order: TradedOrder) -> None:
        """Make sure that the factory may take what an order costs, for a demand by a permit if the token has such."""
        signed, costs, ensure = order.signed, self._chain.funds.cost_of(order.signed), self._allowances.ensure
        if isinstance(signed, Demand):  # a fee for a permit is paid with one only
            await ensure(order, costs, permit=signed.token, always=permit_fee(signed) > 0)
        else:
            await ensure(order, costs)

    async def _cover_and_send(self, order: TradedOrder) -> None:
        chain = self._chain
        try:
            await chain.retrying(partial(self._ensure, order), outages=self._parts.outages)
        except AiraError as error:
            facts = log_event("order-not-covered", order=order.identity, code=error.code)
            log.warning("the %s is open, but no provider can use it now: %s", order, error, extra=facts)
        if order.identity not in self._orders:
            self._allowances.release(order)
        await self._parts.outbox.release([order.identity])

    async def contract_of(self, order: TradedOrder, on_progress: OnProgress) -> Contract:
        """See `Order.contract`."""
        created = order.created
        if order.state is OrderState.MATCHED and (created is None or (created.done() and created.exception())):
            contract = await self.contracts.read(order.liability)  # perhaps it was withdrawn before
        elif order.state is OrderState.MATCHED and created is not None:
            contract = await asyncio.shield(created)
        elif not (order.is_open and self.is_open):
            raise ENDED() if order.is_open else order.why_closed
        else:
            heard = nothing if order.robot else on_progress
            order.expect_contract()  # now: it may become one while the subscription opens
            async with seen_offers(self._parts, order.signed, heard):
                contract = await order.contract(on_progress)
        promisor, address = contract.liability.promisor, contract.address
        await self._parts.robots.find(promisor)  # for those who show its name
        report(on_progress, Progress(kind="contract", agent=promisor, detail=address))
        if isinstance(order.signed, Demand) and order.robot not in ("", promisor):
            raise OtherRobot(order.identity, robot=order.robot, promisor=promisor, liability=address)
        return contract

    async def contract_unless_declined(self, order: TradedOrder, on_progress: OnProgress) -> Contract:
        """As `contract_of`, until all robots of the model that are present have declined: then it is withdrawn.

        Robots of the legacy network can't be counted, so nothing ends while a bridge is present. Raises
        `DemandDeclined`.
        """

        async def robots() -> list[str]:
            if order.robot:
                return [order.robot]
            if await self._parts.channel.present("bridge"):
                return []
            return [robot.address for robot in await self._parts.robots.present(order.signed.model)]

        async with Background() as tasks:
            contract: asyncio.Task[Contract] = tasks.start(
                self.contract_of(order, on_progress), f"contract of {order.identity}"
            )
            declined = tasks.start(order.all_declined(robots), f"declines of {order.identity}")
            await asyncio.wait((contract, declined), return_when=asyncio.FIRST_COMPLETED)
            if not contract.done():
                said, identity = declined.result(), order.identity
                contract.cancel()
                await self._withdraw([order])
                raise DemandDeclined(identity, said)
            return contract.result()

    async def withdraw(self, order: TradedOrder) -> Order:
        """See `Order.withdraw`."""
        if order.state is OrderState.MATCHED:
            raise order.why_closed
        await self._withdraw([order])
        return self._shown(order)

    async def call_off(self, order: TradedOrder) -> None:
        """See `Order.call_off`."""
        order.is_called_off = True
        await self.withdraw(order)

    async def _stop_called_off(self, liability: Liability) -> None:
        """Stop a job whose contract was on its way when its demand was called off."""
        parts, why = self._parts, "its customer has called it off"
        try:
            await request_stop(parts.network.session, parts.signer, liability, why)
        except AiraError as error:  # then it is done after all, or refunded at its deadline
            facts = log_event("called-off-not-stopped", robot=liability.promisor, code=error.code)
            log.warning("%s does not stop the job, which was called off: %s", liability.promisor, error, extra=facts)

    async def _withdraw(self, orders: Iterable[TradedOrder]) -> None:
        """Withdraw those of some orders that are not contracts, and have not expired."""
        withdrawals = []
        for order in orders:
            if order.is_open:
                self._allowances.withdraw(order)
                self.answers.discard(order)
                order.close(OrderState.WITHDRAWN)
                facts = log_event("order-withdrawn", order=order.identity, deadline=order.deadline)
                log.info("the %s is withdrawn", order, extra=facts)
            if order.state is OrderState.WITHDRAWN:  # also if it was before: the disk may have failed then
                withdrawals.append(self._parts.signer.sign(withdrawal_of(order.signed)))
        if withdrawals:
            await self._parts.outbox.withdraw(*withdrawals)

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
        return self._shown(order)

    async def _withdraw_again(self) -> None:
        """Withdraw each order again whose withdrawal the chain has lost, until its deadline.

        Without that, somebody could still make a contract of it. In generation 5, no later order of the account would
        be valid, either: their nonces are ahead of the chain's.
        """
        parts = self._parts
        async with self._withdrawing:
            for order in await parts.ledger.withdrawn_on_chain(head=parts.chain_head.contract_block):
                try:
                    await parts.chain.retrying(partial(self._ensure_withdrawn, order), outages=parts.outages)
                except AiraError as error:
                    facts = log_event("order-not-withdrawn", order=order.identity, code=error.code)
                    log.warning("order %s is not withdrawn on the chain now: %s", order.identity, error, extra=facts)

    async def _use_up_nonces(self, order: TradedOrder) -> None:
        """Use up the nonces before that of an open order, unless another open order of the account has one.

        In generation 5 a reorganisation may free them: it reverts the contract of an earlier order, which has expired
        or was withdrawn since. The open order may not be signed again with such a nonce: both could become contracts.
        """
        if self._withdrawing.locked():
            return
        parts = self._parts
        async with self._withdrawing:
            await asyncio.sleep(3 * parts.chain.node.timing.poll_interval)  # the node may have been a block behind
            try:
                while order.is_open:
                    nonce = await parts.chain.liabilities.next_nonce()
                    is_waiting = any(one.is_open and one.nonce == nonce for one in self._orders.values())
                    if is_waiting or order.nonce is None or order.nonce <= nonce:
                        return
                    await parts.chain.liabilities.withdraw(await self.writer.sign_again(order.signed))
                    facts = log_event("nonce-used-up", order=order.identity, nonce=nonce)
                    log.warning("the nonce %d before that of the %s was free; used up", nonce, order, extra=facts)
            except OrderAlreadyUsed:
                return  # another program of the account was faster
            except AiraError as error:
                facts = log_event("nonce-not-used-up", order=order.identity, code=error.code)
                log.warning("the nonce before that of the %s can't be used up now: %s", order, error, extra=facts)

    async def _ensure_withdrawn(self, withdrawn: StoredOrder) -> None:
        parts, order = self._parts, decode(withdrawn.payload)
        assert isinstance(order, Demand | Offer)
        digest = bytes.fromhex(withdrawn.identity)
        if await parts.chain.liabilities.is_used(order, order_hash=digest, signer=parts.signer.address):
            return
        if await parts.chain.node.has_transaction(withdrawn.tx):
            return  # it waits in the pool
        try:
            tx = (await parts.chain.liabilities.withdraw(order)).tx
        except OrderAlreadyUsed:
            return
        await parts.ledger.use_up(withdrawn.identity, tx)
        facts = log_event("order-withdrawn-again", order=withdrawn.identity, tx=tx)
        log.warning("a reorganisation reverted the withdrawal of %s; withdrawn again", withdrawn.identity, extra=facts)

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
                log.info("matched our %s %s", order.state, order, extra=log_event("order-matched", order=identity))
                if order.is_called_off and identity == demand:
                    self._tasks.start(self._stop_called_off(liability), f"stop {liability.address}")
                order.state, order.liability = OrderState.MATCHED, liability.address
                self._forget(order)
            await self._parts.outbox.spend(identity if order is None else order.identity, liability.address)
            if order is not None:
                if isinstance(order.signed, Offer):
                    await self.taken(liability, demand_hash, order)
                if order.created is not None and not order.created.done():
                    contract = known or self.contracts.watch(liability, order=lasts)
                    if order.attempts is not None and contract.attempts is None:
                        contract.attempts = order.attempts
                        self._tasks.start(order.attempts.run(contract), f"attempts {identity}")
                    order.created.set_result(contract)
                is_earlier = order.nonce is not None and order.identity != identity
                await self._renew_overtaken(order.nonce - 1 if is_earlier and order.nonce else order.nonce)

    async def liability_reverted(self, address: str) -> None:
        """A reorganisation reverted the contract at `address`: its orders are open again, and sent when covered."""
        orders = await self._parts.outbox.unspend(address)
        if not orders:
            return
        self.contracts.reverted(address, min(order.deadline or 0 for order in orders))
        again = [order for order in await self.load() if order.is_open]
        for order in again:
            order.is_ours = True
        self._send_covered(again)
        await self._parts.outbox.release({order.identity for order in orders} - {order.identity for order in again})

    def reorganised(self) -> None:
        """A reorganisation may have reverted the allowance of open orders, which wait for it, and withdrawals."""
        if self.is_open:
            self._send_covered([order for order in self._orders.values() if order.is_open])
            self._tasks.start(self._withdraw_again(), "withdraw again on the chain")

    async def new_head(self, block: int) -> None:
        """The chain has block `block`: orders, and reverted contracts, with an earlier deadline have expired."""
        for order in list(self._orders.values()):
            if order.deadline <= block:
                self._forget(order)
                if order.is_open:
                    order.close(OrderState.EXPIRED)
        self.contracts.expire(block)
        await self.contracts.settle()
        self.answered.expire(block)
        await self.load()
        if not self._renewing.locked() and any(one.is_open and one.nonce is not None for one in self._orders.values()):
            self._tasks.start(self._renew_used(), "sign orders again")

    async def load(self) -> list[TradedOrder]:
        """Take up the orders of the ledger that are not known yet, and what other programs have withdrawn."""
        new = []
        async with self._changing:
            for stored in await self._parts.ledger.orders():
                order, signed = self._orders.get(stored.identity), decode(stored.payload)
                assert isinstance(signed, Demand | Offer)
                if signed.deadline <= self._parts.chain_head.contract_block:
                    continue
                if order is None:
                    order = self._orders[stored.identity] = TradedOrder(signed, stored.posted, robot=stored.robot)
                    self.writer.remember(signed)
                    self._allowances.count(order, self._chain.funds.cost_of(signed))
                    if isinstance(signed, Demand) and self._hear_declines is not None:
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
            self._heard.set()
        if order is None or not order.is_open:
            return
        used = 0 if order.nonce is None else await self._chain.liabilities.next_nonce(self._address)
        await self._parts.chain_head.reached(await self._chain.block_number())
        if (order := self._orders.get(identity)) is None or not order.is_open:
            return
        if reason in UNCOVERED and not order.is_overtaken(used - 1):
            # A reorganisation took the allowance in a block that was not read here.
            self._send_covered([order])
        if order.nonce is not None and order.nonce > used:
            self._tasks.start(self._use_up_nonces(order), f"use up the nonces before {identity}")
        if order.is_overtaken(used - 1):
            await self._renew_overtaken(used - 1)
        elif order.reject(rejection):
            facts = log_event("order-rejected", order=identity, provider=provider, reason=reason)
            log.warning("%s can't use the %s now (%s: %s)", provider, order, reason, rejection.detail, extra=facts)

    def _pair_rejected(self, rejection: Rejection) -> None:
        """A provider does not take an order with the offer of its robot now. The pair is sent again."""
        if (order := self._orders.get(rejection.order)) is not None and order.is_open and order.reject(rejection):
            facts = log_event("order-rejected", order=rejection.order, provider=rejection.provider)
            why = rejection.reason, rejection.detail
            log.warning("%s can't use the %s now (%s: %s)", rejection.provider, order, *why, extra=facts)
            if rejection.reason in UNCOVERED:  # another order has used the permit
                self._send_covered([order])

    def _pair_declined(self, decline: Decline) -> None:
        """The robot that an order is for has agreed before, and does not any more."""
        if (order := self._orders.get(decline.order)) is not None and order.is_open:
            order.decline(decline)

    async def _renew_used(self) -> None:
        """Sign the orders of generation 5 again whose nonce is used, though no contract of theirs was read.

        A withdrawal has used it, or another program of the account. Nobody else says so: robots take such an order for
        one that has become a contract, and offer nothing.
        """
        async with self._renewing:
            try:
                # In the state of the block that was handled last: all contracts until then are known.
                used = await self._chain.liabilities.next_nonce(self._address, block=self._parts.chain_head.head)
            except ChainError as error:
                log.debug("the nonces of the open orders are looked at after the next block: %s", error)
            else:
                await self._renew_overtaken(used - 1)

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
            await self._ensure(order)
            identity = order.identity
            if not order.is_open or self._orders.pop(identity, None) is None:
                return
            order.signed = signed
            self._orders[order.identity] = order
            await self._parts.outbox.replace(identity, signed, robot=order.robot)
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
