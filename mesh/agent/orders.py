"""Orders of an account: what users see of them, and providers' rejections of them."""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

from mesh.background import Background
from mesh.log_context import log_event
from mesh.market.book import Refusal
from mesh.network import call_in_loop
from schemas import InvalidRecord, market_selector, message_hash
from schemas.signing import Rejection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator

    import zenoh

    from mesh.agent.components import AgentComponents
    from mesh.agent.contract import Contract
    from schemas import Demand, Offer

    OnRejection = Callable[[Rejection], object]

log = logging.getLogger(__name__)

QUEUED: Final = 64
"""Most signed rejections that wait to be checked; more are dropped, since anybody can sign one."""
REJECTIONS_KEPT: Final = 64
"""Most providers whose rejection of an order is remembered."""


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
    """What those wait for who asked for its contract."""
    rejections: dict[str, Rejection] = field(default_factory=dict)
    """The last rejection by each provider."""
    on_rejection: list[OnRejection] = field(default_factory=list)

    @property
    def identity(self) -> str:
        """The order's hash, hexadecimal."""
        return message_hash(self.signed).hex()

    @property
    def is_open(self) -> bool:
        """Whether it is sent until it becomes a contract, or expires."""
        return self.state is OrderState.OPEN

    @property
    def nonce(self) -> int | None:
        """In generation 5, which counts an account's orders."""
        return int(self.signed.nonce) if self.signed.generation == 5 else None

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
        if before is not None or len(self.rejections) < REJECTIONS_KEPT:
            self.rejections[rejection.provider] = rejection
        for report in self.on_rejection:
            report(rejection)
        return True

    @contextmanager
    def reporting(self, on_rejection: OnRejection | None) -> Iterator[None]:
        """Meanwhile report rejections, those of before first."""
        if on_rejection is None:
            yield
            return
        for rejection in self.rejections.values():
            on_rejection(rejection)
        self.on_rejection.append(on_rejection)
        try:
            yield
        finally:
            self.on_rejection.remove(on_rejection)


class OrderActions(Protocol):
    """What can be done with orders; the trader does it."""

    async def withdraw(self, order: TradedOrder) -> Order:
        """See `Order.withdraw`."""
        ...

    async def withdraw_on_chain(self, order: TradedOrder) -> Order:
        """See `Order.withdraw_on_chain`."""
        ...

    async def contract_of(self, order: TradedOrder, on_rejection: OnRejection | None) -> Contract:
        """See `Order.contract`."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """An order of the agent's account, as it was when it was asked for: `agent.orders()`, `agent.order(…)`."""

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

        A signed withdrawal is sent until the order's deadline, and the order no more. It may still become a contract:
        by a provider that is creating it now, that the withdrawal does not reach, or that does not obey. Until the
        deadline the allowance covers the order. Raises `OrderClosed` if it has become a contract.
        """
        return await self._actions.withdraw(self._traded)

    async def withdraw_on_chain(self) -> Order:
        """Withdraw the order by a transaction too, after which no provider can create its contract.

        In generation 5 the transaction uses up the order's nonce. Raises `OrderClosed` if the order has become a
        contract, `NotOffered` if the contracts are the originals, and the errors of sending a transaction.
        """
        return await self._actions.withdraw_on_chain(self._traded)

    async def contract(self, *, on_rejection: OnRejection | None = None) -> Contract:
        """Wait until the order is a contract. Cancelling the wait changes nothing.

        `on_rejection` is called with each provider's signed statement that it can't use the order, those of before
        included. The order stays valid, so another provider, or the same one later, may use it. Raises `OrderClosed` if
        the order was withdrawn, `OrderExpired` at its deadline, `ClosedError` if the agent ends first.
        """
        return await self._actions.contract_of(self._traded, on_rejection)


class Rejections:
    """Rejections of one's own orders. Anybody can publish one; only those that a provider signed count."""

    def __init__(self, parts: AgentComponents, is_open: Callable[[str], bool]) -> None:
        self._parts = parts
        self._is_open = is_open

    @asynccontextmanager
    async def received(self, on_rejection: Callable[[Rejection], Awaitable[None]]) -> AsyncIterator[None]:
        """Meanwhile call `on_rejection` with each rejection of an open order that a provider of the lighthouse signed.

        It is called again if it raises that the node is away.
        """
        loop = asyncio.get_running_loop()
        queue: asyncio.Queue[Rejection] = asyncio.Queue(QUEUED)

        def receive(sample: zenoh.Sample) -> None:
            rejection = self._signed(sample.payload.to_bytes())
            if rejection is not None:
                call_in_loop(loop, _put, queue, rejection)

        session = self._parts.network.session
        selector = market_selector(self._parts.channel.lighthouse, "reject", self._parts.signer.address)
        subscriber: Any = session.declare_subscriber(selector, receive)
        try:
            async with Background() as tasks:
                tasks.start(self._check_all(queue, on_rejection), "rejections")
                yield
        finally:
            if not session.is_closed():
                subscriber.undeclare()

    async def _check_all(self, queue: asyncio.Queue[Rejection], on_rejection: Callable[..., Awaitable[None]]) -> None:
        while True:
            check = partial(self._check, await queue.get(), on_rejection)
            await self._parts.chain.retrying(check, outages=self._parts.outages)

    async def _check(self, rejection: Rejection, on_rejection: Callable[..., Awaitable[None]]) -> None:
        lighthouse = await self._parts.chain.lighthouses.get(self._parts.settings.lighthouse_contract)
        if rejection.provider in lighthouse.stakes:
            await on_rejection(rejection)
        else:
            facts = log_event("rejection-ignored", signer=rejection.provider, reason=rejection.reason)
            log.warning("%s is no provider, but rejects: %s", rejection.provider, rejection.reason, extra=facts)

    def _signed(self, payload: bytes) -> Rejection | None:
        """A rejection of an open order, if it is signed. Others' cost no more than reading them."""
        try:
            rejection = Rejection.decode(payload)
        except InvalidRecord as error:
            log.debug("an unreadable rejection: %s", error)
            return None
        return rejection if self._is_open(rejection.order) and rejection.is_signed else None


def _put(queue: asyncio.Queue[Rejection], rejection: Rejection) -> None:
    if not queue.full():
        queue.put_nowait(rejection)
