"""Orders of an account: their terms, and what users see of them."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Final, Protocol

from mesh.agent.contract import fail_future
from mesh.agent.errors import OrderClosed, OrderExpired
from mesh.agent.progress import Progress, nothing, report, stated
from mesh.market.refusals import Refusal
from schemas import Demand, Offer, message_hash

if TYPE_CHECKING:
    from mesh.agent.contract import Contract
    from mesh.agent.progress import OnProgress
    from schemas.signing import Decline, Rejection

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
