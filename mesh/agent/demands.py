"""Demands on their way to an agent's handlers: makers in turn, those who pay more first, nobody who can't pay.

Anybody can sign demands, with any number of keys. What a handler does with one may be expensive (fetching the
objective, offering), so few are handled at once, and those that pay nothing never take all places. What an agent does
not work for it declines: it says so, signed, and why. `Acceptance` answers demands for this robot alone, `Quoting` what
a job would cost: what its handler says, or by default its owner's price, or that of its model's description.
"""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from msgspec.structs import replace

from mesh.agent._owner_rules import FOR_NOW
from mesh.agent.handlers import Declined, call, call_handler
from mesh.agent.objectives import Buyer, ObjectiveNotFetched, ObjectiveUnfit
from mesh.agent.orders import ALONE, DEMAND_TAKEN, EQUAL_DECLINED, HANDLED_FOR, ORDER_LIFETIME, TooManyOffers
from mesh.base.database import LedgerUnusable
from mesh.base.flood import UNFUNDED_POLLS, FairQueue, Rate, RateLimiter
from mesh.base.log_context import log_event
from mesh.content import ContentTooLarge, ContentUnavailable
from mesh.errors import AiraError, ContentError, InvalidMessage, public_text
from schemas import DeclineKey, Offer, Verified, message_hash
from schemas.cid import is_cid
from schemas.rpc import Accepted, Quote, SendOffer
from schemas.signing import LONGEST_DETAIL, Decline

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.agent._owner_rules import OwnerRules
    from mesh.agent._profile import OwnProfile
    from mesh.agent.components import AgentComponents
    from mesh.agent.handlers import Handler, QuoteHandler
    from mesh.agent.objectives import Objectives
    from mesh.agent.trade import Trader
    from mesh.base.flood import Drops
    from mesh.network import Channel, Subscription
    from schemas import Demand, Signer
    from schemas.model import ModelDescription
    from schemas.rpc import AcceptDemand, QuoteRequest

log = logging.getLogger(__name__)

PER_MAKER: Final = Rate(per_second=1.0, burst=32)
"""Declines of one maker's demands."""
DECLINES: Final = Rate(per_second=10.0, burst=200)
"""Declines in all: each is signed, logged and published."""


class Grounds(NamedTuple):
    """Why a demand is declined: a word for programs, and a line for people."""

    code: str
    detail: str


BUSY: Final = Grounds("busy", "too many demands and offers wait; it looks at the demand again when it is sent again")


def grounds_of(error: AiraError) -> Grounds | None:
    """Why a demand is declined whose handler raised this error; None if the error says nothing about the demand."""
    match error:
        case Declined():
            return Grounds(error.reason, error.detail)
        case ObjectiveUnfit():
            return Grounds(error.reason, error.detail)
        case ObjectiveNotFetched(reason="rate" | "shared") | TooManyOffers():
            return BUSY
        case ContentTooLarge():
            return Grounds("too-large", "the objective is larger than it allows")
        case ContentError():  # its own text is about this agent's store and peers
            return Grounds("objective-unavailable", "it could not fetch the objective from anybody")
    return None


def is_expected(error: AiraError) -> bool:
    """Whether a handler that ended with this error has decided on the demand, and not failed."""
    return isinstance(error, ObjectiveNotFetched | Declined) or error.code == DEMAND_TAKEN


def signed_decline(demand: Verified[Demand], grounds: Grounds, signer: Signer) -> Decline:
    """The statement of an agent that it does not work for a demand, which is logged."""
    order, code = demand.hash.hex(), grounds.code
    facts = log_event("demand-declined", order=order, maker=demand.signer, code=code)
    log.info("declined the demand %s of %s (%s): %s", order, demand.signer, code, grounds.detail, extra=facts)
    detail = public_text(grounds.detail, longest=LONGEST_DETAIL)
    return Decline(order=order, code=code, detail=detail, agent=signer.address).signed_by(signer)


class DeclinePublisher:
    """Publishes an agent's declines on its market's `channel`; beyond a rate they are only counted in `drops`."""

    def __init__(self, channel: Channel, signer: Signer, drops: Drops) -> None:
        self._channel = channel
        self._signer = signer
        self._drops = drops
        self._limiter = RateLimiter(per_sender=PER_MAKER, total=DECLINES)

    def decline(self, demand: Verified[Demand], grounds: Grounds) -> None:
        """Say to the maker of a demand why this agent does not work for it."""
        if not self._limiter.allow(demand.signer):
            self._drops.count("declines", demand.signer)
            return
        key = str(DeclineKey(self._channel.lighthouse, demand.signer))
        self._channel.put(key, signed_decline(demand, grounds, self._signer).encode())


class DemandLimits(NamedTuple):
    """What strangers' demands may use of an agent."""

    waiting: int = 16_384
    """Demands that wait for the check of their funds, and as many for a handler."""
    handled: int = 32
    """Demands that are handled at once: to fetch the objective of one may take long."""
    free_handled: int = 16
    """Of these, demands that pay nothing."""
    free_rate: Rate = Rate(per_second=4.0, burst=64)
    """Demands that pay nothing and are handled. Each offer for one may become a job."""
    unfunded_of_one: int = 16
    """Demands of one maker that wait for its funds …"""
    unfunded: int = 256
    """… and in all: one request to the node asks for so many."""


DEMAND_LIMITS: Final = DemandLimits()
LOGGED: Final = Rate(per_second=0.2, burst=20)
"""Failures of handlers with the same code that are logged."""


class DemandDispatcher:
    """Calls `handlers` with the demands of a subscription that the `rules` allow: `await dispatcher.run()`.

    A demand whose maker can't pay now waits for `UNFUNDED_POLLS` looks at the chain, because an approval or a payment
    may be under way, or the node a block behind the maker's; after that its next copy is looked at. Pay counts in
    `token` (an address) only. What is not handled is counted, what makers with money should know is declined, and what
    the handlers decide goes to `trader`.
    """

    def __init__(
        self,
        subscription: Subscription[Demand],
        handlers: Sequence[Handler],
        parts: AgentComponents,
        trader: Trader,
        rules: OwnerRules,
        objectives: Objectives,
        *,
        token: str,
    ) -> None:
        limits = DEMAND_LIMITS
        self._subscription = subscription
        self._handlers = handlers
        self._chain = chain = parts.chain
        self._token = token
        self._trader = trader
        self._rules = rules
        self._objectives = objectives
        trader.ask_again = self._ask_again
        self._pause = UNFUNDED_POLLS * chain.node.timing.poll_interval
        self._outages = parts.outages
        self._declines = DeclinePublisher(parts.channel, parts.signer, parts.drops)
        self._drops = parts.drops
        self._arrived: FairQueue[Verified[Demand]] = FairQueue(per_sender=limits.waiting, total=limits.waiting)
        self._funded: FairQueue[Verified[Demand]] = FairQueue(per_sender=limits.waiting, total=limits.waiting)
        self._unfunded: FairQueue[tuple[Verified[Demand], int]] = FairQueue(
            per_sender=limits.unfunded_of_one, total=limits.unfunded
        )
        """Demands whose makers can't pay, and how often that was looked at."""
        self._changed = asyncio.Event()
        self._running = self._running_free = 0
        self._logged = RateLimiter(per_sender=LOGGED)
        self._free_rate = RateLimiter(per_sender=limits.free_rate, total=limits.free_rate)

    async def run(self) -> None:
        """Receive, check and handle demands, until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._receive(), name="demands")
            tasks.create_task(self._check_arrived(), name="funds of demands")
            tasks.create_task(self._check_unfunded(), name="funds that were missing")
            await self._handle(tasks)

    async def _receive(self) -> None:
        async for demand in self._subscription:
            is_customer = demand.signer in self._trader.customers
            for dropped in self._arrived.put(demand.signer, demand, priority=int(is_customer)):
                self._drop(dropped, "queue-full")

    async def _check_arrived(self) -> None:
        while True:
            arrived = await self._arrived.get_batch(512)
            await self._check([(demand, 0) for demand in arrived])

    async def _check_unfunded(self) -> None:
        while True:
            await asyncio.sleep(self._chain.node.timing.poll_interval)
            await self._check(await self._unfunded.get_batch(DEMAND_LIMITS.unfunded))

    async def _check(self, demands: Sequence[tuple[Verified[Demand], int]]) -> None:
        """Pass on the demands whose makers can pay; the others wait, by how often they were looked at before."""
        question = partial(self._chain.funds.shortages, [demand for demand, _ in demands])
        shortages = await self._chain.retrying(question, outages=self._outages)
        for (demand, looks), shortage in zip(demands, shortages, strict=True):
            if shortage and looks == UNFUNDED_POLLS:
                self._subscription.forget(demand)
            elif shortage:
                if not looks:
                    self._drops.count("unfunded", demand.signer)
                for dropped, _ in self._unfunded.put(demand.signer, (demand, looks + 1)):
                    self._subscription.forget(dropped, after=self._pause)
            else:
                self._pass_on(demand)
        self._changed.set()

    def _pass_on(self, demand: Verified[Demand]) -> None:
        """Let a demand wait for the handlers, by the magnitude of its pay, and of two alike a customer's first."""
        worth = self._chain.funds.worth(demand.message, token=self._token)
        priority = 2 * worth + (demand.signer in self._trader.customers)
        for dropped in self._funded.put(demand.signer, demand, priority=priority):
            self._drop(dropped, "queue-full")
            self._declines.decline(dropped, BUSY)

    async def _handle(self, tasks: asyncio.TaskGroup) -> None:
        while True:
            self._changed.clear()
            while self._has_place():
                demand = self._funded.get_nowait()
                pays = self._chain.funds.worth(demand.message, token=self._token) > 0
                if not pays and not self._free_rate.allow(demand.signer):
                    self._drop(demand, "free-rate")
                    self._declines.decline(demand, BUSY)
                    continue
                self._running += 1
                self._running_free += not pays
                tasks.create_task(self._handle_one(demand, pays=pays), name="handler")
            await self._changed.wait()

    def _has_place(self) -> bool:
        top = self._funded.top
        if top is None or self._running >= DEMAND_LIMITS.handled:
            return False
        return top > 1 or self._running_free < DEMAND_LIMITS.free_handled

    def _ask_again(self, demand: Verified[Demand]) -> None:
        """Let the handlers decide again on a demand."""
        self._pass_on(demand)
        self._changed.set()

    async def _handle_one(self, demand: Verified[Demand], *, pays: bool) -> None:
        try:
            for earlier in self._trader.answered.declined_like(demand.message):
                if earlier.demand.hash != demand.hash and not await self._decide(earlier.demand, pays=pays):
                    break  # still declined: no offer can be made that does not match it, too
            await self._decide(demand, pays=pays)
        finally:
            self._running -= 1
            self._running_free -= not pays
            self._changed.set()

    async def _decide(self, demand: Verified[Demand], *, pays: bool) -> bool:
        """Call the handlers with a demand, unless the settings exclude it; False if it is declined."""
        HANDLED_FOR.set(Buyer(demand.signer, pays))
        answered, grounds = self._trader.answered.note(demand), []
        answered.is_declined = False
        message = demand.message
        refused = await self._rules.refusal(demand.signer, cost=message.cost, token=message.token)
        errors: list[AiraError | None] = []
        if refused is not None:
            grounds.append(Grounds(refused.reason, refused.detail))
        elif (excluded := await self._objectives.refusal(message.objective, Buyer(demand.signer, pays))) is not None:
            errors.append(excluded)
        else:
            errors += [await call(handler, demand, logged=self._is_logged) for handler in self._handlers]
        for error in errors:
            if isinstance(error, ObjectiveNotFetched):
                self._drop(demand, f"objective-{error.reason}")
            elif isinstance(error, ContentUnavailable):
                self._drop(demand, "objective-missing")
            elif isinstance(error, Declined) and error.reason == EQUAL_DECLINED:
                self._drop(demand, error.reason, after=self._pause)
            elif error is not None and _may_pass(error):
                self._drop(demand, error.code)
            if error is not None and (reason := grounds_of(error)) is not None:
                grounds.append(reason)
        if grounds and not answered.is_answered:
            self._declines.decline(demand, grounds[0])
            if grounds[0].code in FOR_NOW:
                self._drop(demand, grounds[0].code, after=self._pause)
            elif not answered.is_over and grounds[0].code not in (BUSY.code, EQUAL_DECLINED):
                await self._trader.decline(answered)
        if not answered.is_answered:
            self._trader.answered.forget(answered)
        return not answered.is_declined

    def _is_logged(self, error: AiraError) -> bool:
        return not is_expected(error) and self._logged.allow(error.code)

    def _drop(self, demand: Verified[Demand], reason: str, *, after: float = 0.0) -> None:
        """Count a demand that is not handled now, and let its next copy through, `after` seconds."""
        self._drops.count(reason, demand.signer)
        self._subscription.forget(demand, after=after)


def _may_pass(error: AiraError) -> bool:
    """Whether a handler that ended with this error may succeed later: the node failed, a disk or a limit is full."""
    from mesh.chain import TransactionTimeout
    from mesh.chain.following import NODE_ERRORS

    return isinstance(error, (*NODE_ERRORS, TransactionTimeout, LedgerUnusable, TooManyOffers))


class Acceptance:
    """The service `accept` of a robot: its `handlers` decide on a demand that is for it alone and that `rules` allow.

    What they offer is not published, and is the reply. A demand that was answered before gets the same offer.
    """

    def __init__(
        self,
        parts: AgentComponents,
        trader: Trader,
        rules: OwnerRules,
        objectives: Objectives,
        handlers: Sequence[Handler],
        *,
        model: str,
    ) -> None:
        self._parts = parts
        self._trader = trader
        self._rules = rules
        self._objectives = objectives
        self._handlers = handlers
        self._model = model
        self._limiter = RateLimiter(per_sender=PER_MAKER, total=DECLINES)
        self._logged = RateLimiter(per_sender=LOGGED)
        self._places = asyncio.Semaphore(DEMAND_LIMITS.free_handled)

    async def accept(self, request: AcceptDemand) -> Accepted:
        """The reply. Raises `InvalidMessage` for a request that is not for this robot, or not signed by its maker."""
        demand = await self._checked(request)
        grounds = await self._grounds(demand)
        if isinstance(grounds, Offer):
            return Accepted(offer=SendOffer.of(grounds))
        return Accepted(decline=signed_decline(demand, grounds, self._parts.signer))

    def _is_logged(self, error: AiraError) -> bool:
        return not is_expected(error) and self._logged.allow(error.code)

    async def _checked(self, request: AcceptDemand) -> Verified[Demand]:
        message: Demand = request.demand.message()
        if not request.is_signed or request.robot != self._parts.signer.address:
            raise InvalidMessage("signature", "its maker has not signed it for this robot")
        if message.sender not in (None, request.maker):
            raise InvalidMessage("sender", f"the order names {message.sender} as its sender")
        if message.lighthouse != self._parts.channel.address:
            raise InvalidMessage("lighthouse", f"made for {message.lighthouse}, not for this market")
        if message.deadline <= self._parts.chain_head.contract_block:
            raise InvalidMessage("deadline", f"block {message.deadline} has passed")
        await self._parts.chain.validators.check(message)
        return Verified(replace(message, signature=""), message_hash(message), request.maker)

    async def _grounds(self, demand: Verified[Demand]) -> Offer | Grounds:
        """The offer, or why there is none."""
        if is_cid(self._model) and demand.message.model != self._model:
            return Grounds("other-model", f"it works for the model {self._model}")
        answered = self._trader.answered.note(demand)
        if answered.offer is None or not answered.offer.is_open:
            if not self._limiter.allow(demand.signer):
                return BUSY
            try:  # before what it would say to another job: it may have this one already
                await self._trader.require_open(answered)
            except AiraError as error:
                if error.code != DEMAND_TAKEN:
                    raise
                return Grounds(DEMAND_TAKEN, "it is a contract already, or was withdrawn")
            terms = demand.message
            refused = await self._rules.refusal(demand.signer, cost=terms.cost, token=terms.token)
            if refused is not None:
                self._trader.answered.forget(answered)
                return Grounds(refused.reason, refused.detail)
            ask = partial(self._parts.chain.tokens.balance, demand.signer, token=demand.message.token)
            if await self._parts.chain.retrying(ask, outages=self._parts.outages) < demand.message.cost:
                return Grounds("unfunded", "its maker lacks the money")
            async with self._places:
                ALONE.set(answered)
                HANDLED_FOR.set(buyer := Buyer(demand.signer, pays=demand.message.cost > 0))
                if (excluded := await self._objectives.refusal(terms.objective, buyer)) is not None:
                    errors: list[AiraError | None] = [excluded]
                else:
                    errors = [await call(handler, demand, logged=self._is_logged) for handler in self._handlers]
            if answered.offer is None or not answered.offer.is_open:
                self._trader.answered.forget(answered)
                found = [grounds for error in errors if error is not None and (grounds := grounds_of(error))]
                failed = any(errors)
                return (found or [Grounds("failed" if failed else "no-offer", "its handlers made no offer")])[0]
        offer = answered.offer.signed
        assert isinstance(offer, Offer)
        return offer


PER_ASKER: Final = Rate(per_second=1.0, burst=32)
"""Quotes for one asker …"""
QUOTES: Final = Rate(per_second=10.0, burst=200)
"""… and for all."""


class Quoting:
    """The service `quote` of a robot: a quote binds nobody. What its owner's `rules` exclude is declined."""

    def __init__(
        self,
        parts: AgentComponents,
        profile: OwnProfile,
        rules: OwnerRules,
        objectives: Objectives,
        handlers: Sequence[QuoteHandler],
        description: ModelDescription | None,
        *,
        model: str,
    ) -> None:
        self._parts = parts
        self._profile = profile
        self._rules = rules
        self._objectives = objectives
        self._handlers = handlers
        self._seconds = float((None if description is None else description.seconds) or 0)
        self._model = model
        self._limiter = RateLimiter(per_sender=PER_ASKER, total=QUOTES)

    async def quote(self, request: QuoteRequest) -> Quote:
        """The signed reply. Raises `InvalidMessage` for a request that is not signed, or for another market."""
        if not request.is_signed:
            raise InvalidMessage("signature", "the request is not signed by its asker")
        if request.lighthouse != self._parts.channel.lighthouse:
            raise InvalidMessage("lighthouse", f"made for {request.lighthouse}, not for this market")
        agent, identity = self._parts.signer.address, request.identity
        try:
            quote = await self._quote(request)
        except AiraError as error:
            grounds = grounds_of(error)
            code, detail = ("failed", "its handler failed") if grounds is None else grounds
            if grounds is None:
                log.warning("no quote: %s", error, extra=log_event("quote-failed", code=error.code))
            detail = public_text(detail, longest=LONGEST_DETAIL)
            quote = Quote(agent=agent, request=identity, code=code, detail=detail)
        return quote.signed_by(self._parts.signer)

    async def _quote(self, request: QuoteRequest) -> Quote:
        parts = self._parts
        if not self._limiter.allow(request.asker):
            raise Declined("busy", "too many ask")
        if (closed := self._rules.closed()) is not None:
            raise closed
        if is_cid(self._model) and request.model != self._model:
            raise Declined("other-model", f"it works for the model {self._model}")
        price: int | str | None = self._rules.price or None
        HANDLED_FOR.set(buyer := Buyer(request.asker, pays=False))
        if (excluded := await self._objectives.refusal(request.objective, buyer)) is not None:
            raise excluded
        for handler in self._handlers:
            price = await call_handler(handler, request)
        if price is None:
            raise Declined("no-price", "it names no price; its answer to a demand says whether that is enough")
        amounts = partial(parts.chain.tokens.amounts, price, default=parts.settings.erc20_token)
        paid_in, _, (cost,) = await parts.chain.retrying(amounts, outages=parts.outages)
        if (refused := await self._rules.refusal(request.asker, cost=cost, token=paid_in)) is not None:
            raise refused
        _, wait = await self._profile.queue()
        return Quote(
            agent=parts.signer.address,
            request=request.identity,
            cost=cost,
            token=paid_in,
            start=float(wait),
            seconds=self._seconds,
            until=parts.chain_head.contract_block + ORDER_LIFETIME.fewest,
        )
