"""Providers' rejections of an account's own orders."""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.background import Background, call_in_loop
from mesh.log_context import log_event
from schemas import InvalidRecord, market_selector
from schemas.signing import Rejection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    import zenoh

    from mesh.agent.components import AgentComponents

log = logging.getLogger(__name__)

QUEUED: Final = 64
"""Most signed rejections that wait to be checked; more are dropped, since anybody can sign one."""


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
