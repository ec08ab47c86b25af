"""A market as it happens: verified orders and Results, rejections, and what agents say of their jobs, in one stream."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any, Final, Self, TypeAlias

from mesh.background import Background
from mesh.network import Pump, call_in_loop
from mesh.watching.claims import JobEvent, Reader, read_event, read_rejection
from mesh.watching.tally import Tally, added_up
from schemas import (
    Demand,
    InvalidKey,
    Offer,
    PresenceKey,
    Result,
    Verified,
    market_selector,
    parse_key,
    presence_selector,
)
from schemas.signing import Rejection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from types import TracebackType

    import zenoh

    from mesh.network import Channel, Subscription

Seen: TypeAlias = Verified[Demand] | Verified[Offer] | Verified[Result] | Rejection | JobEvent

WAITING: Final = 256
"""What waits to be taken at most; meanwhile the oldest of what comes in is lost, and counted."""
REMEMBERED: Final = 65_536
"""Orders, contracts and rejections that are remembered."""
EVENTS: Final = "aira/agent/*/liability/*/*"


class Remembered:
    """The last `REMEMBERED` of some texts."""

    def __init__(self) -> None:
        self._texts: OrderedDict[str, None] = OrderedDict()

    def __contains__(self, text: str) -> bool:
        return text in self._texts

    def add(self, text: str) -> bool:
        """Remember a text; False where it is known."""
        if text in self._texts:
            return False
        self._texts[text] = None
        if len(self._texts) > REMEMBERED:
            self._texts.popitem(last=False)
        return True


class MarketWatch:
    """What happens on an open channel from now on: `async with MarketWatch(session, channel) as seen`, then iterate.

    With `model` (CIDv0) only what concerns orders and contracts of that model; a Result concerns it once the agent has
    told of its contract. The events are those of agents that are, or were meanwhile, present on the channel. One
    consumer. Leaving `async with` ends it; session and channel stay the caller's to close.
    """

    def __init__(self, session: zenoh.Session, channel: Channel, *, model: str = "*") -> None:
        self._session = session
        self._channel = channel
        self._model = model
        self._queue: asyncio.Queue[Seen] = asyncio.Queue(WAITING)
        self._here = Remembered()
        self._orders = Remembered()
        self._contracts = Remembered()
        self._rejections = Remembered()
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            channel = self._channel
            self._demands = await stack.enter_async_context(channel.subscribe(Demand, model=self._model))
            self._offers = await stack.enter_async_context(channel.subscribe(Offer, model=self._model))
            self._results = await stack.enter_async_context(channel.subscribe(Result))
            await self._follow_presence(stack)
            self._rejecting = Reader(read_rejection, reason="rejection")
            self._telling = Reader(read_event, reason="event")
            selector = market_selector(channel.lighthouse, "reject")
            self._rejected = await stack.enter_async_context(Pump(self._session, selector, self._rejecting))
            self._events = await stack.enter_async_context(Pump(self._session, EVENTS, self._telling))
            tasks = await stack.enter_async_context(Background())
            for name, items in (
                ("demands", self._seen_orders(self._demands)),
                ("offers", self._seen_orders(self._offers)),
                ("results", self._seen_results()),
                ("rejections", self._seen_rejections()),
                ("events", self._seen_events()),
            ):
                tasks.start(self._move(items), f"watched {name}")
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        return await self._stack.__aexit__(kind, error, trace)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Seen:
        return await self._queue.get()

    async def recall(self) -> None:
        """Let the orders that are open now come, too, from the providers' memory. Returns when all have answered."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._demands.recall(), name="recall demands")
            tasks.create_task(self._offers.recall(), name="recall offers")

    def tally(self) -> Tally:
        """What came by so far, and what of it was refused."""
        claims = ((self._rejected, self._rejecting), (self._events, self._telling))
        return added_up(
            [
                *(subscription.statistics() for subscription in (self._demands, self._offers, self._results)),
                *(reader.statistics(received=pump.received, dropped=pump.dropped) for pump, reader in claims),
            ]
        )

    async def _move(self, items: AsyncIterator[Seen]) -> None:
        async for item in items:
            await self._queue.put(item)

    async def _seen_orders(self, orders: Subscription[Any]) -> AsyncIterator[Seen]:
        async for order in orders:
            self._orders.add(order.hash.hex())
            yield order

    async def _seen_results(self) -> AsyncIterator[Seen]:
        async for result in self._results:
            if self._model == "*" or result.message.liability in self._contracts:
                yield result
            else:  # It is sent again, and the agent may have told of its contract by then.
                self._results.forget(result)

    async def _seen_rejections(self) -> AsyncIterator[Seen]:
        async for rejection in self._rejected:
            wanted = self._model == "*" or rejection.order in self._orders
            if wanted and self._rejections.add(f"{rejection.order} {rejection.provider} {rejection.reason}"):
                yield rejection

    async def _seen_events(self) -> AsyncIterator[Seen]:
        async for event in self._events:
            if event.agent.lower() not in self._here:
                self._telling.refuse()
            elif self._model in ("*", event.liability.model):
                self._contracts.add(event.liability.address)
                yield event

    async def _follow_presence(self, stack: AsyncExitStack) -> None:
        """Know who is here, before the first event comes and from then on."""
        loop = asyncio.get_running_loop()
        subscriber: Any = self._session.liveliness().declare_subscriber(
            presence_selector(self._channel.lighthouse),
            lambda sample: call_in_loop(loop, self._present, sample),
            history=True,
        )
        stack.callback(lambda: None if self._session.is_closed() else subscriber.undeclare())
        for key in await self._channel.present():
            self._here.add(key.agent)

    def _present(self, sample: zenoh.Sample) -> None:
        """Somebody came; who leaves is remembered, for its last words may still be on their way."""
        try:
            key = parse_key(str(sample.key_expr))
        except InvalidKey:
            return
        if isinstance(key, PresenceKey):
            self._here.add(key.agent)
