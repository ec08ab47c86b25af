"""Signed records for an account, about its orders and contracts: rejections, declines, reports."""

from __future__ import annotations

import asyncio
import logging
from contextlib import ExitStack, asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar

from mesh.background import Background, call_in_loop
from mesh.flood import FairQueue
from schemas import InvalidRecord, market_selector
from schemas.signing import SignedRecord

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator

    import zenoh

    from mesh.agent.components import AgentComponents

log = logging.getLogger(__name__)

QUEUED: Final = 64
"""Most signed records of a kind that wait to be checked; more are dropped."""
QUEUED_OF_ONE: Final = 16
"""Of these, those of one signer."""
DROPPED: Final = {"reject": "rejections", "decline": "declines", "report": "reports"}
"""How those that were dropped are counted."""

S = TypeVar("S", bound=SignedRecord)


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
