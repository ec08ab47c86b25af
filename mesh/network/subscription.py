"""Subscriptions to a market's verified messages, and the recall of open orders from the providers' order books."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any, Final, Generic, Self

import zenoh

from mesh.flood import FairQueue, Rate, RateLimiter
from mesh.network.pump import Pump
from mesh.network.validation import M, MessageValidator, Unresolved, ValidationStatistics
from schemas import MAX_MESSAGE_SIZE, Verified

if TYPE_CHECKING:
    from types import TracebackType

    from mesh.flood import Drops

RECALL_TIMEOUT: Final = 5.0
"""Seconds that providers have to answer with their open orders."""
RECALL_LIMIT: Final = 65_536
"""Open orders accepted from one recall, at most."""
RECALL_BYTES: Final = 64 * 1024 * 1024
"""Bytes of messages accepted from one recall, at most."""
LOOKUP_LIMIT: Final = 256
"""Messages about which the chain has to be asked that may wait for it, half of them from one signer. More are rejected:
anybody may send unknown names. Those whose signer is not known, because they contain names, share one signer's part."""
LOOKUP_RATE: Final = Rate(10, 64)
"""Messages of one signer about which a subscription asks the chain."""
LOOKUP_RATE_IN_TOTAL: Final = Rate(40, 256)


class Subscription(Generic[M]):
    """The verified messages of one kind, as an async iterator: `async with channel.subscribe(Demand) as demands`.

    The iteration ends when `async with` is left. Supports one consumer. Messages about which the chain has to be asked
    (ENS names, unknown validators) are delivered after that, so later ones may overtake them; at most `lookup_limit`
    wait. Raises `ClosedError` before it is entered.
    """

    def __init__(
        self,
        session: zenoh.Session,
        selector: str,
        validator: MessageValidator[M],
        *,
        lookup_limit: int = LOOKUP_LIMIT,
        drops: Drops | None = None,
    ) -> None:
        self._session = session
        self.selector: Final = selector
        """The key expression that is subscribed to."""
        self._validator: MessageValidator[M] = validator
        self._drops = drops
        self._pump: Pump[Verified[M] | Unresolved[M]] = Pump(
            session,
            selector,
            copy=lambda sample: (str(sample.key_expr), sample.payload.to_bytes()),
            convert_all=validator.check_all,
            payload_limit=MAX_MESSAGE_SIZE,
            drops=drops,
        )
        self._unresolved: FairQueue[Unresolved[M]] = FairQueue(per_sender=lookup_limit // 2, total=lookup_limit)
        self._lookup_rate = RateLimiter(per_sender=LOOKUP_RATE, total=LOOKUP_RATE_IN_TOTAL)
        self._queries: set[zenoh.CancellationToken] = set()

    async def __aenter__(self) -> Self:
        await self._pump.__aenter__()
        self._lookups = asyncio.create_task(self._ask_chain(), name=f"ask the chain about {self.selector}")
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
        while True:
            if (item := self._pump.take_ready()) is None:
                item = await anext(self._pump)
            if not isinstance(item, Unresolved):
                return item
            for dropped in self._unresolved.put(item.signer, item):
                self._drop_lookup(dropped)

    def _drop_lookup(self, unresolved: Unresolved[M]) -> None:
        self._validator.reject(unresolved.question)
        if self._drops is not None:
            self._drops.count("lookup", unresolved.signer)

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
        copies = deque[tuple[Any, int]]()
        left = RECALL_BYTES
        for reply in replies:
            if reply.ok is not None and left > 0 and (copied := self._pump.copy(reply.ok)) is not None:
                copies.append(copied)
                left -= copied[1]
        if left <= 0 and self._drops is not None:
            self._drops.count("recall")
        while copies and not query.is_cancelled:
            self._pump.feed(copies.popleft())

    @property
    def kind(self) -> str:
        """The kind of message: `demand`, `offer` or `result`."""
        return self._validator.kind.__name__.lower()

    def forget(self, verified: Verified[M]) -> None:
        """Deliver a message once more when it is sent again; see `MessageValidator`."""
        self._validator.forget(verified)

    def statistics(self) -> ValidationStatistics:
        """The messages received, rejected (by reason) and dropped so far."""
        return self._validator.statistics(received=self._pump.received, dropped=self._pump.dropped)

    async def _ask_chain(self) -> None:
        """Ask the chain about one message after another. An unexpected error ends the iteration."""
        try:
            while True:
                unresolved = await self._unresolved.get()
                if not self._lookup_rate.allow(unresolved.signer):
                    self._drop_lookup(unresolved)
                elif (verified := await self._validator.complete(unresolved)) is not None:
                    self._pump.insert(verified)
        except Exception as error:
            self._pump.fail(error)
