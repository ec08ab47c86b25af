"""Open orders of an account: the allowance that they need, and providers' rejections of them."""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.background import Background
from mesh.chain import InsufficientTokens, Reverted
from mesh.log_context import log_event
from mesh.network import call_in_loop
from schemas import InvalidRecord, market_selector
from schemas.signing import Rejection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping

    import zenoh

    from mesh.agent.components import AgentComponents
    from mesh.chain import Chain

    OnRejection = Callable[[Rejection], Awaitable[None]]

log = logging.getLogger(__name__)

QUEUED: Final = 64
"""Most signed rejections of an order that wait to be checked; more are dropped, since anybody can sign one."""


class Allowances:
    """The allowance of the factory: what the open orders of `account` may cost, by order and token (smallest unit)."""

    def __init__(self, chain: Chain, account: str) -> None:
        self._chain = chain
        self._account = account
        self._amounts: dict[str, Mapping[str, int]] = {}
        self._approving = asyncio.Lock()

    async def ensure(self, order: str, amounts: Mapping[str, int]) -> None:
        """Make sure that the factory may take `amounts` (by token) for `order` and what the other open orders cost.

        Raises `InsufficientTokens`; the order is then not counted.
        """
        async with self._approving:
            for token, amount in amounts.items():
                if amount:
                    others = sum(open_order.get(token, 0) for open_order in self._amounts.values())
                    await self._ensure(token, amount + others)
            self._amounts[order] = amounts

    def release(self, order: str) -> None:
        """Stop counting an order that is no longer open. Unknown ones are ignored."""
        self._amounts.pop(order, None)

    @property
    def orders(self) -> frozenset[str]:
        """The orders that are counted."""
        return frozenset(self._amounts)

    async def _ensure(self, token: str, needed: int) -> None:
        balance = await self._chain.tokens.balance(self._account, token=token)
        if balance < needed:
            raise InsufficientTokens(self._account, token, balance=balance, needed=needed)
        factory = self._chain.factory
        while await self._chain.tokens.allowance(self._account, factory, token=token) < needed:
            facts = log_event("allowance-approved", token=token, amount=needed)
            log.info("approving an allowance of %d of token %s for the factory", needed, token, extra=facts)
            try:
                await self._chain.tokens.approve(factory, needed, token=token)
            except Reverted as error:
                if error.reason != "OutOfGas":
                    raise
                # An order became a contract between estimate and block: setting a used-up allowance costs more gas.
                facts = log_event("allowance-retried", token=token, amount=needed)
                log.info("approving the allowance again: %s", error, extra=facts)


class Rejections:
    """Rejections on the agent's market. Anybody can publish one; only those that a provider signed count."""

    def __init__(self, parts: AgentComponents) -> None:
        self._parts = parts
        self._session = parts.network.session
        self._chain = parts.chain

    @asynccontextmanager
    async def received(self, order: str, on_rejection: OnRejection) -> AsyncIterator[None]:
        """Meanwhile call `on_rejection` with each rejection of the order (hash, hexadecimal) that a provider signed.

        It is called again if it raises that the node is away.
        """
        loop = asyncio.get_running_loop()
        queue: asyncio.Queue[Rejection] = asyncio.Queue(QUEUED)

        def receive(sample: zenoh.Sample) -> None:
            rejection = _signed_rejection(sample.payload.to_bytes())
            if rejection is not None and rejection.order == order:
                call_in_loop(loop, _put, queue, rejection)

        selector = market_selector(self._parts.channel.lighthouse, "reject", order)
        subscriber: Any = self._session.declare_subscriber(selector, receive)
        try:
            async with Background() as tasks:
                tasks.start(self._check_all(queue, on_rejection), f"rejections of {order}")
                yield
        finally:
            if not self._session.is_closed():
                subscriber.undeclare()

    async def _check_all(self, queue: asyncio.Queue[Rejection], on_rejection: OnRejection) -> None:
        while True:
            check = partial(self._check, await queue.get(), on_rejection)
            await self._chain.retrying(check, outages=self._parts.outages)

    async def _check(self, rejection: Rejection, on_rejection: OnRejection) -> None:
        lighthouse = await self._chain.lighthouses.get(self._parts.settings.lighthouse_contract)
        if rejection.provider in lighthouse.stakes:
            await on_rejection(rejection)
        else:
            facts = log_event("rejection-ignored", signer=rejection.provider, reason=rejection.reason)
            log.warning("%s is no provider, but rejects: %s", rejection.provider, rejection.reason, extra=facts)


def _signed_rejection(payload: bytes) -> Rejection | None:
    try:
        rejection = Rejection.decode(payload)
    except InvalidRecord as error:
        log.debug("an unreadable rejection: %s", error)
        return None
    return rejection if rejection.is_signed else None


def _put(queue: asyncio.Queue[Rejection], rejection: Rejection) -> None:
    if not queue.full():
        queue.put_nowait(rejection)
