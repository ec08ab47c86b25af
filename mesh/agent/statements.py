"""What others state about an account's own orders and contracts: rejections, declines, and reports of validators.

Anybody can sign any, so only those count that a provider with a stake, an agent that is present, or a juror of the
contract's validator (`mesh.agent.reports`) has signed.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import ExitStack, asynccontextmanager, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar

from mesh.background import Background, call_in_loop
from mesh.flood import FairQueue, Rate, RateLimiter
from mesh.log_context import log_event
from mesh.market.book import Refusal
from mesh.network import PresentAgents
from schemas import InvalidRecord, market_selector
from schemas.signing import Decline, Rejection, SignedRecord

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Container, Iterator, Mapping

    import zenoh

    from mesh.agent.components import AgentComponents
    from mesh.agent.orders import TradedOrder

log = logging.getLogger(__name__)

QUEUED: Final = 64
"""Most signed rejections, declines or reports that wait to be checked; more are dropped, as anybody can sign one."""
QUEUED_OF_ONE: Final = 16
"""Of these, those of one signer."""
PER_AGENT: Final = Rate(per_second=1.0, burst=32)
"""Declines by one agent that are looked at: it may decline many demands."""
DROPPED: Final = {"reject": "rejections", "decline": "declines", "report": "reports"}
"""How records that were dropped are counted."""
HEARD: Final = Rate(per_second=20.0, burst=200)
"""Declines in all that are looked at."""

S = TypeVar("S", bound=SignedRecord)


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


@asynccontextmanager
async def received(
    parts: AgentComponents,
    kind: Literal["reject", "decline", "report"],
    record: type[S],
    is_wanted: Callable[[S], bool],
    check: Callable[[S], Awaitable[None]],
) -> AsyncIterator[Callable[[], None]]:
    """Meanwhile call `check` with the signed records of a kind for this account that are wanted, one after the other.

    Yields the function that subscribes, to be called when the first one may come. `is_wanted` runs on any thread.
    """

    async def check_all(queue: FairQueue[S]) -> None:
        while True:
            await check(await queue.get())

    with ExitStack() as subscription:
        async with Background() as tasks:
            subscribed = False

            def subscribe() -> None:
                nonlocal subscribed
                if not subscribed:
                    subscribed = True
                    queue = subscription.enter_context(_queued(parts, kind, record, is_wanted))
                    tasks.start(check_all(queue), f"{kind}s")

            yield subscribe


def _is_about(orders: Container[str], statement: Rejection | Decline) -> bool:
    return statement.order in orders


@contextmanager
def _queued(
    parts: AgentComponents,
    kind: Literal["reject", "decline", "report"],
    record: type[S],
    is_wanted: Callable[[S], bool],
) -> Iterator[FairQueue[S]]:
    """Meanwhile put the wanted records into the queue if they are signed, while it has room."""
    loop, queue = asyncio.get_running_loop(), FairQueue[S](per_sender=QUEUED_OF_ONE, total=QUEUED)

    def put(statement: S) -> None:
        for dropped in queue.put(statement.signer, statement):
            parts.drops.count(DROPPED[kind], dropped.signer)

    def receive(sample: zenoh.Sample) -> None:
        try:
            statement = record.decode(sample.payload.to_bytes())
        except InvalidRecord as error:
            log.debug("an unreadable statement: %s", error)
            return
        if is_wanted(statement) and statement.is_signed:  # others cost no more than reading them
            call_in_loop(loop, put, statement)

    selector = market_selector(parts.channel.lighthouse, kind, parts.signer.address)
    subscriber: Any = parts.network.session.declare_subscriber(selector, receive)
    try:
        yield queue
    finally:
        if not parts.network.session.is_closed():
            subscriber.undeclare()
