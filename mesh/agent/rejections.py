"""Providers' rejections of an order. Anybody can publish one; only those that a provider signed count."""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.background import Background
from mesh.log_context import log_event
from mesh.network import call_in_loop
from schemas import InvalidRecord, market_selector
from schemas.signing import Rejection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    import zenoh

    from mesh.agent.components import AgentComponents

    OnRejection = Callable[[Rejection], Awaitable[None]]

log = logging.getLogger(__name__)

QUEUED: Final = 64
"""Most signed rejections of an order that wait to be checked; more are dropped, since anybody can sign one."""


class Rejections:
    """Rejections on the agent's market, by the providers of its lighthouse."""

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
