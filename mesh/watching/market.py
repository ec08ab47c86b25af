"""A live view of a market: orders and results, rejections, declines, reports, and agents' job events, in one stream.

A rejection is signed by its provider, a decline by its agent, a report by a juror. A job event is not signed: it must
be on a key of the agent that its liability names as promisor. A router with a roster lets nobody else write there.
"""

from __future__ import annotations

import asyncio
import logging
import tempfile
import threading
import time
from collections import Counter
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self, TypeAlias, TypeVar

import msgspec
import zenoh

from mesh.base.background import Background
from mesh.base.flood import BoundedDict
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.content import Exchange, Store
from mesh.errors import AiraError, InputError
from mesh.network import PresentAgents, Pump, Reading, ReadingSubscription, ValidationStatistics
from mesh.network.readings import LARGEST_READING
from mesh.recording import Limits, open_objective
from schemas import (
    Demand,
    EventKey,
    InvalidRecord,
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
from schemas.payloads import plain_value
from schemas.signing import Decline, Rejection, SignedRecord
from schemas.verdicts import VERDICT_LIMITS, ValidatorReport

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable
    from contextlib import AsyncExitStack

    from mesh.network import Channel, Subscription


log = logging.getLogger(__name__)

R = TypeVar("R", bound=SignedRecord)


class MarketQueryLimits(NamedTuple):
    """What counts of the replies to a query."""

    timeout: float = 3.0
    """Seconds to wait for them."""
    replies: int = 256
    """Replies that are read."""
    oldest: float = 24 * 3600.0
    """Seconds since a profile or an announcement was signed after which it does not count."""
    clock_error: float = 300.0
    """Seconds by which the clock of who signed it may be ahead."""


QUERY_LIMITS: Final = MarketQueryLimits()


async def query_all(
    session: zenoh.Session, keys: Iterable[str], *, payload: bytes | None = None, timeout: float = QUERY_LIMITS.timeout
) -> list[zenoh.Reply]:
    """All replies, errors included, to queries on these keys, sent at once. Empty if nobody replies within `timeout`
    seconds. Cancelling ends the queries."""
    token = zenoh.CancellationToken()
    try:
        return await asyncio.to_thread(_query_all, session, list(keys), payload, timeout, token)
    finally:
        token.cancel()  # type: ignore[no-untyped-call]


async def signed_answers(
    session: zenoh.Session,
    keys: Iterable[str],
    record: type[R],
    is_wanted: Callable[[R], bool],
    *,
    timeout: float,
    longest: int = VERDICT_LIMITS.size,
    made_at: Callable[[R], float] | None = None,
) -> dict[str, R]:
    """The wanted records in the answers to queries on these keys, by signer: of each the first.

    Longer ones than `longest` (bytes) are not read. With `made_at`, the time (Unix) at which a record was signed, it is
    the latest, and none that is older than `QUERY_LIMITS.oldest`.
    """
    replies, now = await query_all(session, keys, timeout=timeout), time.time()

    def is_better(one: R, before: R | None) -> bool:
        if made_at is None:
            return before is None
        is_new = before is None or made_at(before) < made_at(one)
        return is_new and now - QUERY_LIMITS.oldest <= made_at(one) <= now + QUERY_LIMITS.clock_error

    def read() -> dict[str, R]:
        found: dict[str, R] = {}
        for sample in (reply.ok for reply in replies if reply.ok is not None):
            if len(sample.payload) <= longest:
                with suppress(InvalidRecord):
                    one = record.decode(sample.payload.to_bytes())
                    if is_wanted(one) and is_better(one, found.get(one.signer)) and one.is_signed:
                        found[one.signer] = one
        return found

    return await asyncio.to_thread(read)


def _query_all(
    session: zenoh.Session, keys: list[str], payload: bytes | None, timeout: float, token: zenoh.CancellationToken
) -> list[zenoh.Reply]:
    queries = [
        session.get(
            key,
            zenoh.handlers.FifoChannel(QUERY_LIMITS.replies),
            payload=payload,
            encoding=None if payload is None else "application/json",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
            cancellation_token=token,
        )
        for key in keys
    ]
    return [reply for replies in queries for reply in islice(replies, QUERY_LIMITS.replies)]


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


class ClaimPump(Pump[C]):
    """The claims on `selector`, as `read` decodes them; refused ones are counted under `reason`."""

    def __init__(
        self, session: zenoh.Session, selector: str, read: Callable[[str, bytes], C | None], *, reason: str
    ) -> None:
        super().__init__(session, selector, self._claim)
        self._read = read
        self._reason = reason
        self._counting = threading.Lock()
        self._refused = 0
        self._accepted = 0

    def _claim(self, sample: zenoh.Sample) -> C | None:
        """The claim in a sample; None if it is refused, or none that is read."""
        try:
            claim = self._read(str(sample.key_expr), sample.payload.to_bytes())
        except AiraError:
            self.refuse()
            return None
        with self._counting:
            self._accepted += claim is not None
        return claim

    def refuse(self) -> None:
        """Count a refused claim."""
        with self._counting:
            self._refused += 1

    def statistics(self) -> ValidationStatistics:
        """What was received, accepted, refused and dropped."""
        with self._counting:
            accepted, invalid = self._accepted, {self._reason: self._refused} if self._refused else {}
        return ValidationStatistics(
            received=self.received, accepted=accepted, invalid=invalid, duplicate=0, dropped=self.dropped
        )


class MarketCounters(msgspec.Struct, frozen=True, kw_only=True):
    """Messages received, refused (by reason), duplicate, and lost because the consumer was too slow."""

    received: int
    refused: dict[str, int]
    duplicate: int
    lost: int


class RecentSet(BoundedDict[str, None]):
    """A set of the latest texts."""

    def __init__(self) -> None:
        super().__init__(65_536)

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
        self._queue: asyncio.Queue[MarketEvent] = asyncio.Queue(256)
        """Beyond, the oldest incoming messages are dropped and counted."""
        self._agents = PresentAgents(channel)
        self._orders = RecentSet()
        self._contracts = RecentSet()
        self._statements = RecentSet()

    async def _open(self, stack: AsyncExitStack) -> None:
        channel = self._channel
        self._demands = await stack.enter_async_context(channel.subscribe(Demand, model=self._model))
        self._offers = await stack.enter_async_context(channel.subscribe(Offer, model=self._model))
        self._results = await stack.enter_async_context(channel.subscribe(Result))

        def claims(selector: str, kind: type[S], reason: str) -> ClaimPump[S]:
            return ClaimPump(self._session, selector, partial(read_statement, kind), reason=reason)

        enter, selector = stack.enter_async_context, partial(market_selector, channel.lighthouse)
        self._rejected = await enter(claims(selector("reject"), Rejection, "rejection"))
        self._declined = await enter(claims(selector("decline"), Decline, "decline"))
        self._reported = await enter(claims(selector("report"), ValidatorReport, "report"))
        self._events = await enter(ClaimPump(self._session, event_selector(), read_event, reason="event"))
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
        refused: Counter[str] = Counter()
        received = duplicate = lost = 0
        sources: list[Any] = [self._demands, self._offers, self._results]
        sources += [self._rejected, self._declined, self._reported, self._events]
        for source in (*sources, *([] if self._readings is None else [self._readings])):
            one = source.statistics()
            refused.update(one.invalid)
            received, duplicate, lost = received + one.received, duplicate + one.duplicate, lost + one.dropped
        return MarketCounters(received=received, refused=dict(refused), duplicate=duplicate, lost=lost)

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
                self._declined.refuse()
            elif self._is_new(decline, decline.code):
                yield decline

    async def _seen_reports(self) -> AsyncIterator[MarketEvent]:
        async for report in self._reported:
            if not await self._agents.is_present(report.juror):
                self._reported.refuse()
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
                self._events.refuse()
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


class ResultFetchLimits(NamedTuple):
    """What the results that are fetched unasked may use."""

    size: int = LARGEST_READING + 64 * 1024
    """Bytes of one: a reading and what a file adds. Larger recordings are not fetched."""
    kept: int = 16 << 20
    """Bytes of all in the temporary store; beyond, the oldest are evicted."""
    at_once: int = 4
    """Results fetched at the same time."""
    pending: int = 64
    """Results being fetched or waiting; more are skipped."""
    timeout: float = 10.0
    """Seconds without a block after which fetching a result fails."""


FETCH_LIMITS: Final = ResultFetchLimits()
LIMITS: Final = Limits(size=FETCH_LIMITS.size, expanded=FETCH_LIMITS.size, messages=100)


class ReadingFetcher(Lifecycle):
    """Fetches the results without a liability among the events given to `handle`, and passes each reading to `deliver`.

    Use with `async with`; files are in a temporary folder meanwhile. Agents' job events show which results have a
    liability. Results that can't be fetched or read are logged.
    """

    title = "fetcher of readings"

    def __init__(
        self, session: zenoh.Session, deliver: Callable[[Reading], None], *, timeout: float = FETCH_LIMITS.timeout
    ) -> None:
        self._session = session
        self._deliver = deliver
        self._timeout = timeout
        self._contracts = RecentSet()
        self._turns = asyncio.Semaphore(FETCH_LIMITS.at_once)
        self.pending = 0
        """Results being fetched or waiting."""

    async def _open(self, stack: AsyncExitStack) -> None:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="aira-readings-"))
        store = await asyncio.to_thread(Store, Path(folder), limit=FETCH_LIMITS.size, quota=FETCH_LIMITS.kept)
        stack.callback(store.close)
        self._exchange = await stack.enter_async_context(Exchange(self._session, store))
        self._tasks = await stack.enter_async_context(Background())

    def handle(self, event: MarketEvent) -> None:
        """Take an event of the market."""
        if isinstance(event, JobEvent):
            self._contracts.add(event.liability.address)
        elif isinstance(event, Verified) and isinstance(event.message, Result):
            result = event.message
            if result.liability in self._contracts:
                return
            if self.pending == FETCH_LIMITS.pending:
                fields = log_event("result-skipped", result=result.result, signer=event.signer)
                log.warning("skipped the result %s of %s: too many at once", result.result, event.signer, extra=fields)
                return
            self.pending += 1
            self._tasks.start(self._fetch(result.result, event.signer), f"reading {result.result}")

    async def _fetch(self, cid: str, signer: str) -> None:
        try:
            async with self._turns:
                path = await self._exchange.fetch(cid, size_limit=FETCH_LIMITS.size, timeout=self._timeout)
                readings = await asyncio.to_thread(_read, path, cid, signer)
        except AiraError as error:
            fields = log_event("result-unreadable", result=cid, signer=signer, code=error.code)
            log.warning("can't read the result %s of %s: %s", cid, signer, error, extra=fields)
        else:
            for reading in readings:
                self._deliver(reading)
        finally:
            self.pending -= 1


def _read(path: Path, cid: str, signer: str) -> list[Reading]:
    return [
        Reading(signer, one.topic, plain_value(one.payload, one.type), one.payload, one.type, cid)
        for one in open_objective(path, LIMITS).messages()
    ]
