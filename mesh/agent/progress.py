"""What those see who wait for a job: offers and declines, the contract, the playback, the result, the payment."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

import msgspec

from mesh.background import Background
from mesh.errors import AiraError
from mesh.flood import Rate, RateLimiter
from mesh.log_context import log_event
from mesh.network import Pump
from schemas import EventKey, Liability, Offer, PlaybackPosition, ProgressKey, event_selector, parse_cid, parse_key
from schemas.signing import Decline, Rejection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh

    from mesh.agent.components import AgentComponents
    from mesh.network import Channel, Subscription
    from schemas import Demand

log = logging.getLogger(__name__)

OFFERS_SHOWN: Final = 64
"""Most offers for a demand, by different agents or on different terms, that are reported."""
REPORTED: Final = Rate(per_second=4.0, burst=16)
"""Reports of an agent about one job."""
REPORTS_WAITING: Final = 64
"""Reports about one job that wait; of more, the oldest are dropped."""
PRESENCE_INTERVAL: Final = 2.0
"""Seconds between two questions whether an agent is present."""

Kind: TypeAlias = Literal[
    "offer",
    "declined",
    "rejected",
    "contract",
    "ready",
    "playing",
    "gone",
    "back",
    "result",
    "judged",
    "unjudged",
    "paid",
    "refunded",
]


class Progress(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Something that happened to an order or its contract; `kind` says what:

    - `offer`: `agent` offers this work. With the code `other-cost`, `other-token` or `other-validator` it wants other
      terms than the demand, and `detail` is what it wants (a cost in the token's smallest unit).
    - `declined`: `agent` does not work for the demand; `code` and `detail` say why.
    - `rejected`: the provider `agent` can't use the order now; `code` and `detail` say why.
    - `contract`: the order became the contract `detail` (address) with `agent`.
    - `ready`: `agent` has checked the objective.
    - `playing`: `agent` has played `position` of `total` messages.
    - `gone`: `agent`, which has the contract, is not present any more; `back`: it is again.
    - `result`: `agent` has signed the result `detail` (CID); its code is `failed` if the job was not done.
    - `judged`: the juror `agent` of the contract's validator has judged, as the `position`-th of `total` needed alike;
      `code` is empty if the work counts, else that of the first reason; `detail` says so in words.
    - `unjudged`: the validator `agent` is `silent`, or its jurors `disagree` (the code): `position` of `total` needed
      have judged alike. `detail` says from which block the cost can be refunded.
    - `paid`, `refunded`: the contract has ended; `refunded` has the code and the detail of the failure.

    What an agent says of its job before the end is its own word, and may be lost on the way.
    """

    kind: Kind
    agent: str = ""
    """Whose word it is: an address (EIP-55)."""
    code: str = ""
    """A word for programs."""
    detail: str = ""
    """For people; it may come from a stranger."""
    position: int = 0
    total: int = 0


OnProgress: TypeAlias = Callable[[Progress], object]


def nothing(progress: Progress) -> None:
    """Ignore it."""


def report(on_progress: OnProgress, progress: Progress) -> None:
    """Call a user's function and log its errors, which must not end the wait."""
    try:
        on_progress(progress)
    except Exception as error:
        facts = log_event("progress-not-reported", kind=progress.kind, error=type(error).__name__)
        log.exception("on_progress failed; the agent continues", extra=facts)


@asynccontextmanager
async def seen_offers(channel: Channel, order: Demand | Offer, on_progress: OnProgress) -> AsyncIterator[None]:
    """Meanwhile report the offers of a demand's model and objective, also with other terms; equal ones once."""
    if on_progress is nothing or isinstance(order, Offer):
        yield
        return
    async with channel.subscribe(Offer, model=order.model) as offers, Background() as tasks:
        tasks.start(_report_offers(offers, order, on_progress), "offers seen")
        tasks.start(offers.recall(), "recall offers")
        yield


def stated(statement: Rejection | Decline) -> Progress:
    """The progress that a rejection or a decline is."""
    if isinstance(statement, Decline):
        return Progress(kind="declined", agent=statement.agent, code=statement.code, detail=statement.detail)
    return Progress(kind="rejected", agent=statement.provider, code=statement.reason, detail=statement.detail)


async def _report_offers(offers: Subscription[Offer], demand: Demand, on_progress: OnProgress) -> None:
    seen: set[Progress] = set()
    async for offer in offers:
        said = _offered(offer.signer, offer.message, demand)
        if offer.message.objective == demand.objective and said not in seen and len(seen) < OFFERS_SHOWN:
            seen.add(said)
            report(on_progress, said)


def _offered(agent: str, offer: Offer, demand: Demand) -> Progress:
    for field in ("token", "cost", "validator"):
        if (wanted := getattr(offer, field)) != getattr(demand, field):
            return Progress(kind="offer", agent=agent, code=f"other-{field}", detail=str(wanted))
    return Progress(kind="offer", agent=agent)


@asynccontextmanager
async def followed_job(parts: AgentComponents, liability: Liability, on_progress: OnProgress) -> AsyncIterator[None]:
    """Meanwhile report what the promisor of a liability says of its job, and whether it is present."""
    if on_progress is nothing:
        yield
        return
    job = FollowedJob(liability.promisor, on_progress)
    selector = event_selector(liability.promisor, liability.address)
    pump = Pump(parts.network.session, selector, job.read, capacity=REPORTS_WAITING, drops=parts.drops)
    async with pump as reports, Background() as tasks:
        tasks.start(job.report_all(reports), f"reports on {liability.address}")
        tasks.start(_report_presence(parts, liability.promisor, on_progress), f"presence of {liability.promisor}")
        yield


class FollowedJob:
    """What an agent reports about a job: `read` its samples, then `report_all` in the order of the phases."""

    def __init__(self, agent: str, on_progress: OnProgress) -> None:
        self._agent = agent
        self._on_progress = on_progress
        self._limiter = RateLimiter(per_sender=REPORTED)
        self._said: set[str] = set()

    def read(self, sample: zenoh.Sample) -> Progress | None:
        """What a sample says; None for what can't be read. On any thread."""
        try:
            key, payload = parse_key(str(sample.key_expr)), sample.payload.to_bytes()
            if isinstance(key, ProgressKey):
                playback = PlaybackPosition.decode(payload)
                return self._progress("playing", position=playback.position, total=playback.total)
            if isinstance(key, EventKey) and key.event == "ready":
                return self._progress("ready")
            if isinstance(key, EventKey) and key.event == "complete":
                liability = Liability.decode(payload)
                parse_cid(liability.result)
                return self._progress("result", code="" if liability.is_success else "failed", detail=liability.result)
        except AiraError as error:
            log.debug("an unreadable report on a job: %s", error)
        return None

    async def report_all(self, reports: Pump[Progress]) -> None:
        """Report what arrives: `ready` before the playback, and nothing after the result."""
        async for progress in reports:
            is_late = "result" in self._said or (progress.kind == "ready" and "ready" in self._said)
            if is_late or not self._limiter.allow(self._agent):
                continue
            if progress.kind == "playing" and "ready" not in self._said:
                self._report(self._progress("ready"))
            self._report(progress)

    def _report(self, progress: Progress) -> None:
        self._said.add(progress.kind)
        report(self._on_progress, progress)

    def _progress(self, kind: Kind, **fields: Any) -> Progress:
        return Progress(kind=kind, agent=self._agent, **fields)


async def _report_presence(parts: AgentComponents, agent: str, on_progress: OnProgress) -> None:
    """Report when an agent is gone, and when it is back. While this side has no router, nothing is known."""
    was_present, absences = True, 0
    while True:
        is_present = bool(await parts.channel.present("agent", agent))
        if parts.network.connected:
            absences = 0 if is_present else absences + 1
            if is_present != was_present and absences != 1:  # a link that broke may be restored at once
                was_present = is_present
                report(on_progress, Progress(kind="back" if is_present else "gone", agent=agent))
        await asyncio.sleep(PRESENCE_INTERVAL)
