"""A subscription: the verified messages of one kind, as an async iterator."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from typing import TYPE_CHECKING, Final, Generic, Self

import zenoh

from mesh.errors import AiraError
from mesh.network.pump import Pump
from mesh.network.validation import M, MessageValidator, Unresolved, ValidationStatistics
from schemas import Verified, names_in

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from types import TracebackType

    Resolver = Callable[[str], Awaitable[str]]

log = logging.getLogger(__name__)

RECALL_TIMEOUT: Final = 5.0
"""Seconds that providers have to answer with their open orders."""
RECALL_LIMIT: Final = 65_536
"""Open orders accepted from one recall, at most."""
LOOKUP_LIMIT: Final = 256
"""Messages that may wait for the resolution of their ENS names. More are rejected: anybody may send unknown names."""


class Subscription(Generic[M]):
    """The verified messages of one kind, as an async iterator: `async with channel.subscribe(Demand) as demands`.

    The iteration ends when `async with` is left. Supports one consumer. Messages with ENS names are delivered once
    `resolver` has resolved them, so later messages may overtake them; at most `lookup_limit` of them wait. Raises
    `ClosedError` before it is entered.
    """

    def __init__(
        self,
        session: zenoh.Session,
        selector: str,
        validator: MessageValidator[M],
        resolver: Resolver | None,
        *,
        lookup_limit: int = LOOKUP_LIMIT,
    ) -> None:
        self._session = session
        self.selector: Final = selector
        """The key expression that is subscribed to."""
        self._validator: MessageValidator[M] = validator
        self._resolver = resolver
        self._pump: Pump[Verified[M] | Unresolved[M]] = Pump(session, selector, validator)
        self._unresolved: asyncio.Queue[Unresolved[M]] = asyncio.Queue(lookup_limit)
        self._queries: set[zenoh.CancellationToken] = set()

    async def __aenter__(self) -> Self:
        await self._pump.__aenter__()
        self._lookups = asyncio.create_task(self._resolve_names(), name=f"resolve names on {self.selector}")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lookups.cancel()
        for query in tuple(self._queries):
            query.cancel()  # type: ignore[no-untyped-call]
        await self._pump.__aexit__(kind, error, trace)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Verified[M]:
        while isinstance(item := await anext(self._pump), Unresolved):
            if self._resolver is None or self._unresolved.full():
                self._validator.reject("name")
            else:
                self._unresolved.put_nowait(item)
        return item

    async def recall(self) -> None:
        """Ask the providers for the open orders; the iterator yields each new one once.

        Returns when all providers have answered or after `RECALL_TIMEOUT`; having no provider is not an error.
        Cancelling this call or leaving `async with` ends the query.
        """
        self._pump.check_entered()
        query = zenoh.CancellationToken()
        self._queries.add(query)
        try:
            await asyncio.to_thread(self._recall, query)
        finally:
            self._queries.discard(query)
            query.cancel()  # type: ignore[no-untyped-call]

    def _recall(self, query: zenoh.CancellationToken) -> None:
        """Empty Zenoh's queue before verifying signatures: a full queue would stall the session."""
        # Not a RingChannel, which loses what it still holds when the last reply arrives.
        replies = self._session.get(
            self.selector,
            zenoh.handlers.FifoChannel(RECALL_LIMIT),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=RECALL_TIMEOUT,
            cancellation_token=query,
        )
        samples = deque((reply.ok for reply in replies if reply.ok is not None), maxlen=RECALL_LIMIT)
        while samples and not query.is_cancelled:
            self._pump.feed(samples.popleft())

    @property
    def kind(self) -> str:
        """The kind of message: `demand`, `offer` or `result`."""
        return self._validator.kind.__name__.lower()

    def forget(self, verified: Verified[M]) -> None:
        """Deliver a message once more when it is sent again, because it can't be handled yet."""
        self._validator.forget(verified)

    def statistics(self) -> ValidationStatistics:
        """The messages received, rejected (by reason) and dropped so far."""
        return self._validator.statistics(received=self._pump.received, dropped=self._pump.dropped)

    async def _resolve_names(self) -> None:
        """Resolve the names of one message after another. An unexpected error of the resolver ends the iteration."""
        try:
            while True:
                unresolved = await self._unresolved.get()
                if (verified := await self._resolved(unresolved)) is not None:
                    self._pump.insert(verified)
        except Exception as error:
            self._pump.fail(error)

    async def _resolved(self, unresolved: Unresolved[M]) -> Verified[M] | None:
        assert self._resolver is not None
        try:
            addresses = {name: await self._resolver(name) for name in names_in(unresolved.message)}
            return self._validator.resolved(unresolved, addresses)
        except AiraError as error:
            log.debug("a name in a message can't be resolved: %s", error)
            self._validator.reject("name")
            return None
