"""Orders: what users see of them, their terms, and the demands and offers that an agent must keep together.

    open ──► matched                it became a contract; open again if a reorganisation reverts that
      ├────► withdrawn              by its maker; until its deadline it may become a contract all the same
      └────► expired                the chain has reached its deadline

An order of generation 5 is signed again when another order has used its nonce. Its versions differ in their nonce only;
a reorganisation may free the nonce of an earlier one, which then may become the contract that its maker waits for.

An offer names no demand: it matches whatever demand has equal terms. So an agent must take an offer back when nothing
that it has agreed to is left for it: when the demand has become a contract with another offer or was withdrawn, and
when the agent has declined a demand with equal terms. What strangers make an agent offer costs it and the market
messages until the deadline, so the open offers are bounded for each maker and in total.
"""

from __future__ import annotations

import asyncio
import secrets
from collections import Counter, OrderedDict
from contextvars import ContextVar
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from msgspec.structs import replace

from mesh.agent.contracts import Contract, Progress, fail_future, report, stated
from mesh.agent.handlers import Declined
from mesh.base.flood import BoundedDict
from mesh.errors import AiraError, InputError
from mesh.settings.chains import ORDER_SECONDS
from schemas import ZERO_ADDRESS, Demand, Offer, Withdrawal, message_hash
from schemas.messages import equal_terms, lasting_hash
from schemas.signing import Refusal

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping

    from mesh.agent.components import AgentComponents
    from mesh.agent.contracts import JobAttempts, OnProgress
    from mesh.agent.objectives import Buyer
    from mesh.chain import Chain
    from schemas import Liability, Verified
    from schemas.signing import Decline, Rejection

    Terms = Mapping[str, Any]


STATEMENTS_KEPT: Final = 64
"""Most providers whose rejection of an order is remembered, and most agents whose decline is."""


class OrderState(StrEnum):
    """What has become of an order."""

    OPEN = "open"
    """It is sent until it becomes a contract, or expires."""
    MATCHED = "matched"
    """It became a contract."""
    WITHDRAWN = "withdrawn"
    """Its maker withdrew it. Until its deadline it may become a contract all the same."""
    EXPIRED = "expired"
    """The chain has reached its deadline."""


def withdrawal_of(order: Demand | Offer) -> Withdrawal:
    """The withdrawal of an order, to be signed by its maker."""
    return Withdrawal(order=message_hash(order).hex(), lighthouse=order.lighthouse, deadline=order.deadline)


class OrderClosed(AiraError, code="order-closed"):
    """The order is not open any more: `state` is `withdrawn`, or `matched`, with the contract's address `liability`."""

    def __init__(self, order: str, state: str, *, liability: str = "") -> None:
        became = f"became the contract {liability}" if liability else f"was {state}"
        super().__init__(
            f"the order {order[:16]}… {became}",
            hint="" if liability else "it may still become a contract until its deadline; see `aira order list`",
        )
        self.order = order
        self.state = state
        self.liability = liability


class OrderExpired(AiraError, code="order-expired"):
    """No offer matched the order before its deadline, the block `deadline`. `order` is its hash."""

    def __init__(self, order: str, deadline: int) -> None:
        super().__init__(
            f"no counterpart matched the order {order[:16]}… before block {deadline}",
            hint="offer more, or give the order a longer lifetime",
        )
        self.order = order
        self.deadline = deadline


class OtherRobot(AiraError, code="other-robot"):
    """A demand for `robot` (address) alone became the contract `liability` with another one, `promisor`.

    A provider has broken its word, or somebody read the pair on its way to it.
    """

    def __init__(self, order: str, *, robot: str, promisor: str, liability: str) -> None:
        super().__init__(
            f"the order {order[:16]}… for {robot} became the contract {liability} with {promisor}",
            hint="who sent its transaction is the provider that broke its word; `aira liability show` has more",
        )
        self.order = order
        self.robot = robot
        self.promisor = promisor
        self.liability = liability


@dataclass(eq=False)
class TradedOrder:
    """An order as its trader follows it."""

    signed: Demand | Offer
    posted: float
    state: OrderState = OrderState.OPEN
    liability: str = ""
    created: asyncio.Future[Contract] | None = None
    """Resolves to its contract; None while nobody waits for it."""
    rejections: dict[str, Rejection] = field(default_factory=dict)
    """The last rejection by each provider."""
    declines: dict[str, Decline] = field(default_factory=dict)
    """The last decline by each agent."""
    on_progress: list[OnProgress] = field(default_factory=list)
    robot: str = ""
    """The only robot (address) that it is for: it is not published then. Empty for any."""
    attempts: JobAttempts | None = None
    """What happens when its contract fails, if anything does."""
    is_ours: bool = False
    """Whether this agent has posted it, in this run: not an earlier one, nor another program of the account."""
    is_called_off: bool = False
    """Whether nobody wants its contract any more: if one is made although the order was withdrawn, it is stopped."""

    def __str__(self) -> str:
        return f"{self.signed.kind} {self.identity}"

    @property
    def identity(self) -> str:
        """The order's hash, hexadecimal."""
        return message_hash(self.signed).hex()

    @property
    def deadline(self) -> int:
        """The block before which it can become a contract."""
        return self.signed.deadline

    @property
    def is_open(self) -> bool:
        """Whether it is sent until it becomes a contract, or expires."""
        return self.state is OrderState.OPEN

    @property
    def nonce(self) -> int | None:
        """In generation 5, which counts an account's orders."""
        return int(self.signed.nonce) if self.signed.generation == 5 else None

    def is_overtaken(self, used: int | None) -> bool:
        """Whether an order of the account has used the nonce `used`, and so its nonce."""
        return used is not None and self.nonce is not None and self.nonce <= used

    @property
    def honoured_by(self) -> frozenset[str]:
        """The providers (addresses) that have signed that they honour its withdrawal."""
        return frozenset(who for who, said in self.rejections.items() if said.reason == Refusal.WITHDRAWN)

    @property
    def why_closed(self) -> OrderClosed | OrderExpired:
        """The error of those who wait for the contract of an order that is not open."""
        if self.state is OrderState.EXPIRED:
            return OrderExpired(self.identity, self.deadline)
        return OrderClosed(self.identity, self.state, liability=self.liability)

    def close(self, state: OrderState) -> None:
        """It won't become a contract, as far as is known: those who wait for that get an error."""
        self.state = state
        fail_future(self.created, self.why_closed)

    def reject(self, rejection: Rejection) -> bool:
        """Remember a rejection and report it to those who wait. False if the provider said the same before."""
        before = self.rejections.get(rejection.provider)
        if before is not None and before.reason == rejection.reason:
            return False
        if before is not None or len(self.rejections) < STATEMENTS_KEPT:
            self.rejections[rejection.provider] = rejection
        self._report(stated(rejection))
        return True

    def decline(self, decline: Decline) -> bool:
        """Remember a decline and report it. False if the agent said the same before, or too many others declined."""
        before = self.declines.get(decline.agent)
        if before is None and len(self.declines) == STATEMENTS_KEPT:
            return False
        if before is not None and (before.code, before.detail) == (decline.code, decline.detail):
            return False
        self.declines[decline.agent] = decline
        self._report(stated(decline))
        return True

    async def all_declined(self, robots: Callable[[], Awaitable[Collection[str]]]) -> list[Decline]:
        """Wait until all robots (addresses) that are there have declined it for good; returns what they said.

        `robots` is called after each decline.
        """
        heard = asyncio.Event()
        listener: OnProgress = lambda _progress: heard.set()  # noqa: E731
        self.on_progress.append(listener)
        try:
            while True:
                said = {agent: one for agent, one in self.declines.items() if one.code not in TRIED_AGAIN}
                if said and said.keys() >= set(present := await robots()) and present:
                    return [said[robot] for robot in present]
                await heard.wait()
                heard.clear()
        finally:
            self.on_progress.remove(listener)

    def expect_contract(self) -> asyncio.Future[Contract]:
        """Somebody waits for its contract, from now on."""
        if self.created is None:
            self.created = asyncio.get_running_loop().create_future()
        return self.created

    async def contract(self, on_progress: OnProgress) -> Contract:
        """Wait until it is a contract, and report rejections and declines meanwhile, those of before first."""
        created = self.expect_contract()
        for said in (*map(stated, self.rejections.values()), *map(stated, self.declines.values())):
            report(on_progress, said)
        self.on_progress.append(on_progress)
        try:
            return await asyncio.shield(created)
        finally:
            self.on_progress.remove(on_progress)

    def _report(self, progress: Progress) -> None:
        for on_progress in self.on_progress:
            report(on_progress, progress)


TRIED_AGAIN: Final = frozenset({"busy", "objective-unavailable", "equal-declined"})
"""The codes of declines after which the robot looks at the demand's next copy again."""


def is_version(order: Demand, digest: str, *, near: int = 16) -> bool:
    """Whether an order with the hash `digest` is a version of this one, or the same: their nonces are `near`."""
    if message_hash(order).hex() == digest:
        return True
    nonces = range(max(0, int(order.nonce) - near), int(order.nonce) + near + 1) if order.generation == 5 else ()
    return any(message_hash(replace(order, nonce=nonce)).hex() == digest for nonce in nonces)


def is_alike(order: Demand | Offer, liability: Liability) -> bool:
    """Whether a liability can be made from an order, by the terms that cost nothing to compare."""
    return (order.objective, order.cost) == (liability.objective, liability.cost)


def earlier_version(orders: Iterable[TradedOrder], liability: Liability, digest: str) -> TradedOrder | None:
    """The demand among `orders` that had the hash `digest` before it was signed again, of a liability's demand."""
    for order in orders:
        signed = order.signed
        if isinstance(signed, Demand) and is_alike(signed, liability) and is_version(signed, digest):
            return order
    return None


REPEATED: Final = ("model", "objective", "token", "cost", "lighthouse", "validator", "sender")
"""The fields that are the same when an order is posted again; its nonce and perhaps its deadline are new."""


class OrderLifetime(NamedTuple):
    """For how long an order is valid by default."""

    seconds: float = ORDER_SECONDS
    """Of the time that the chain's blocks are expected to take."""
    fewest: int = 50
    """Blocks that it is at least, whatever block time was measured …"""
    most: int = 20_000
    """… and at most."""
    measured: int = 100
    """The latest blocks, whose times give the block time."""


ORDER_LIFETIME: Final = OrderLifetime()


class TermsWriter:
    """Fills in and signs the orders of one account, in the generation of its settings. `known` has its others."""

    def __init__(self, parts: AgentComponents, known: Mapping[str, TradedOrder]) -> None:
        self._settings, self._signer, self._known = parts.settings, parts.signer, known
        self._signed: BoundedDict[str, None] = BoundedDict(256)
        """The lasting hashes of the latest orders of generation 5."""
        self._chain, self._chain_head = parts.chain, parts.chain_head

    async def terms(
        self, *, model: str, objective: str, cost: int | str, token: str, validator: str, lifetime: int | None
    ) -> Terms:
        """The fields that a demand and an offer share, with names resolved, valid for `lifetime` blocks.

        By default they are valid for about `ORDER_LIFETIME.seconds`. Raises `InputError`, `ChainError`.
        """
        settings, names = self._settings, self._chain.names
        if lifetime is not None and not 0 < lifetime <= settings.deadline_limit:
            why = f"an order is valid for 1 to {settings.deadline_limit:,} blocks"
            raise InputError(why, hint="give another lifetime", code="invalid-lifetime")
        paid = await self._chain.tokens.amounts(cost, token=token, default=settings.erc20_token)
        blocks = await lifetime_of(self._chain) if lifetime is None else lifetime
        return {
            "model": await names.model(model),
            "objective": objective,
            "token": paid.token,
            "cost": paid.values[0],
            "lighthouse": await names.address(settings.lighthouse_contract),
            "validator": await names.address(validator) if validator else ZERO_ADDRESS,
            "deadline": await deadline_in(self._chain, blocks),
            "sender": None if settings.generation == 3 else self._signer.address,
        }

    def terms_of(self, order: Demand | Offer) -> Terms:
        """The terms of a stranger's order, for one that answers it; its deadline counts up to `deadline_limit`."""
        latest = self._chain_head.contract_block + self._settings.deadline_limit
        return {**self._repeated(order), "deadline": min(order.deadline, latest)}

    def _repeated(self, order: Demand | Offer) -> Terms:
        sender = None if order.generation == 3 else self._signer.address
        return {field: getattr(order, field) for field in (*REPEATED, "deadline")} | {"sender": sender}

    async def sign(self, kind: type[Demand | Offer], terms: Terms, **fee: Any) -> Demand | Offer:
        """An order with these terms and a fresh nonce, signed. Raises `UnsafeValidator`."""
        order = await self._complete(kind, terms, **fee)
        if order.generation == 5:  # else it would be a version of another order
            known = {lasting_hash(one.signed) for one in self._known.values()} | self._signed.keys()
            while lasting_hash(order) in known:
                order = replace(order, deadline=order.deadline - 1)
            self.remember(order)
        return self._signer.sign(order)

    def remember(self, order: Demand | Offer) -> None:
        """Sign no other order that is a version of this one, which the account has signed, perhaps in an earlier run.

        It may be withdrawn and still have become a contract. If a reorganisation reverts that, its nonce is free again.
        """
        if order.generation == 5:
            self._signed[lasting_hash(order)] = None

    async def sign_again(self, order: Demand | Offer) -> Demand | Offer:
        """An order like this one, with a fresh nonce."""
        terms = self._repeated(order)
        if isinstance(order, Demand):
            return self._signer.sign(await self._complete(Demand, terms, validator_fee=order.validator_fee))
        return self._signer.sign(await self._complete(Offer, terms, lighthouse_fee=order.lighthouse_fee))

    async def _complete(self, kind: type[Demand | Offer], terms: Terms, **fee: Any) -> Demand | Offer:
        is_counted = terms["sender"] is not None
        nonce = await self._chain.liabilities.next_nonce(self._signer.address) if is_counted else secrets.token_hex(32)
        order = kind(**terms, nonce=nonce, **fee)
        await self._chain.validators.check(order)
        return order


def is_repeated(demand: Demand, terms: Terms, *, payable: range) -> bool:
    """Whether a demand is for the same job as these terms, at a cost that is `payable` for it, too."""
    same = {**terms, "cost": demand.cost}
    return demand.cost in payable and all(getattr(demand, field) == same[field] for field in REPEATED)


async def deadline_in(chain: Chain, blocks: int) -> int:
    """The deadline of an order that is valid for that many blocks from now on."""
    return await chain.node.contract_blocks.last((await chain.node.heads.recent()).number) + blocks


async def lifetime_of(chain: Chain, seconds: float = ORDER_LIFETIME.seconds) -> int:
    """How many blocks make about `seconds`, by the time between the latest blocks: for how long an order is valid."""
    block_time = await chain.node.contract_blocks.seconds(ORDER_LIFETIME.measured)
    blocks = seconds if block_time is None else seconds / block_time
    return min(max(round(blocks), ORDER_LIFETIME.fewest), ORDER_LIFETIME.most)


ROBOT_STOPPED: Final = "stopped"
"""The reason of a decline while a stopped robot is held."""


def robot_stopped() -> Declined:
    """The refusal of each job while a stopped robot is held."""
    return Declined(ROBOT_STOPPED, "the robot was stopped, and takes no job before its owner releases it")


EQUAL_DECLINED: Final = "equal-declined"
"""Why a demand is declined whose terms are those of an open demand that the agent has declined."""


HANDLED_FOR: Final[ContextVar[Buyer | None]] = ContextVar("handled for", default=None)
"""Whose demand the running handler handles; None outside of a demand's handler."""


ALONE: Final[ContextVar[AnsweredDemand | None]] = ContextVar("alone", default=None)
"""The demand for this robot alone that the running handler handles; None for one that all robots see."""


class TooManyOffers(AiraError, code="too-many-offers"):
    """An agent has as many open offers as it may have, in all or for the demands of `maker`."""

    def __init__(self, maker: str) -> None:
        super().__init__(f"there are too many open offers for demands, also of {maker}", hint="try again later")
        self.maker = maker


DEMAND_TAKEN: Final = "demand-taken"
"""The code of the error when a demand can't be offered for any more."""


def demand_taken(order: str) -> AiraError:
    """The error for a demand (hash) that has become a contract, or that its maker withdrew.

    In generation 5 also for one whose nonce another order of its maker has used; it is signed again.
    """
    return AiraError(f"the demand {order[:16]}… is a contract already, or was withdrawn", code="demand-taken")


class OpenOffers:
    """The open offers that answer demands, oldest first: at most `per_maker` of one maker, and `total`."""

    def __init__(self, *, per_maker: int = 256, total: int = 2048) -> None:
        self._per_maker = per_maker
        self._total = total
        self._offers: OrderedDict[TradedOrder, tuple[str, bool]] = OrderedDict()
        self._makers: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._offers)

    def add(self, offer: TradedOrder, maker: str, *, pays: bool) -> TradedOrder | None:
        """Count an offer for a demand of `maker`; returns one to give up for it, or None.

        Given up is the newest offer for the maker with the most, or the oldest for a demand that pays nothing. Raises
        `TooManyOffers`.
        """
        given_up = None
        if self._makers[maker] >= self._per_maker:
            raise TooManyOffers(maker)
        if len(self._offers) >= self._total:
            given_up = self._least(maker)
            self.discard(given_up)
        self._offers[offer] = maker, pays
        self._makers[maker] += 1
        return given_up

    def discard(self, offer: TradedOrder) -> None:
        """Stop counting an offer. Unknown ones are ignored."""
        maker, _ = self._offers.pop(offer, (None, False))
        if maker is not None:
            self._makers[maker] -= 1
            if not self._makers[maker]:
                del self._makers[maker]

    def _least(self, maker: str) -> TradedOrder:
        (heaviest, most), *_ = self._makers.most_common(1)
        if most > max(self._makers[maker], 1):
            return next(offer for offer in reversed(self._offers) if self._offers[offer][0] == heaviest)
        for offer, (_, pays) in self._offers.items():
            if not pays:
                return offer
        raise TooManyOffers(maker)


@dataclass(eq=False)
class AnsweredDemand:
    """A demand on which an agent's handlers decide, or have decided."""

    demand: Verified[Demand]
    """Its newest version."""
    offer: TradedOrder | None = None
    """The offer that answers it."""
    is_declined: bool = False
    is_over: bool = False
    """Whether it has become a contract, or was withdrawn."""

    @property
    def is_answered(self) -> bool:
        """Whether it has an open offer, or was declined."""
        return self.is_declined or (self.offer is not None and self.offer.is_open)


class AnsweredDemands:
    """The open demands on which an agent's handlers decide, or have decided; the last 8192 of them."""

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[str, str], AnsweredDemand] = OrderedDict()
        """By maker, and by what the versions of a demand share."""
        self._makers: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._known)

    def __contains__(self, maker: str) -> bool:
        """Whether a demand of this account is known."""
        return maker in self._makers

    def note(self, demand: Verified[Demand]) -> AnsweredDemand:
        """The demand, which is known from now on."""
        key = demand.signer, lasting_hash(demand.message)
        known = self._known.get(key)
        if known is None:
            if len(self._known) >= 8192:
                self.forget(next(iter(self._known.values())))
            known = self._known[key] = AnsweredDemand(demand)
            self._makers[demand.signer] += 1
        elif known.demand.hash != demand.hash and int(known.demand.message.nonce) < int(demand.message.nonce):
            known.demand = demand
        return known

    def forget(self, known: AnsweredDemand) -> None:
        """Forget a demand that is not open any more, or was not answered. Unknown ones are ignored."""
        maker = known.demand.signer
        if self._known.pop((maker, lasting_hash(known.demand.message)), None) is not None:
            self._makers[maker] -= 1
            if not self._makers[maker]:
                del self._makers[maker]

    def expire(self, block: int) -> None:
        """The chain has `block`: forget the demands with an earlier deadline."""
        for known in [one for one in self._known.values() if one.demand.message.deadline <= block]:
            self.forget(known)

    def find(self, maker: str, digest: str, liability: Liability | None = None) -> AnsweredDemand | None:
        """The demand of an account of which a version has the hash `digest`, perhaps that of a liability."""
        for known in self._known.values() if maker in self else ():
            demand = known.demand.message
            is_candidate = known.demand.signer == maker and (liability is None or is_alike(demand, liability))
            if is_candidate and is_version(demand, digest):
                return known
        return None

    def offered_by(self, offer: TradedOrder) -> AnsweredDemand | None:
        return next((one for one in self._known.values() if one.offer is offer), None)

    def declined_like(self, order: Demand | Offer) -> list[AnsweredDemand]:
        """The declined demands with the terms of an order, the oldest first."""
        terms = equal_terms(order)
        return [one for one in self._known.values() if one.is_declined and equal_terms(one.demand.message) == terms]
