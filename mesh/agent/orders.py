"""Orders of an account: their terms, and what users see of them."""

from __future__ import annotations

import asyncio
import secrets
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, Protocol

from msgspec.structs import replace

from mesh.agent.contract import fail_future
from mesh.agent.errors import OrderClosed, OrderExpired
from mesh.agent.progress import Progress, nothing, report, stated
from mesh.market.book import Refusal
from schemas import ZERO_ADDRESS, Demand, Offer, message_hash

if TYPE_CHECKING:
    from collections.abc import Container, Mapping

    from mesh.agent.components import AgentComponents
    from mesh.agent.contract import Contract
    from mesh.agent.progress import OnProgress
    from mesh.chain import Chain
    from schemas.signing import Decline, Rejection

    Terms = Mapping[str, Any]

STATEMENTS_KEPT: Final = 64
"""Most providers whose rejection of an order is remembered, and most agents whose decline is."""
REPEATED: Final = ("model", "objective", "token", "cost", "lighthouse", "validator", "sender")
"""The fields that are the same when an order is posted again; its nonce and perhaps its deadline are new."""
LIFETIME: Final = 600.0
"""Seconds for which an order is valid by default."""
FEWEST_BLOCKS, MOST_BLOCKS = 50, 20_000
"""The bounds of the default lifetime, whatever block time was measured."""
MEASURED_BLOCKS: Final = 100
"""The latest blocks, whose times give the block time."""


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
    def why_closed(self) -> OrderClosed | OrderExpired:
        """The error of those who wait for the contract of an order that is not open."""
        if self.state is OrderState.EXPIRED:
            return OrderExpired(self.identity, self.deadline)
        return OrderClosed(self.identity, self.state, liability=self.liability)

    def close(self, state: OrderState) -> None:
        """It won't become a contract, as far as is known: those who wait for that get an error."""
        self.state = state
        fail_future(self.created, self.why_closed)

    def shown(self, actions: OrderActions) -> Order:
        """The order as users see it."""
        return Order(
            message=self.signed,
            hash=self.identity,
            state=self.state,
            posted=self.posted,
            liability=self.liability,
            _traded=self,
            _actions=actions,
        )

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

    async def contract(self, on_progress: OnProgress) -> Contract:
        """Wait until it is a contract, and report rejections and declines meanwhile, those of before first."""
        if self.created is None:
            self.created = asyncio.get_running_loop().create_future()
        for said in (*map(stated, self.rejections.values()), *map(stated, self.declines.values())):
            report(on_progress, said)
        self.on_progress.append(on_progress)
        try:
            return await asyncio.shield(self.created)
        finally:
            self.on_progress.remove(on_progress)

    def _report(self, progress: Progress) -> None:
        for on_progress in self.on_progress:
            report(on_progress, progress)


class OrderActions(Protocol):
    """What can be done with orders; the trader does it."""

    async def withdraw(self, order: TradedOrder) -> Order:
        """See `Order.withdraw`."""

    async def withdraw_on_chain(self, order: TradedOrder) -> Order:
        """See `Order.withdraw_on_chain`."""

    async def contract_of(self, order: TradedOrder, on_progress: OnProgress) -> Contract:
        """See `Order.contract`."""


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
    _actions: OrderActions = field(repr=False, compare=False)

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
    def honoured_by(self) -> frozenset[str]:
        """The providers (addresses) that have signed that they honour its withdrawal, as of now."""
        said = self._traded.rejections.items()
        return frozenset(provider for provider, rejection in said if rejection.reason == Refusal.WITHDRAWN)

    async def withdraw(self) -> Order:
        """Withdraw the order; returns it in its new state. `honoured_by` names the providers that obey.

        A signed withdrawal is sent until the deadline, instead of the order. A provider that is creating its contract,
        or does not know or obey the withdrawal, may still use it, so the allowance covers it until the deadline. Raises
        `OrderClosed` if the order has become a contract.
        """
        return await self._actions.withdraw(self._traded)

    async def withdraw_on_chain(self) -> Order:
        """Withdraw the order by a transaction too, after which no provider can create its contract.

        In generation 5 the transaction uses up the order's nonce. Raises `OrderClosed` if the order has become a
        contract, `NotOffered` if the contracts are the originals, and the errors of sending a transaction.
        """
        return await self._actions.withdraw_on_chain(self._traded)

    async def contract(self, *, on_progress: OnProgress = nothing) -> Contract:
        """Wait until the order is a contract. Cancelling the wait changes nothing.

        `on_progress` is called with offers for a demand, agents' declines, providers' rejections (both also earlier
        ones), and the contract. After a decline or a rejection the order stays valid. Raises `OrderClosed` if the order
        was withdrawn, `OrderExpired` at its deadline, `ClosedError` if the agent ends first.
        """
        return await self._actions.contract_of(self._traded, on_progress)


class TermsWriter:
    """Fills in and signs the orders of one account, in the generation of its settings. `known` are hashes of others."""

    def __init__(self, parts: AgentComponents, known: Container[str]) -> None:
        self._settings, self._signer, self._known = parts.settings, parts.signer, known
        self._chain, self._chain_head = parts.chain, parts.chain_head

    async def terms(
        self, *, model: str, objective: str, cost: int | str, token: str, validator: str, lifetime: int | None
    ) -> Terms:
        """The fields that a demand and an offer share, with names resolved, valid for `lifetime` blocks.

        By default they are valid for about `LIFETIME` seconds. Raises `InvalidAmount`, `NotAToken`.
        """
        settings, names = self._settings, self._chain.names
        if not isinstance(cost, int):
            cost = (await self._chain.tokens.unit(token or settings.erc20_token)).amount(cost)
        blocks = await default_lifetime(self._chain) if lifetime is None else lifetime
        return {
            "model": await names.model(model),
            "objective": objective,
            "token": await names.address(token or settings.erc20_token),
            "cost": cost,
            "lighthouse": await names.address(settings.lighthouse_contract),
            "validator": await names.address(validator) if validator else ZERO_ADDRESS,
            "deadline": (await self._chain.node.heads.recent()).number + blocks,
            "sender": None if settings.generation == 3 else self._signer.address,
        }

    def terms_of(self, order: Demand | Offer) -> Terms:
        """The terms of a stranger's order, for one that answers it; its deadline counts up to `deadline_limit`."""
        latest = self._chain_head.head + self._settings.deadline_limit
        return {**self._repeated(order), "deadline": min(order.deadline, latest)}

    def _repeated(self, order: Demand | Offer) -> Terms:
        sender = None if order.generation == 3 else self._signer.address
        return {field: getattr(order, field) for field in (*REPEATED, "deadline")} | {"sender": sender}

    async def sign(self, kind: type[Demand | Offer], terms: Terms, **fee: Any) -> Demand | Offer:
        """An order with these terms and a fresh nonce, signed, unlike the known ones. Raises `UnsafeValidator`."""
        is_counted = terms["sender"] is not None
        nonce = await self._chain.liabilities.next_nonce(self._signer.address) if is_counted else secrets.token_hex(32)
        order = kind(**terms, nonce=nonce, **fee)
        await self._chain.validators.check(order)
        while message_hash(order).hex() in self._known:  # equal orders have the same nonce until one is a contract
            order = replace(order, deadline=order.deadline - 1)
        return self._signer.sign(order)

    async def sign_again(self, order: Demand | Offer) -> Demand | Offer:
        """An order like this one, with a fresh nonce."""
        if isinstance(order, Demand):
            return await self.sign(Demand, self._repeated(order), validator_fee=order.validator_fee)
        return await self.sign(Offer, self._repeated(order), lighthouse_fee=order.lighthouse_fee)


def is_repeated(demand: Demand, terms: Terms, *, validator_fee: int) -> bool:
    """Whether a demand differs from these terms in nonce and deadline only."""
    return demand.validator_fee == validator_fee and all(getattr(demand, field) == terms[field] for field in REPEATED)


async def default_lifetime(chain: Chain) -> int:
    """How many blocks an order is valid by default: about `LIFETIME`, by the time between the latest blocks."""
    block_time = await chain.node.heads.block_time(MEASURED_BLOCKS)
    return round(LIFETIME) if block_time is None else min(max(round(LIFETIME / block_time), FEWEST_BLOCKS), MOST_BLOCKS)
