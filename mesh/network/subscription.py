"""A subscription to a lighthouse's messages of one kind: verified, and recalled from the providers' order books."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final, Generic, Self

import zenoh

from mesh.flood import Drops, FairQueue, Rate, RateLimiter
from mesh.network.lookups import M, Unresolved
from mesh.network.pump import BATCH, Pump
from schemas import MAX_MESSAGE_SIZE, Verified

if TYPE_CHECKING:
    from mesh.network.validation import MessageValidator, ValidationStatistics

RECALL_LIMIT: Final = 65_536
"""Open orders accepted from one recall, at most."""
RECALL_BYTES: Final = 64 * 1024 * 1024
"""Bytes of messages accepted from one recall, at most."""
LOOKUP_LIMIT: Final = 256
"""Messages that may wait for an answer of the chain, half of them from one signer; more are rejected. Messages with
names, whose signer is not known yet, share one signer's part."""
LOOKUP_RATE: Final = Rate(10, 64)
"""Messages of one signer about which a subscription asks the chain."""
LOOKUP_RATE_IN_TOTAL: Final = Rate(40, 256)


class Subscription(Pump[Verified[M] | Unresolved[M]], Generic[M]):
    """The verified messages of one kind, as an async iterator: `async with channel.subscribe(Demand) as demands`.

    A message about which the chain must be asked (ENS names, unknown validators) may be overtaken by later ones.
    """

    def __init__(
        self, session: zenoh.Session, selector: str, validator: MessageValidator[M], drops: Drops, answer_timeout: float
    ) -> None:
        copy, check, most = self._copy, validator.check_all, MAX_MESSAGE_SIZE
        super().__init__(
            session, selector, copy_all=copy, convert_all=check, payload_limit=most, resent=True, drops=drops
        )
        self._validator: MessageValidator[M] = validator
        self._answer_timeout = answer_timeout
        self.kind: Final = validator.kind.kind
        """The kind of message: `demand`, `offer`, `withdrawal` or `result`."""
        self._unresolved: FairQueue[Unresolved[M]] = FairQueue(per_sender=LOOKUP_LIMIT // 2, total=LOOKUP_LIMIT)
        self._lookup_rate = RateLimiter(per_sender=LOOKUP_RATE, total=LOOKUP_RATE_IN_TOTAL)
        self._queries: set[zenoh.CancellationToken] = set()

    async def __aenter__(self) -> Self:
        await super().__aenter__()
        self._lookups = asyncio.create_task(self._ask_chain(), name=f"ask the chain about {self.selector}")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._lookups.cancel()
        for query in tuple(self._queries):
            query.cancel()  # type: ignore[no-untyped-call]
        await super().__aexit__(*exc_info)

    async def __anext__(self) -> Verified[M]:
        while True:
            if (item := self.take_ready()) is None:
                item = await super().__anext__()
            if not isinstance(item, Unresolved):
                return item
            for dropped in self._unresolved.put(item.signer, item):
                self._drop_lookup(dropped)

    def _drop_lookup(self, unresolved: Unresolved[M]) -> None:
        self._validator.reject(unresolved.question)
        self._drops.count("lookup", unresolved.signer)

    def _copy(self, samples: list[zenoh.Sample]) -> list[tuple[str, bytes] | None]:
        """What is checked of samples; None for a copy of an accepted message: it needs no place in the ring."""
        keys = [str(sample.key_expr) for sample in samples]
        payloads = [sample.payload.to_bytes() for sample in samples]
        return self._validator.without_copies(zip(keys, payloads, strict=True))

    async def recall(self) -> None:
        """Ask the providers for the open orders; the iterator yields each new one once.

        Returns when all providers have answered, or after `answer_timeout`, also without a provider. Cancelling this
        call or leaving `async with` ends the query.
        """
        self.check_entered()
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
            timeout=self._answer_timeout,
            cancellation_token=query,
        )
        copies, size = list[Any](), 0
        for sample in (reply.ok for reply in replies if reply.ok is not None):
            if len(copies) == RECALL_LIMIT or size >= RECALL_BYTES:
                self._drops.count("recall")
            elif (copied := self.copy(sample)) is not None:
                copies.append(copied)
                size += len(sample.payload)
        for start in range(0, len(copies), BATCH):
            if not query.is_cancelled:
                self.feed(copies[start : start + BATCH])

    def forget(self, verified: Verified[M], *, after: float = 0.0) -> None:
        """Deliver a message once more when it is sent again, `after` seconds; see `MessageValidator`."""
        self._validator.forget(verified, after=after)

    def statistics(self) -> ValidationStatistics:
        """The messages received, rejected (by reason) and dropped so far."""
        return self._validator.statistics(received=self.received, dropped=self.dropped)

    async def _ask_chain(self) -> None:
        """Ask the chain about one message after another. An unexpected error ends the iteration."""
        try:
            while True:
                unresolved = await self._unresolved.get()
                if not self._lookup_rate.allow(unresolved.signer):
                    self._drop_lookup(unresolved)
                elif (verified := await self._validator.complete(unresolved)) is not None:
                    self.insert(verified)
        except Exception as error:
            self.fail(error)
