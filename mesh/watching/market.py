"""A live view of a market: orders and results, rejections, declines, reports, and agents' job events, in one stream.

A rejection is signed by its provider, a decline by its agent, a report by a juror. A job event is not signed: it must
be on a key of the agent that its liability names as promisor. A router with a roster lets nobody else write there.
"""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Self, TypeAlias, TypeVar

import msgspec

from mesh.background import Background
from mesh.errors import AiraError, InputError
from mesh.flood import BoundedDict
from mesh.network import PresentAgents, Pump, Reading, ReadingSubscription, ValidationStatistics
from mesh.role import Lifecycle
from schemas import (
    Demand,
    EventKey,
    Liability,
    Offer,
    ProgressKey,
    Result,
    Verified,
    event_selector,
    market_selector,
    parse_address,
    parse_cid,
    parse_key,
)
from schemas.signing import Decline, Rejection
from schemas.verdicts import ValidatorReport

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable
    from contextlib import AsyncExitStack

    import zenoh

    from mesh.network import Channel, Subscription

WAITING: Final = 256
"""Events that wait for the consumer; beyond, the oldest incoming messages are dropped and counted."""
RECENT: Final = 65_536
"""Texts that a `RecentSet` keeps."""


class JobEvent(NamedTuple):
    """An agent's report on one of its jobs: `event` is `incoming`, `ready`, `complete` or `finalized`."""

    agent: str
    """Its address, EIP-55."""
    event: str
    liability: Liability


MarketEvent: TypeAlias = (
    Verified[Demand] | Verified[Offer] | Verified[Result] | Rejection | Decline | ValidatorReport | JobEvent | Reading
)
Claim: TypeAlias = Rejection | Decline | ValidatorReport | JobEvent
C = TypeVar("C", bound=Claim)
S = TypeVar("S", Rejection, Decline, ValidatorReport)


class ClaimReader(Generic[C]):
    """Decodes samples for a pump and counts refused ones under `reason`."""

    def __init__(self, read: Callable[[str, bytes], C | None], *, reason: str) -> None:
        self._read = read
        self._reason = reason
        self._lock = threading.Lock()
        self._refused: Counter[str] = Counter()
        self._accepted = 0

    def __call__(self, sample: zenoh.Sample) -> C | None:
        """The claim in a sample; None if it is refused, or none that is read."""
        try:
            claim = self._read(str(sample.key_expr), sample.payload.to_bytes())
        except AiraError:
            self.refuse()
            return None
        with self._lock:
            self._accepted += claim is not None
        return claim

    def refuse(self) -> None:
        """Count a refused sample."""
        with self._lock:
            self._refused[self._reason] += 1

    def statistics(self, *, received: int, dropped: int) -> ValidationStatistics:
        """The counts of this reader, with what its pump received and dropped."""
        with self._lock:
            refused = dict(self._refused)
            return ValidationStatistics(
                received=received, accepted=self._accepted, invalid=refused, duplicate=0, dropped=dropped
            )


class MarketCounters(msgspec.Struct, frozen=True, kw_only=True):
    """Messages received, refused (by reason), duplicate, and lost because the consumer was too slow."""

    received: int
    refused: dict[str, int]
    duplicate: int
    lost: int


class RecentSet(BoundedDict[str, None]):
    """A set of the last `RECENT` texts."""

    def __init__(self) -> None:
        super().__init__(RECENT)

    def add(self, text: str) -> bool:
        """Add a text; False if it was there."""
        is_new = text not in self
        if is_new:
            self[text] = None
        return is_new


class MarketWatch(Lifecycle):
    """Events on an open channel from now on: `async with MarketWatch(session, channel) as watch`, then iterate.

    With `model` (CIDv0), only events about orders and liabilities of that model; a result or a report counts once its
    agent has announced the liability. With `readings` also those of agents, which name no model. Readings, declines,
    reports and job events are taken from agents that are present when one arrives. For one consumer. Leaving `async
    with` ends it; the caller closes session and channel.
    """

    title = "market watch"

    def __init__(self, session: zenoh.Session, channel: Channel, *, model: str = "*", readings: bool = False) -> None:
        self._session = session
        self._channel = channel
        self._model = model
        self._readings = ReadingSubscription(session) if readings else None
        self._queue: asyncio.Queue[MarketEvent] = asyncio.Queue(WAITING)
        self._agents = PresentAgents(channel)
        self._orders = RecentSet()
        self._contracts = RecentSet()
        self._statements = RecentSet()

    async def _open(self, stack: AsyncExitStack) -> None:
        channel = self._channel
        self._demands = await stack.enter_async_context(channel.subscribe(Demand, model=self._model))
        self._offers = await stack.enter_async_context(channel.subscribe(Offer, model=self._model))
        self._results = await stack.enter_async_context(channel.subscribe(Result))
        self._rejection_reader = ClaimReader(partial(read_statement, Rejection), reason="rejection")
        self._decline_reader = ClaimReader(partial(read_statement, Decline), reason="decline")
        self._report_reader = ClaimReader(partial(read_statement, ValidatorReport), reason="report")
        self._event_reader = ClaimReader(read_event, reason="event")
        enter, selector = stack.enter_async_context, partial(market_selector, channel.lighthouse)
        self._rejected = await enter(Pump(self._session, selector("reject"), self._rejection_reader))
        self._declined = await enter(Pump(self._session, selector("decline"), self._decline_reader))
        self._reported = await enter(Pump(self._session, selector("report"), self._report_reader))
        self._events = await enter(Pump(self._session, event_selector(), self._event_reader))
        if self._readings is not None:
            await stack.enter_async_context(self._readings)
        tasks = await stack.enter_async_context(Background())
        for name, items in (
            ("demands", self._seen_orders(self._demands)),
            ("offers", self._seen_orders(self._offers)),
            ("results", self._seen_results()),
            ("rejections", self._seen_rejections()),
            ("declines", self._seen_declines()),
            ("reports", self._seen_reports()),
            ("events", self._seen_events()),
        ):
            tasks.start(self._move(items), f"watched {name}")
        if self._readings is not None:
            tasks.start(self._move(self._known_readings(self._readings)), "watched readings")

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> MarketEvent:
        return await self._queue.get()

    async def recall(self) -> None:
        """Request the orders that are open now from the providers' order books. Returns when all have replied."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._demands.recall(), name="recall demands")
            tasks.create_task(self._offers.recall(), name="recall offers")

    def counters(self) -> MarketCounters:
        """What was received so far, and what of it was refused."""
        claims: tuple[tuple[Pump[Any], ClaimReader[Any]], ...] = (
            (self._rejected, self._rejection_reader),
            (self._declined, self._decline_reader),
            (self._reported, self._report_reader),
            (self._events, self._event_reader),
        )
        return _sum_of(
            [
                *(subscription.statistics() for subscription in (self._demands, self._offers, self._results)),
                *(reader.statistics(received=pump.received, dropped=pump.dropped) for pump, reader in claims),
                *([] if self._readings is None else [self._readings.statistics()]),
            ]
        )

    async def _move(self, items: AsyncIterator[MarketEvent]) -> None:
        async for item in items:
            await self._queue.put(item)

    async def _seen_orders(self, orders: Subscription[Any]) -> AsyncIterator[MarketEvent]:
        async for order in orders:
            self._orders.add(order.hash.hex())
            yield order

    async def _seen_results(self) -> AsyncIterator[MarketEvent]:
        async for result in self._results:
            if self._model == "*" or result.message.liability in self._contracts:
                yield result
            else:  # Agents send results repeatedly; by then the liability may be known.
                self._results.forget(result)

    async def _seen_rejections(self) -> AsyncIterator[MarketEvent]:
        async for rejection in self._rejected:
            if self._is_new(rejection, rejection.reason):
                yield rejection

    async def _seen_declines(self) -> AsyncIterator[MarketEvent]:
        async for decline in self._declined:
            if not await self._agents.is_present(decline.agent):
                self._decline_reader.refuse()
            elif self._is_new(decline, decline.code):
                yield decline

    async def _seen_reports(self) -> AsyncIterator[MarketEvent]:
        async for report in self._reported:
            if not await self._agents.is_present(report.juror):
                self._report_reader.refuse()
            elif (self._model == "*" or report.liability in self._contracts) and self._statements.add(
                f"{report.liability} {report.juror}"  # it is put once for each party
            ):
                yield report

    def _is_new(self, statement: Rejection | Decline, word: str) -> bool:
        """Whether a statement is about an order of the model, and its author did not say the same of it before."""
        wanted = self._model == "*" or statement.order in self._orders
        return wanted and self._statements.add(f"{statement.order} {statement.signer} {word}")

    async def _seen_events(self) -> AsyncIterator[MarketEvent]:
        async for event in self._events:
            if not await self._agents.is_present(event.agent):
                self._event_reader.refuse()
            elif self._model in ("*", event.liability.model):
                self._contracts.add(event.liability.address)
                yield event

    async def _known_readings(self, readings: ReadingSubscription) -> AsyncIterator[MarketEvent]:
        async for reading in readings:
            if await self._agents.is_present(reading.agent):
                yield reading
            else:
                readings.refuse(reading.agent)


def read_statement(kind: type[S], key: str, payload: bytes) -> S:
    """A signed rejection, decline or report on a valid key. Raises `AiraError`."""
    parse_key(key)
    statement = kind.decode(payload)
    if not statement.is_signed:
        raise InputError(f"the {kind.__name__} is not signed by {statement.signer}")
    return statement


def read_event(key: str, payload: bytes) -> JobEvent | None:
    """An agent's event about its own job; None for the progress of its playback. Raises `AiraError`."""
    if isinstance(place := parse_key(key), ProgressKey):
        return None
    liability = Liability.decode(payload)
    if not isinstance(place, EventKey):
        raise InputError("not the key of a job event")
    for address in (liability.promisee, liability.promisor, liability.lighthouse, liability.token, liability.validator):
        parse_address(address)
    for cid in (liability.model, liability.objective, *([liability.result] if liability.result else [])):
        parse_cid(cid)
    if place.agent != liability.promisor.lower() or place.liability != liability.address.lower():
        raise InputError("the event is on another's key")
    return JobEvent(parse_address(place.agent), place.event, liability)


def _sum_of(statistics: Iterable[ValidationStatistics]) -> MarketCounters:
    """The sum of several statistics."""
    refused: Counter[str] = Counter()
    received = duplicate = lost = 0
    for one in statistics:
        refused.update(one.invalid)
        received, duplicate, lost = received + one.received, duplicate + one.duplicate, lost + one.dropped
    return MarketCounters(received=received, refused=dict(refused), duplicate=duplicate, lost=lost)
