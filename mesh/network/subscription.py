"""The verified messages of one kind, as they come."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from typing import TYPE_CHECKING, Final, Generic, Self

import zenoh

from mesh.errors import AiraError
from mesh.network.pump import Pump
from mesh.network.validation import M, MessageValidator, Statistics, Unresolved
from schemas import Verified, names_in

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from types import TracebackType

    Resolver = Callable[[str], Awaitable[str]]

log = logging.getLogger(__name__)

RECALL_TIMEOUT: Final = 5.0
"""Seconds given to the providers to answer with their open orders."""
RECALL_LIMIT: Final = 65_536
"""Open orders taken from one recall at most."""
LOOKING_UP: Final = 256
"""Messages that wait for their ENS names at most; more are refused, since anybody may write names that nobody knows."""


class Subscription(Generic[M]):
    """The verified messages of one kind, as an async iterator: `async with channel.subscribe(Demand) as demands`.

    Ends by leaving `async with`; nothing arrives after that. One consumer. A message that names addresses by ENS is
    overtaken by others while they are looked up. Raises `ClosedError` before it is entered.
    """

    def __init__(
        self, session: zenoh.Session, selector: str, door: MessageValidator[M], resolver: Resolver | None
    ) -> None:
        self._session = session
        self._selector = selector
        self._door: MessageValidator[M] = door
        self._resolver = resolver
        self._pump: Pump[Verified[M] | Unresolved[M]] = Pump(session, selector, door)
        self._named: asyncio.Queue[Unresolved[M]] = asyncio.Queue(LOOKING_UP)
        self._recalls: set[zenoh.CancellationToken] = set()

    async def __aenter__(self) -> Self:
        await self._pump.__aenter__()
        self._looking_up = asyncio.create_task(self._look_up(), name=f"names on {self._selector}")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._looking_up.cancel()
        for asking in tuple(self._recalls):
            asking.cancel()  # type: ignore[no-untyped-call]
        await self._pump.__aexit__(kind, error, trace)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Verified[M]:
        while isinstance(item := await anext(self._pump), Unresolved):
            if self._resolver is None or self._named.full():
                self._door.refuse("name")
            else:
                self._named.put_nowait(item)
        return item

    async def recall(self) -> None:
        """Ask the market's memory for what is open; the answers come out of the iterator, once each.

        Returns when all providers have answered or `RECALL_TIMEOUT` has passed; nobody there is no error. Cancelling
        and leaving `async with` end the asking.
        """
        self._pump.check_entered()
        asking = zenoh.CancellationToken()
        self._recalls.add(asking)
        try:
            await asyncio.to_thread(self._recall, asking)
        finally:
            self._recalls.discard(asking)
            asking.cancel()  # type: ignore[no-untyped-call]

    def _recall(self, asking: zenoh.CancellationToken) -> None:
        """Empty Zenoh's queue first, as a full one would stall the session; signatures are checked after that."""
        # Not a RingChannel: what is still in it when the last answer has come is lost.
        answers = self._session.get(
            self._selector,
            zenoh.handlers.FifoChannel(RECALL_LIMIT),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=RECALL_TIMEOUT,
            cancellation_token=asking,
        )
        samples = deque((answer.ok for answer in answers if answer.ok is not None), maxlen=RECALL_LIMIT)
        while samples and not asking.is_cancelled:
            self._pump.feed(samples.popleft())

    @property
    def kind(self) -> str:
        """What comes: `demand`, `offer` or `result`."""
        return self._door.kind.__name__.lower()

    def forget(self, verified: Verified[M]) -> None:
        """Let a message arrive once more when it is sent again: what had to be done with it can't be done yet."""
        self._door.forget(verified)

    def statistics(self) -> Statistics:
        """What came in so far, what of it was refused and why, what was lost to a slow consumer."""
        return self._door.statistics(received=self._pump.received, dropped=self._pump.dropped)

    async def _look_up(self) -> None:
        """Resolve the names of one message after the other; a failure of the resolver's ends the iteration."""
        try:
            while True:
                unresolved = await self._named.get()
                if (verified := await self._resolved(unresolved)) is not None:
                    self._pump.insert(verified)
        except Exception as error:
            self._pump.fail(error)

    async def _resolved(self, unresolved: Unresolved[M]) -> Verified[M] | None:
        assert self._resolver is not None
        try:
            addresses = {name: await self._resolver(name) for name in names_in(unresolved.message)}
            return self._door.resolved(unresolved, addresses)
        except AiraError as error:
            log.debug("a message names what can't be resolved: %s", error)
            self._door.refuse("name")
            return None
