"""Providers' rejections of an account's own orders."""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.background import Background, call_in_loop
from mesh.log_context import log_event
from mesh.market.book import Refusal
from schemas import InvalidRecord, market_selector
from schemas.signing import Rejection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Container

    import zenoh

    from mesh.agent.components import AgentComponents

log = logging.getLogger(__name__)

QUEUED: Final = 64
"""Most signed rejections that wait to be checked; more are dropped, since anybody can sign one."""


@asynccontextmanager
async def received_rejections(
    parts: AgentComponents, orders: Container[str], on_rejection: Callable[[Rejection], Awaitable[None]]
) -> AsyncIterator[None]:
    """Meanwhile call `on_rejection` with each rejection of one of `orders` that a provider of the lighthouse signed.

    Anybody can publish one; only those that a provider signed count. A full order book is only logged. It is called
    again if it raises that the node is away.
    """
    queue: asyncio.Queue[Rejection] = asyncio.Queue(QUEUED)

    async def check(rejection: Rejection) -> None:
        lighthouse = await parts.chain.lighthouses.get(parts.settings.lighthouse_contract)
        order, signer, reason = rejection.order, rejection.provider, rejection.reason
        if signer not in lighthouse.stakes:
            facts = log_event("rejection-ignored", signer=signer, reason=reason)
            log.warning("%s is no provider, but rejects: %s", signer, reason, extra=facts)
        elif reason == Refusal.FULL:
            facts = log_event("order-deferred", order=order, provider=signer, reason=reason)
            log.warning("provider %s has no room for the order %s now", signer, order, extra=facts)
        else:
            await on_rejection(rejection)

    async def check_all() -> None:
        while True:
            await parts.chain.retrying(partial(check, await queue.get()), outages=parts.outages)

    subscriber = _subscribe(parts, orders, queue)
    try:
        async with Background() as tasks:
            tasks.start(check_all(), "rejections")
            yield
    finally:
        if not parts.network.session.is_closed():
            subscriber.undeclare()


def _subscribe(parts: AgentComponents, orders: Container[str], queue: asyncio.Queue[Rejection]) -> Any:
    """Put the signed rejections of these orders into the queue, while it has room. Returns the subscriber."""
    loop = asyncio.get_running_loop()

    def put(rejection: Rejection) -> None:
        if not queue.full():
            queue.put_nowait(rejection)

    def receive(sample: zenoh.Sample) -> None:
        try:
            rejection = Rejection.decode(sample.payload.to_bytes())
        except InvalidRecord as error:
            log.debug("an unreadable rejection: %s", error)
            return
        if rejection.order in orders and rejection.is_signed:  # others cost no more than reading them
            call_in_loop(loop, put, rejection)

    selector = market_selector(parts.channel.lighthouse, "reject", parts.signer.address)
    return parts.network.session.declare_subscriber(selector, receive)
