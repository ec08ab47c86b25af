"""Contracts of an account: what is heard of them until they end, and the end.

`Progress` is what those see who wait: offers and declines, the contract, the playback, the result, the payment. Of a
contract that names a validator, `ContractReports` has what its jurors report, or that they are silent or disagree.
`WatchedContracts` are those whose end is waited for, also over a reorganisation.

Anybody can sign a record about an account's orders and contracts. So only those count that are about one of ours and
signed by who may say it: a juror whom the validator accepts, a provider with a stake, an agent that is present.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from contextlib import ExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, Protocol, TypeAlias, TypeVar

import msgspec

from mesh.agent.jobs import Reason, check_stop, read_reason
from mesh.agent.validators import accepted_of
from mesh.base.background import Background, call_in_loop
from mesh.base.flood import BoundedDict, FairQueue, Rate, RateLimiter
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import liability_context, log_event
from mesh.content import ContentUnavailable
from mesh.errors import AiraError, ClosedError
from mesh.network import Pump, PumpLimits, ServiceFailed, call
from mesh.network.services import declared
from mesh.watching.market import JobEvent, query_all, read_event, signed_answers
from schemas import (
    ZERO_ADDRESS,
    InvalidRecord,
    Liability,
    Offer,
    PlaybackPosition,
    Result,
    event_selector,
    market_selector,
)
from schemas.keys import report_selector
from schemas.rpc import Stopped
from schemas.signing import Decline, Rejection, SignedRecord, StopRequest
from schemas.verdicts import ValidatorReport

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Coroutine, Iterable
    from contextlib import AsyncExitStack
    from pathlib import Path

    import zenoh

    from mesh.agent.components import AgentComponents
    from mesh.chain import Chain
    from mesh.network import Subscription
    from schemas import Demand, Signer


log = logging.getLogger(__name__)

ENDED: Final = partial(ClosedError, "the agent has ended", hint="run it again: demands stay open until their deadline")
"""The error of those who wait for something when the agent ends."""

DROPPED: Final = {"reject": "rejections", "decline": "declines", "report": "reports"}
"""How those that were dropped are counted."""

S = TypeVar("S", bound=SignedRecord)


@asynccontextmanager
async def received(
    parts: AgentComponents,
    kind: Literal["reject", "decline", "report"],
    record: type[S],
    is_wanted: Callable[[S], bool],
    check: Callable[[S], Awaitable[None]],
) -> AsyncIterator[Callable[[], None]]:
    """Meanwhile call `check` with the signed records of a kind for this account that are wanted, one after the other.

    Yields the function that subscribes, to be called when the first one may come. `is_wanted` runs on any thread.
    """
    loop, session, queue = asyncio.get_running_loop(), parts.network.session, FairQueue[S](per_sender=16, total=64)

    def receive(sample: zenoh.Sample) -> None:
        try:
            statement = record.decode(sample.payload.to_bytes())
        except InvalidRecord as error:
            log.debug("an unreadable statement: %s", error)
            return
        if is_wanted(statement) and statement.is_signed:  # others cost no more than reading them
            call_in_loop(loop, put, statement)

    def put(statement: S) -> None:
        for dropped in queue.put(statement.signer, statement):
            parts.drops.count(DROPPED[kind], dropped.signer)

    async def check_all() -> None:
        while True:
            await check(await queue.get())

    with ExitStack() as subscription:
        async with Background() as tasks:
            is_subscribed = False

            def subscribe() -> None:
                nonlocal is_subscribed
                if not is_subscribed:
                    is_subscribed = True
                    selector = market_selector(parts.channel.lighthouse, kind, parts.signer.address)
                    subscription.enter_context(declared(session, session.declare_subscriber(selector, receive)))
                    tasks.start(check_all(), f"{kind}s")

            yield subscribe


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
    "late",
    "again",
    "given-up",
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
    - `gone`: `agent`, which has the contract, is not present any more; `back`: it is again. With the code `unseen` it
      was never seen: it may be of the legacy network, works there, and can't be watched from here.
    - `result`: `agent` has signed the result `detail` (CID); its code is `failed` if the job was not done.
    - `judged`: the juror `agent` of the contract's validator has judged, as the `position`-th of `total` needed alike;
      `code` is empty if the work counts, else that of the first reason; `detail` says so in words.
    - `unjudged`: the validator `agent` is `silent`, or its jurors `disagree` (the code): `position` of `total` needed
      have judged alike. `detail` says from which block the cost can be refunded.
    - `paid`, `refunded`: the contract has ended; `refunded` has the code and the detail of the failure.
    - `late`: `agent` did not begin within `detail` seconds, and was told to stop.
    - `again`: the job that `agent` did not do, for the reason `code` and `detail`, is ordered again, from another
      robot: attempt `position` of `total`.
    - `given-up`: after `agent` there is no other attempt; `code` and `detail` say why.

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
async def seen_offers(parts: AgentComponents, order: Demand | Offer, on_progress: OnProgress) -> AsyncIterator[None]:
    """Meanwhile report the offers of a demand's model and objective, also with other terms; equal ones once."""
    if on_progress is nothing or isinstance(order, Offer):
        yield
        return
    async with parts.channel.subscribe(Offer, model=order.model) as offers, Background() as tasks:
        tasks.start(_report_offers(parts, offers, order, on_progress), "offers seen")
        tasks.start(offers.recall(), "recall offers")
        yield


def stated(statement: Rejection | Decline) -> Progress:
    """The progress that a rejection or a decline is."""
    if isinstance(statement, Decline):
        return Progress(kind="declined", agent=statement.agent, code=statement.code, detail=statement.detail)
    return Progress(kind="rejected", agent=statement.provider, code=statement.reason, detail=statement.detail)


async def _report_offers(
    parts: AgentComponents, offers: Subscription[Offer], demand: Demand, on_progress: OnProgress
) -> None:
    seen: set[Progress] = set()
    async for offer in offers:
        said = _offered(offer.signer, offer.message, demand)
        if offer.message.objective == demand.objective and said not in seen and len(seen) < 64:
            seen.add(said)
            await parts.robots.find(offer.signer)  # for those who show its name
            report(on_progress, said)


def _offered(agent: str, offer: Offer, demand: Demand) -> Progress:
    for term in ("token", "cost", "validator"):
        if (wanted := getattr(offer, term)) != getattr(demand, term):
            return Progress(kind="offer", agent=agent, code=f"other-{term}", detail=str(wanted))
    return Progress(kind="offer", agent=agent)


@asynccontextmanager
async def followed_job(parts: AgentComponents, liability: Liability, on_progress: OnProgress) -> AsyncIterator[None]:
    """Meanwhile report what the promisor of a liability says of its job, and whether it is present."""
    if on_progress is nothing:
        yield
        return
    job = FollowedJob(liability.promisor, on_progress)
    selector = event_selector(liability.promisor, liability.address)
    pump = Pump(parts.network.session, selector, job.read, limits=PumpLimits(samples=64), drops=parts.drops)
    async with pump as reports, Background() as tasks:
        tasks.start(job.report_all(reports), f"reports on {liability.address}")
        tasks.start(job.recall(parts.network.session, selector), f"the phase of {liability.address}")
        tasks.start(_report_presence(parts, liability.promisor, on_progress), f"presence of {liability.promisor}")
        yield


class FollowedJob:
    """What an agent reports about a job: `read` its samples, then `report_all` in the order of the phases."""

    def __init__(self, agent: str, on_progress: OnProgress) -> None:
        self._agent = agent
        self._on_progress = on_progress
        self._limiter = RateLimiter(per_sender=Rate(per_second=4.0, burst=16))
        self._said: set[str] = set()

    def read(self, sample: zenoh.Sample) -> Progress | None:
        """What a sample says; None for what can't be read. On any thread."""
        try:
            payload = sample.payload.to_bytes()
            match read_event(str(sample.key_expr), payload):
                case None:
                    playback = PlaybackPosition.decode(payload)
                    return self._progress("playing", position=playback.position, total=playback.total)
                case JobEvent(_, "ready"):
                    return self._progress("ready")
                case JobEvent(_, "complete", liability) if liability.result:
                    code = "" if liability.is_success else "failed"
                    return self._progress("result", code=code, detail=liability.result)
        except AiraError as error:
            log.debug("an unreadable report on a job: %s", error)
        return None

    async def recall(self, session: zenoh.Session, selector: str) -> None:
        """Ask the agent for the present phase, which it published before somebody listened here."""
        for reply in await query_all(session, [selector]):
            if reply.ok is not None and (progress := self.read(reply.ok)) is not None:
                self._take(progress)

    async def report_all(self, reports: Pump[Progress]) -> None:
        """Report what arrives: `ready` before the playback, and nothing after the result."""
        async for progress in reports:
            self._take(progress)

    def _take(self, progress: Progress) -> None:
        is_late = "result" in self._said or (progress.kind == "ready" and "ready" in self._said)
        if is_late or not self._limiter.allow(self._agent):
            return
        if progress.kind == "playing" and "ready" not in self._said:
            self._report(self._progress("ready"))
        self._report(progress)

    def _report(self, progress: Progress) -> None:
        self._said.add(progress.kind)
        report(self._on_progress, progress)

    def _progress(self, kind: Kind, **fields: Any) -> Progress:
        return Progress(kind=kind, agent=self._agent, **fields)


async def _report_presence(parts: AgentComponents, agent: str, on_progress: OnProgress) -> None:
    """Report when an agent is gone, and when it is back, or that it was never seen.

    While this side has no router, nothing is known.
    """
    was_present, was_seen, absences = True, False, 0
    while True:
        is_present = bool(await parts.channel.present("agent", agent))
        if parts.network.connected:
            absences = 0 if is_present else absences + 1
            if is_present != was_present and absences != 1:  # a link that broke may be restored at once
                was_present = is_present
                kind: Kind = "back" if is_present else "gone"
                report(on_progress, Progress(kind=kind, agent=agent, code="" if was_seen or is_present else "unseen"))
            was_seen = was_seen or is_present
        await asyncio.sleep(2.0)


@dataclass(eq=False)
class JudgedContract:
    """A liability that names a validator, and what is known of its verdict."""

    liability: Liability
    reports: dict[str, ValidatorReport] = field(default_factory=dict)
    """The first report of each juror."""
    listeners: list[Callable[[ValidatorReport], object]] = field(default_factory=list)
    quorum: int = 0
    """How many jurors must judge alike; 0 until it was read."""
    jurors: int = 0

    def votes(self, *, success: bool) -> int:
        """How many jurors have judged so."""
        return sum(report.success is success for report in self.reports.values())

    @property
    def agreed(self) -> int:
        """The most jurors that have judged alike."""
        return max(self.votes(success=True), self.votes(success=False))

    @property
    def is_judged(self) -> bool:
        """Whether enough jurors have judged alike: a provider, or the juror itself, ends the contract."""
        return 0 < self.quorum <= self.agreed

    @property
    def is_split(self) -> bool:
        """Whether the jurors that have not judged yet can't bring either verdict to the quorum."""
        return self.agreed + self.jurors - len(self.reports) < self.quorum


def verdict_words(report: ValidatorReport) -> str:
    """How a juror judged, and why, in one line. The reasons are the juror's own words."""
    if report.success:
        return "the work counts"
    return f"the work does not count: {_reasons(report, with_codes=True)}"


def refusal(reports: Iterable[ValidatorReport]) -> tuple[str, str] | None:
    """Why a juror refused work that the promisor claims to have done: a line of text, and its first code."""
    refused = next((one for one in reports if one.claimed and not one.success), None)
    if refused is None:
        return None
    return f"the validator judged that the work does not count: {_reasons(refused)}", code_of(refused)


def _reasons(report: ValidatorReport, *, with_codes: bool = False) -> str:
    found = [
        f"{one.detail} ({one.code})" if with_codes and one.detail else one.detail or one.code for one in report.failures
    ]
    return "; ".join(found) or ("no reason is given" if report.claimed else "the promisor claims no success")


def code_of(report: ValidatorReport) -> str:
    """The code of the first reason why the work does not count; empty if it counts."""
    return "" if report.success else next((one.code for one in report.failures), "not-done")


PER_JUROR: Final = Rate(per_second=1.0, burst=16)
"""Reports of one juror that are looked at; each may be a question to the chain."""
LOOKED_AT: Final = Rate(per_second=20.0, burst=200)
"""Reports in all that are looked at."""


class ContractReports(Lifecycle):
    """The reports on the validated contracts of an account: `async with ContractReports(parts) as reports`.

    It subscribes with the first such contract. Each verified report is logged, and given to `on_report` once. Before it
    is open it only remembers contracts.
    """

    title = "reports"
    silence: float = 30.0
    """Seconds without a verdict after which those who wait hear that the validator is silent."""

    def __init__(
        self, parts: AgentComponents, on_report: Callable[[ValidatorReport], Coroutine[Any, Any, None]] | None = None
    ) -> None:
        self._parts = parts
        self._on_report = on_report
        self._judged: BoundedDict[str, JudgedContract] = BoundedDict(1024)
        self._limiter = RateLimiter(per_sender=PER_JUROR, total=LOOKED_AT)

    async def _open(self, stack: AsyncExitStack) -> None:
        taking = received(self._parts, "report", ValidatorReport, self._is_wanted, self._check)
        self._subscribe = await stack.enter_async_context(taking)
        self._tasks = await stack.enter_async_context(Background())

    def follow(self, liability: Liability) -> None:
        """Hear the reports on a contract of the account from now on, and ask for earlier ones, if it names a validator.

        The reports on contracts of others are only asked for.
        """
        if liability.validator == ZERO_ADDRESS or liability.address in self._judged:
            return
        self._judged[liability.address] = JudgedContract(liability)
        if self.is_open and self._parts.signer.address in (liability.promisee, liability.promisor):
            self._subscribe()
            if not liability.is_finalized:
                self._tasks.start(self._ask_once(liability), f"reports on {liability.address}")

    async def of(self, liability: Liability) -> tuple[ValidatorReport, ...]:
        """The verified reports on a liability, by juror; those that were missed are asked for. Raises `ChainError`."""
        self.follow(liability)
        if (judged := self._judged.get(liability.address)) is None:
            return ()
        await self._read_jury(judged)
        if not judged.is_judged:
            channel, session = self._parts.channel, self._parts.network.session
            ask = partial(asked_reports, session, channel.lighthouse, self._parts.chain, liability)
            for found in await ask(timeout=channel.answer_timeout):
                self._add(judged, found)
        return self.known(liability.address)

    def known(self, address: str) -> tuple[ValidatorReport, ...]:
        """The reports on the contract at `address` that have come so far, by juror."""
        judged = self._judged.get(address)
        return () if judged is None else tuple(judged.reports[juror] for juror in sorted(judged.reports))

    @asynccontextmanager
    async def followed(self, liability: Liability, on_progress: OnProgress) -> AsyncIterator[None]:
        """Meanwhile report what the jurors of a contract say, or that they are silent or disagree."""
        if on_progress is nothing or liability.validator == ZERO_ADDRESS:
            yield
            return
        self.follow(liability)
        judged, changed = self._judged[liability.address], asyncio.Event()

        def judge(found: ValidatorReport) -> None:
            changed.set()
            progress = Progress(
                kind="judged",
                agent=found.juror,
                code=code_of(found),
                detail=verdict_words(found),
                position=judged.votes(success=found.success),
                total=judged.quorum,
            )
            report(on_progress, progress)

        for found in judged.reports.values():
            judge(found)
        judged.listeners.append(judge)
        try:
            async with Background() as tasks:
                tasks.start(self._report_silence(judged, changed, on_progress), f"verdict on {liability.address}")
                tasks.start(self._hear_result(liability, changed), f"result for {liability.address}")
                yield
        finally:
            judged.listeners.remove(judge)

    async def _hear_result(self, liability: Liability, changed: asyncio.Event) -> None:
        """Note that the promisor has signed its result, which it sends again until the contract ends."""
        async with self._parts.channel.subscribe(Result) as results:
            async for result in results:
                if result.message.liability == liability.address and result.signer == liability.promisor:
                    changed.set()
                    return

    async def _report_silence(self, judged: JudgedContract, changed: asyncio.Event, on_progress: OnProgress) -> None:
        """Say that jurors are silent, or can't agree any more, after the result or a report, once for each state."""
        while True:
            await changed.wait()
            while changed.is_set():
                changed.clear()
                with suppress(TimeoutError):
                    async with asyncio.timeout(0 if judged.is_split else self.silence):
                        await changed.wait()
            with suppress(AiraError):  # the node is away: the next state is said
                await self.of(judged.liability)
                if judged.is_judged:
                    return
                if not changed.is_set():
                    report(on_progress, await self._unjudged(judged))

    async def _unjudged(self, judged: JudgedContract) -> Progress:
        refund = await refund_words(self._parts.chain, judged.liability.address)
        said = f"{judged.agreed} of {judged.quorum} needed jurors has judged"
        if judged.is_split:
            said = f"{judged.votes(success=True)} for and {judged.votes(success=False)} against, {judged.quorum} needed"
        return Progress(
            kind="unjudged",
            agent=judged.liability.validator,
            code="disagree" if judged.is_split else "silent",
            detail=f"{said}; {refund}",
            position=judged.agreed,
            total=judged.quorum,
        )

    async def _ask_once(self, liability: Liability) -> None:
        """Ask for what was missed while the account's agent was away."""
        with suppress(AiraError):
            await self.of(liability)

    async def _read_jury(self, judged: JudgedContract) -> None:
        if not judged.quorum:  # jurors and quorum of a contract never change
            jury = await self._parts.chain.validators.jury(judged.liability.validator)
            judged.quorum, judged.jurors = (1, 1) if jury is None else (jury.quorum, len(jury.jurors))

    def _is_wanted(self, report: ValidatorReport) -> bool:
        judged = self._judged.get(report.liability)
        return judged is not None and report.juror not in judged.reports and is_about(report, judged.liability)

    async def _check(self, report: ValidatorReport) -> None:
        if not self._limiter.allow(report.juror):
            self._parts.drops.count("reports", report.juror)
            return

        is_juror = await self._parts.chain.retrying(partial(self._is_juror, report), outages=self._parts.outages)
        judged = self._judged.get(report.liability)
        if is_juror and judged is not None:
            self._add(judged, report)
        else:
            self._parts.drops.count("reports", report.juror)

    async def _is_juror(self, report: ValidatorReport) -> bool:
        if (judged := self._judged.get(report.liability)) is not None:
            await self._read_jury(judged)
        return await self._parts.chain.validators.accepts(report.validator, report.juror)

    def _add(self, judged: JudgedContract, report: ValidatorReport) -> None:
        if report.juror in judged.reports:
            return
        judged.reports[report.juror] = report
        with liability_context(report.liability):
            codes = ",".join(finding.code for finding in report.failures)
            facts = log_event("result-judged", juror=report.juror, success=report.success, codes=codes)
            log.info("%s judged: %s", report.juror, verdict_words(report), extra=facts)
        for listener in judged.listeners:
            listener(report)
        if self._on_report is not None:
            self._tasks.start(self._on_report(report), "handlers of reports")


def is_about(report: ValidatorReport, liability: Liability) -> bool:
    """Whether a report is about this liability, its validator and its objective."""
    about = report.liability, report.validator, report.objective
    return about == (liability.address, liability.validator, liability.objective)


async def refund_words(chain: Chain, liability: str) -> str:
    """From when on the cost of a liability can be returned if nobody judges, for people."""
    from mesh.chain import NotOffered

    try:
        return f"refund possible from block {await chain.liabilities.refundable_from(liability):,}"
    except NotOffered:
        return "its contracts offer no refund"


async def asked_reports(
    session: zenoh.Session, lighthouse: str, chain: Chain, liability: Liability, *, timeout: float
) -> list[ValidatorReport]:
    """The verified reports on a liability that its jurors answer with in `timeout` seconds, one of each.

    Raises `ChainError`.
    """
    if liability.validator == ZERO_ADDRESS:
        return []
    selector = report_selector(lighthouse, liability.promisee, liability.address)
    found = await signed_answers(
        session, [selector], ValidatorReport, lambda report: is_about(report, liability), timeout=timeout
    )
    return [found[juror] for juror in await accepted_of(chain, liability.validator, found)]


class StopRequestPace(NamedTuple):
    """How a robot is asked to stop, in seconds."""

    within: float = 10.0
    """For which the request is repeated until the robot answers …"""
    again: float = 0.25
    """… after so many, if nobody answers, or the robot has too many requests."""


STOP_REQUEST_PACE: Final = StopRequestPace()
REASON_TIMEOUT: Final = 10.0
"""Seconds without a new block after which the recording of a failed job is given up, and with it the reason."""


class Outcome(msgspec.Struct, frozen=True, kw_only=True, repr_omit_defaults=True):
    """How a contract ended: `success` means that the promisor was paid; `result` is the recording's CID, or empty.

    If it failed, `reason` says why in a line of text and `code` for programs. They come from the promisor's recording,
    which may lie or be unavailable (`recording-unavailable`); without a result the code is `no-result`. If a validator
    has judged that the work does not count, they are its reason. `reports` has what its jurors reported.
    """

    success: bool
    result: str
    reason: str = ""
    code: str = ""
    reports: tuple[ValidatorReport, ...] = ()
    robot: str = ""
    """The robot that did the job, or should have: its address."""
    contract: str = ""
    """The contract's address."""
    earlier: tuple[Outcome, ...] = ()
    """How the attempts before it failed, the first one first, if it was ordered with `retry`."""


class LiabilityReverted(AiraError, code="liability-reverted"):
    """A reorganisation reverted the contract `liability`, and it was not created again by its orders' deadline."""

    def __init__(self, liability: str, deadline: int) -> None:
        super().__init__(
            f"a reorganisation reverted the contract {liability}, and it was not created again by block {deadline}",
            hint="it pays nobody; post a new order, unless another contract was created from its orders",
        )
        self.liability = liability
        self.deadline = deadline


class JobAttempts(Protocol):
    """The attempts at one job, as orders and contracts know them; `Attempts` are these."""

    number: str
    """What they have in common; see `Contract.number`."""
    order: str
    """The order (hash) for the next one, while it is no contract."""

    def ordered(self, order: str, deadline: int) -> None:
        """The first order, which is about to be posted: its hash, and the block until which it is valid."""

    async def run(self, first: Contract) -> None:
        """See a contract to its end, and those that follow it."""

    async def outcome(self, on_progress: OnProgress) -> Outcome:
        """Wait for the end of the last attempt."""

    async def call_off(self) -> None:
        """Order no more."""


async def request_stop(
    session: zenoh.Session, signer: Signer, liability: Liability, why: str, *, code: str | None = None
) -> Stopped:
    """Ask the promisor of a liability to stop its job, signed by `signer`; with a `code` it is handed back.

    Raises as `Contract.stop`.
    """
    check_stop(why, code)
    fields: dict[str, Any] = {"liability": liability.address, "why": why, "code": code or "", "time": int(time.time())}
    request = StopRequest(by=signer.address, **fields)
    return await send_stop(session, liability.promisor, request.signed_by(signer))


async def send_stop(session: zenoh.Session, robot: str, request: StopRequest) -> Stopped:
    """Send a signed request to the robot (address) until it answers. Raises `ServiceFailed` as `Contract.stop`."""
    until = time.monotonic() + STOP_REQUEST_PACE.within
    while True:
        left = max(until - time.monotonic(), 0.1)
        try:
            stopped: Stopped = await call(session, robot, "stop", request, timeout=left)
        except ServiceFailed as error:
            if error.reason == "agent-error" or left <= STOP_REQUEST_PACE.again:
                raise
            await asyncio.sleep(STOP_REQUEST_PACE.again)
        else:
            return stopped


class Contract:
    """A contract on the chain: `await contract.outcome()`, then `await contract.recording()`.

    Of a job that is ordered again when it fails (`retry`), it is the contract of the latest attempt.
    """

    def __init__(
        self, liability: Liability, ended: asyncio.Future[Outcome], parts: AgentComponents, reports: ContractReports
    ) -> None:
        self._liability = liability
        self._ended = ended
        self._parts = parts
        self._reports = reports
        self._failure: Reason | None = None
        self.attempts: JobAttempts | None = None
        """What it is one of, if its job is ordered again when it fails, or must begin in time."""
        self.following: Contract | None = None
        """That of the next attempt, after this one has failed."""

    def __repr__(self) -> str:
        liability, ended = self.liability, self._latest._ended
        state = "open"
        if ended.done():
            failed = ended.cancelled() or ended.exception() is not None
            state = "reverted" if failed else "paid" if ended.result().success else "refunded"
        parties = f"promisee={liability.promisee}, promisor={liability.promisor}"
        return f"Contract({self.address}, {state}, cost={liability.cost}, {parties})"

    @property
    def _latest(self) -> Contract:
        return self if self.following is None else self.following._latest

    @property
    def liability(self) -> Liability:
        """Its record, as it was when the contract was first read."""
        return self._latest._liability

    @property
    def address(self) -> str:
        """The contract's address (EIP-55)."""
        return self.liability.address

    @property
    def robot(self) -> str:
        """The robot that does the job: its address."""
        return self.liability.promisor

    @property
    def number(self) -> str:
        """What all attempts at a job have in common, 16 hexadecimal digits: the first of its first order's hash.

        Empty for a contract that this program has not ordered with `retry` or `start_within`.
        """
        return "" if self.attempts is None else self.attempts.number

    @property
    def order(self) -> str:
        """The order (hash) for the next attempt at the job, after this one has failed, while it is no contract."""
        return "" if self.attempts is None else self.attempts.order

    def recreated(self, liability: Liability) -> None:
        """It was created again after a reorganisation."""
        self._liability = liability

    async def outcome(self, *, on_progress: OnProgress = nothing) -> Outcome:
        """Wait until the contract is finalized; with `retry`, until that of the last attempt is.

        Cancelling the wait changes nothing. `on_progress` is called with what the promisor says of the job meanwhile,
        and with the end.

        Raises `ClosedError` if the agent ends first, and `LiabilityReverted` if a reorganisation reverted the contract
        and it was not created again by its orders' deadline.

        Of a job that failed it fetches the recording, for at most `REASON_TIMEOUT`, and reads the reason.
        """
        if self.attempts is None:
            return await self.end(on_progress)
        return await self.attempts.outcome(on_progress)

    async def end(self, on_progress: OnProgress = nothing) -> Outcome:
        """The same for this contract alone, whatever follows it."""
        liability = self._liability
        async with self._reports.followed(liability, on_progress), followed_job(self._parts, liability, on_progress):
            ended, liability = await asyncio.shield(self._ended), self._liability
            facts: dict[str, Any] = {"robot": liability.promisor, "contract": liability.address}
            ended = msgspec.structs.replace(ended, reports=await self._last_reports(), **facts)
        if not ended.success:
            if self._failure is None:
                self._failure = await self._reason(ended)
            ended = msgspec.structs.replace(ended, reason=self._failure.text, code=self._failure.code)
        kind: Literal["paid", "refunded"] = "paid" if ended.success else "refunded"
        report(on_progress, Progress(kind=kind, agent=liability.promisor, code=ended.code, detail=ended.reason))
        return ended

    async def stop(self, why: str = "") -> Stopped:
        """Stop the job for good, as its customer or its robot; returns what the robot's devices say.

        `why`, at most 200 characters, is for people and becomes public with the recording. The robot's handlers are
        cancelled; `outcome` then waits for the end, whose code is `stopped`. What it costs is in the model's
        description (`on_stop`); a job that had not begun costs nothing. To stop it again changes nothing. After
        that a job with `retry` is not ordered again.

        Raises `ServiceFailed`: `no-answer` if the robot does not answer in time, or is one of the legacy network, which
        can't be stopped; `service-failed` if it refuses, or the job has ended. Raises `InputError` for a `why` that is
        too long.
        """
        if self.attempts is not None:
            await self.attempts.call_off()
            if (ended := self._latest._ended).done() and not ended.exception() and not ended.result().success:
                return Stopped()  # between two attempts
        return await request_stop(self._parts.network.session, self._parts.signer, self.liability, why)

    async def reports(self) -> tuple[ValidatorReport, ...]:
        """What the jurors of its validator have reported until now, each report signed and by a juror, one of each.

        Jurors are asked for what this agent missed. Empty if the contract names no validator. Raises `ChainError`.
        """
        return await self._reports.of(self.liability)

    async def recording(self) -> Path:
        """Wait for the outcome, and fetch the result's recording, every block of it checked.

        Raises a `ContentError` if the recording is unavailable or the contract was refunded without a result.
        """
        ended = await asyncio.shield(self._latest._ended)
        if not ended.result:
            raise ContentUnavailable("the recording", f"contract {self.address} was refunded without a result")
        return await self._fetch(ended.result, self._parts.settings.fetch_timeout)

    async def _fetch(self, cid: str, timeout: float) -> Path:
        limit = self._parts.settings.objective_expanded_limit
        return await self._parts.exchange.fetch(cid, size_limit=limit, timeout=timeout)

    async def _last_reports(self) -> tuple[ValidatorReport, ...]:
        """The reports at the end; those that are known if the node is away."""
        try:
            return await self._reports.of(self._liability)
        except AiraError as error:
            log.debug("the reports are not asked for: %s", error)
            return self._reports.known(self._liability.address)

    async def _reason(self, ended: Outcome) -> Reason:
        """Why the job failed, as its validator or its recording says."""
        refused = refusal(ended.reports)
        if not ended.result and self._liability.validator != ZERO_ADDRESS:
            return Reason("no result, or no verdict of the validator, came in time", "no-result")
        if not ended.result:
            return Reason("no result came in time", "no-result")
        if refused is not None:
            return Reason(*refused)
        try:
            timeout = min(REASON_TIMEOUT, self._parts.settings.fetch_timeout)
            return await asyncio.to_thread(read_reason, await self._fetch(ended.result, timeout))
        except AiraError as error:
            return Reason(f"the recording, which says why, is not available: {error}", "recording-unavailable")


@dataclass
class _WatchedContract:
    """A contract whose end somebody may wait for."""

    ended: asyncio.Future[Outcome]
    order: str = ""
    """The order of ours (hash) that it was created from, if any, and what those hold who waited for it."""
    contract: Contract | None = None
    outcome: Outcome | None = None
    """How it has ended, while the block of its end does not count yet."""
    ended_in: int = 0
    """That block."""
    reverted_until: int | None = None
    """While a reorganisation has reverted it: the block by which it must be created again."""


class WatchedContracts:
    """The contracts whose end is waited for, by address."""

    def __init__(self, parts: AgentComponents, reports: ContractReports) -> None:
        self._parts = parts
        self._reports = reports
        self._watched: dict[str, _WatchedContract] = {}

    def __len__(self) -> int:
        return len(self._watched)

    def __contains__(self, address: str) -> bool:
        return address in self._watched

    async def read(self, address: str) -> Contract:
        """The contract at `address` (or name), read from the chain. Raises `NotALiability`."""
        address = await self._parts.chain.names.address(address)
        is_new = address not in self._watched
        watched = self._watch(address)  # before it is read: it may end in between
        try:
            liability = await self._parts.chain.liabilities.get(address)
        except BaseException:
            if is_new:
                self._watched.pop(address, None)
            raise
        if watched.ended.done():
            return Contract(liability, watched.ended, self._parts, self._reports)
        contract = self.watch(liability)
        await self.settle()
        return contract

    def watch(self, liability: Liability, *, order: str = "") -> Contract:
        """The contract of `liability`, which was created from our `order` (lasting hash), if from any."""
        watched = self._watch(liability.address)
        contract = Contract(liability, watched.ended, self._parts, self._reports)
        self._reports.follow(liability)
        if order:
            watched.order, watched.contract = order, contract
        if liability.is_finalized:
            outcome = Outcome(success=liability.is_success, result=liability.result)
            self.finalized(liability.address, outcome, self._parts.chain_head.head)
        return contract

    def created(self, liability: Liability, order: str) -> Contract | None:
        """The contract exists, perhaps again. Returns the one that was watched before for our `order` (lasting hash).

        After a reorganisation the contract of an order may be at another address.
        """
        if (watched := self._watched.get(liability.address)) is not None:
            watched.reverted_until = None
        self._reports.follow(liability)
        again = next((one for one in self._watched.values() if order and one.order == order), None)
        if again is None or again.contract is None:
            return None
        again.reverted_until = None
        self._watched[liability.address] = self._watched.pop(again.contract.address)
        again.contract.recreated(liability)
        return again.contract

    def reverted(self, address: str, deadline: int) -> None:
        """A reorganisation reverted the contract at `address`, whose orders are valid until block `deadline`."""
        if address in self._watched:
            self._watched[address].reverted_until = deadline

    def finalized(self, address: str, outcome: Outcome, block: int) -> None:
        """The contract at `address` has ended in a block: `settle` tells it when that counts."""
        if address in self._watched:
            self._watched[address].outcome, self._watched[address].ended_in = outcome, block

    def end_reverted(self, address: str) -> None:
        """A reorganisation reverted the end of the contract at `address`."""
        if address in self._watched:
            self._watched[address].outcome = None

    async def settle(self) -> None:
        """Tell those who wait of the ends that count, as far as the chain was read. Raises `NodeUnreachable`."""
        if all(watched.outcome is None for watched in self._watched.values()):
            return
        counted = await self._parts.chain.node.counted(self._parts.chain_head.head)
        for address, watched in list(self._watched.items()):
            if watched.outcome is None or watched.ended_in > counted:
                continue
            del self._watched[address]
            if not watched.ended.done():
                facts = log_event("contract-ended", success=watched.outcome.success, result=watched.outcome.result)
                with liability_context(address):
                    log.info(
                        "the contract has ended, %s", "paid" if watched.outcome.success else "refunded", extra=facts
                    )
                watched.ended.set_result(watched.outcome)

    def expire(self, block: int) -> None:
        """The chain has `block`: reverted contracts whose orders' deadline has passed are given up."""
        for address, watched in list(self._watched.items()):
            if watched.reverted_until is not None and watched.reverted_until <= block:
                del self._watched[address]
                fail_future(watched.ended, LiabilityReverted(address, watched.reverted_until))

    def fail(self, error: Exception) -> None:
        for watched in self._watched.values():
            fail_future(watched.ended, error)

    def _watch(self, address: str) -> _WatchedContract:
        if address not in self._watched:
            self._watched[address] = _WatchedContract(asyncio.get_running_loop().create_future())
        return self._watched[address]


def fail_future(future: asyncio.Future[Any] | None, error: Exception) -> None:
    """Fail what somebody may be waiting for."""
    if future is not None and not future.done():
        future.set_exception(error)
        future.exception()  # marks it as retrieved: perhaps nobody waits
