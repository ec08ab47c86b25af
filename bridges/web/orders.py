"""Orders that people post through the page: checked as a provider would, and published until they have an effect."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from bridges.web.errors import NoLocalAccount, OrderUnusable, PageNotFound, TooManyRequests
from bridges.web.validators import require_judged
from mesh.agent import OrderState
from mesh.background import Background
from mesh.cli.errors import NotRefundable
from mesh.cli.liability import refund_words
from mesh.retry import Backoff
from mesh.role import Lifecycle
from mesh.work.outbox import RESEND
from schemas import Demand, Offer, Verified, Withdrawal, verify, verify_message

if TYPE_CHECKING:
    from contextlib import AsyncExitStack

    from bridges.web.components import WebComponents
    from bridges.web.market import Market, SeenOrder
    from schemas import SignedMessage

PER_SIGNER: Final = 64
"""Orders and withdrawals of one signer that are published at a time."""
IN_TOTAL: Final = 4096
TICK: Final = 0.25
"""Seconds between two looks at what has to be sent again."""


class Sent(msgspec.Struct):
    """A message that is published again and again."""

    message: Any
    signer: str
    backoff: Backoff
    next_at: float


class OrderPublisher(Lifecycle):
    """Posts orders: `async with OrderPublisher(components, market) as publisher`.

    A message is sent again with the backoff of agents until its order is a contract, withdrawn or expired, a withdrawal
    until its deadline. Nothing is kept on disk: after a restart the page posts its orders again.
    """

    title = "publisher of orders"

    def __init__(self, components: WebComponents, market: Market) -> None:
        self._parts = components
        self._market = market
        self._sent: dict[str, Sent] = {}

    async def _open(self, stack: AsyncExitStack) -> None:
        tasks = await stack.enter_async_context(Background())
        tasks.start(self._send_again(), "page: orders")

    async def post(self, payload: bytes) -> SeenOrder:
        """Check a signed message and publish it; returns the order that it is or withdraws.

        Raises `InvalidMessage`, `OrderUnusable`, `UnsafeValidator`, `TooManyRequests`, `ChainError`.
        """
        verified: Verified[Any] = await asyncio.to_thread(verify, payload)
        message, key = verified.message, verified.hash.hex() + verified.signer
        if key not in self._sent:
            self._check_room(verified.signer)
        match message:
            case Demand() | Offer():
                await self._check(verified)
                order = self._market.add(verified, posted=True)
            case Withdrawal(order=order_hash):
                order = self._withdrawn(order_hash, verified.signer)
            case _:
                raise OrderUnusable("kind", "only demands, offers and withdrawals are posted")
        if key not in self._sent:
            self._sent[key] = Sent(message, verified.signer, Backoff(RESEND), time.monotonic())
            self._send_due()
        self._market.changed(order, order.state(self._market.head))
        return order

    async def order(self, *, objective: str, validator: str, validator_fee: int | None, **terms: Any) -> SeenOrder:
        """The local account orders; its agent publishes.

        Raises `NoLocalAccount`, `DoubtfulValidator`, and as `Agent.order`.
        """
        if self._parts.agent is None:
            raise NoLocalAccount("this server has no account", hint="start it with --keyfile, or connect a wallet")
        fee = await require_judged(self._parts, validator, validator_fee) if validator else 0
        posted = await self._parts.agent.order(objective, validator=validator, validator_fee=fee, **terms)
        verified: Verified[Any] = verify_message(posted.message)
        return self._market.add(verified, posted=True)

    async def withdraw(self, order_hash: str) -> SeenOrder:
        """The local account withdraws its order. Raises `OrderClosed`, `PageNotFound`, `NoLocalAccount`."""
        if self._parts.agent is None:
            raise NoLocalAccount("this server has no account", hint="sign the withdrawal with your wallet")
        for mine in self._parts.agent.orders(OrderState.OPEN, OrderState.WITHDRAWN):
            if mine.hash == order_hash:
                await mine.withdraw()
                return self._withdrawn(order_hash, self._parts.agent.address)
        raise PageNotFound(f"the local account has no open order {order_hash}")

    async def refund(self, address: str) -> None:
        """The local account takes back the cost of its job. Raises `NotRefundable`, `NoLocalAccount`, `ChainError`."""
        if self._parts.agent is None:
            raise NoLocalAccount("this server has no account", hint="send the transaction from your wallet")
        liabilities = self._parts.chain.liabilities
        liability = await liabilities.get(address)
        if liability.promisee != self._parts.agent.address:
            raise NotRefundable(f"the local account did not order {address}")
        state = await liabilities.refund_state(address)
        if not state.is_refundable:
            raise NotRefundable(f"{address} can't be refunded: {refund_words(state)}")
        await liabilities.refund(address)

    def _withdrawn(self, order_hash: str, signer: str) -> SeenOrder:
        order = self._market.order(order_hash)
        if order is None or order.verified.signer != signer:
            raise PageNotFound(f"no open order {order_hash} of {signer} is known here")
        order.withdrawn = True
        self._market.changed(order, "withdrawn")
        return order

    async def _check(self, verified: Verified[Any]) -> None:
        """What a provider checks. Raises `OrderUnusable` with a reason that providers also give."""
        order, parts, head = verified.message, self._parts, self._market.head
        if order.lighthouse != parts.lighthouse:
            raise OrderUnusable("lighthouse", f"the order names {order.lighthouse}, this market is {parts.lighthouse}")
        if order.deadline <= head:
            raise OrderUnusable("expired", f"block {order.deadline} has passed, the chain is at {head}")
        if order.deadline > head + parts.settings.deadline_limit:
            most = parts.settings.deadline_limit
            raise OrderUnusable("deadline", f"the order is valid for more than {most} blocks")
        await parts.chain.validators.check(order)
        liabilities = parts.chain.liabilities
        if await liabilities.is_used(order, order_hash=verified.hash, signer=verified.signer):
            raise OrderUnusable("used", "the order has become a contract, or was withdrawn", hint="sign a new one")
        (shortage,) = await parts.chain.costs.shortages([verified], fresh=True)
        if shortage:
            raise OrderUnusable(shortage, "the account can't pay the order", hint=HINTS.get(shortage, ""))

    def _check_room(self, signer: str) -> None:
        if len(self._sent) >= IN_TOTAL or sum(sent.signer == signer for sent in self._sent.values()) >= PER_SIGNER:
            raise TooManyRequests("too many orders are open here", hint="wait until some have ended, or withdraw them")

    async def _send_again(self) -> None:
        while True:
            await asyncio.sleep(TICK)
            self._send_due()

    def _send_due(self) -> None:
        now = time.monotonic()
        for key, sent in list(self._sent.items()):
            if not self._is_wanted(sent.message, key[:64]):
                del self._sent[key]
            elif sent.next_at <= now and self._parts.network.connected:
                self._parts.channel.publish(sent.message)
                sent.next_at = now + (sent.backoff.next_delay() or 0.0)

    def _is_wanted(self, message: SignedMessage, order_hash: str) -> bool:
        """Whether a message can still have an effect."""
        if isinstance(message, Withdrawal):
            return message.deadline > self._market.head
        order = self._market.order(order_hash)
        return order is not None and order.state(self._market.head) == "open"


HINTS: Final = {
    "ERC20InsufficientAllowance": "approve the factory for the amount",
    "ERC20InsufficientBalance": "send the account the missing tokens, or order for less",
    "TokenUnreadable": "choose another token",
}
"""What to do about a shortage."""
