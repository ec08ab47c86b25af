"""Providers' rejections of an order. Anybody may write one; a provider's word is what a provider has signed."""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final

from mesh.background import Background
from mesh.chain import NodeUnreachable, RequestRefused
from mesh.network import call_in_loop
from schemas import InvalidRecord, market_selector
from schemas.signing import Rejection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    import zenoh

    from mesh.chain import Chain

log = logging.getLogger(__name__)

WAITING: Final = 64
"""Signed rejections of an order that wait to be looked at; more are dropped, since anybody may sign one."""
RETRY: Final = 1.0
"""Seconds before the chain is asked again that did not answer."""


class Rejections:
    """Rejections on the keys of `market` (ENS name), by providers of `lighthouse` (the same name, or the address)."""

    def __init__(self, session: zenoh.Session, chain: Chain, *, market: str, lighthouse: str) -> None:
        self._session = session
        self._chain = chain
        self._market = market
        self._lighthouse = lighthouse

    @asynccontextmanager
    async def heard(self, order: str, tell: Callable[[Rejection], Awaitable[None]]) -> AsyncIterator[None]:
        """Meanwhile `tell` of each rejection of the order (hash, hexadecimal) that a provider has signed.

        `tell` is called again where it raises `NodeUnreachable` or `RequestRefused`.
        """
        loop = asyncio.get_running_loop()
        signed: asyncio.Queue[Rejection] = asyncio.Queue(WAITING)

        def hear(sample: zenoh.Sample) -> None:
            rejection = _signed_rejection(sample.payload.to_bytes())
            if rejection is not None and rejection.order == order:
                call_in_loop(loop, _put, signed, rejection)

        selector = market_selector(self._market, "reject").replace("/*/*", f"/{order}/*")
        subscriber: Any = self._session.declare_subscriber(selector, hear)
        try:
            async with Background() as tasks:
                tasks.start(self._examine(signed, tell), f"rejections of {order}")
                yield
        finally:
            if not self._session.is_closed():
                subscriber.undeclare()

    async def _examine(self, signed: asyncio.Queue[Rejection], tell: Callable[[Rejection], Awaitable[None]]) -> None:
        rejection = await signed.get()
        while True:
            try:
                await self._consider(rejection, tell)
            except (NodeUnreachable, RequestRefused) as error:
                log.debug("a rejection can't be looked into: %s", error)
                await asyncio.sleep(RETRY)
            else:
                rejection = await signed.get()

    async def _consider(self, rejection: Rejection, tell: Callable[[Rejection], Awaitable[None]]) -> None:
        if rejection.provider in (await self._chain.lighthouses.get(self._lighthouse)).stakes:
            await tell(rejection)
        else:
            log.warning("%s, who is no provider, says of an order: %s", rejection.provider, rejection.reason)


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
