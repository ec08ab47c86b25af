"""What others state about an account's own orders: providers' rejections, and agents' declines of its demands.

Anybody can sign either, so only those count that a provider with a stake, or an agent that is present, has signed.
"""

from __future__ import annotations

import logging
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Final

from mesh.agent.received import received
from mesh.flood import Rate, RateLimiter
from mesh.log_context import log_event
from mesh.market.refusals import Refusal
from mesh.network import PresentAgents
from schemas.signing import Decline, Rejection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Container, Mapping

    from mesh.agent.components import AgentComponents
    from mesh.agent.orders import TradedOrder

log = logging.getLogger(__name__)

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

    is_wanted = partial(_is_about, orders)
    async with received(parts, "reject", Rejection, is_wanted, check_until_known) as subscribe:
        subscribe()
        yield


@asynccontextmanager
async def received_declines(
    parts: AgentComponents, orders: Mapping[str, TradedOrder]
) -> AsyncIterator[Callable[[], None]]:
    """Meanwhile report to the waiters of `orders` each decline that an agent signed that is present.

    Yields a function to call when there is a demand: a robot that never demands does not subscribe.
    """
    agents, limiter = PresentAgents(parts.channel, role="agent"), RateLimiter(per_sender=PER_AGENT, total=HEARD)

    async def check(decline: Decline) -> None:
        if not limiter.allow(decline.agent) or not await agents.is_present(decline.agent):
            parts.drops.count("declines", decline.agent)
        elif (order := orders.get(decline.order)) is not None and order.is_open and order.decline(decline):
            facts = log_event("order-declined", order=decline.order, agent=decline.agent, code=decline.code)
            log.info("agent %s declines the %s (%s)", decline.agent, order, decline.code, extra=facts)

    async with received(parts, "decline", Decline, partial(_is_about, orders), check) as subscribe:
        yield subscribe


def _is_about(orders: Container[str], statement: Rejection | Decline) -> bool:
    return statement.order in orders
