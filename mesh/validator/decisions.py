"""How a case is decided: its files are fetched, its recording is judged, and the juror reports what it found.

Files and time are shared fairly: one promisor's cases can't keep those of others waiting, whatever they consist of.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple
from weakref import WeakValueDictionary

from mesh.amounts import XRT
from mesh.chain import NoContracts, NotALiability, NotOffered
from mesh.content import ContentCorrupt, ContentTooLarge, ContentUnavailable, StoreFull
from mesh.flood import BoundedDict, FairQueue
from mesh.log_context import log_event
from mesh.recording import Limits
from mesh.retry import Backoff, RetryPolicy
from mesh.validator.judging import Case, Judgement, judge
from mesh.validator.policies import COMPLETE
from mesh.work.models import Models
from mesh.work.registration import in_daemon_thread
from schemas import Result, decode
from schemas.model import InvalidDescription
from schemas.verdicts import ReportFinding, ValidatorReport

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.validator.components import ValidatorComponents
    from mesh.validator.ledger import StoredVerdict
    from schemas import Liability
    from schemas.model import ModelDescription

log = logging.getLogger(__name__)

FETCHES: Final = 16
"""Cases whose files are fetched at once."""
FETCHES_OF_PROMISOR: Final = 4
"""The same for one promisor: files that nobody serves must not delay the cases of others."""
FETCH_SECONDS: Final = 600.0
"""The most seconds of one attempt to fetch; the next attempt continues where it ended."""
FETCH_AGAIN: Final = RetryPolicy(initial=1.0, ceiling=60.0)
"""How long to wait before files that nobody serves are looked for again."""
JUDGED_OF_PROMISOR: Final = 512
"""Recordings of one promisor that wait to be judged."""
CLOCK_TOLERANCE: Final = 60 * 10**9
"""Nanoseconds by which the clocks of robot, chain and validator may differ."""


class Decision(NamedTuple):
    """The report on a case, and the marks that identify its recording if it is a success."""

    report: ValidatorReport
    marks: tuple[str, ...] = ()


class _Judging(NamedTuple):
    """A recording that waits to be judged."""

    case: Case
    objective: Path
    recording: Path
    outcome: asyncio.Future[Judgement | None]


class CaseJudge:
    """Decides the cases of a validator, one recording at a time: `run`, and `decide` for each case."""

    def __init__(self, parts: ValidatorComponents) -> None:
        self._parts = parts
        self._fetching = asyncio.Semaphore(FETCHES)
        self._fetching_of: WeakValueDictionary[str, asyncio.Semaphore] = WeakValueDictionary()
        self._waiting: FairQueue[_Judging] = FairQueue(
            per_sender=JUDGED_OF_PROMISOR, total=JUDGED_OF_PROMISOR * FETCHES
        )
        self._succeeded: BoundedDict[str, str] = BoundedDict(JUDGED_OF_PROMISOR * FETCHES)
        """The liabilities of successes by the marks of their recordings, before the ledger has them."""
        self._models = Models(parts.store, parts.exchange)
        self.verdicts: Counter[str] = Counter()
        """What was decided since the start: `success`, `no-success`; `none` for cases given up until a restart."""
        self.seconds = 0.0
        """Seconds that judging took since the start."""

    async def run(self) -> None:
        """Judge one recording after another, one of each promisor before the second of any, until cancelled."""
        while True:
            work = await self._waiting.get()
            if not work.outcome.done():
                await self._judge(work)

    def underpaid(self, liability: Liability) -> str:
        """Why the liability is not judged because of the fee that it pays; empty if it pays enough."""
        pays, asks = liability.validator_fee, self._parts.terms.fee
        if pays >= asks:
            return ""
        return f"not judged: the liability pays {XRT.show(pays)}, and this validator asks for {XRT.show(asks)}"

    async def decide(self, stored: StoredVerdict) -> Decision | None:
        """Decide a case whose Result has arrived.

        None if its files or the judgement never came, or if an own check took too long.
        """
        claim = decode(stored.result)
        assert isinstance(claim, Result)
        judgement = await self._judgement(stored, claim)
        if judgement is None:
            return None
        if not judgement.is_decided:
            policies = ", ".join(judgement.overdue)
            facts = log_event("case-not-judged", policies=policies)
            log.error("not judged until a restart: the check of %s took too long", policies, extra=facts)
            return None
        report = self._report(stored, claim, judgement)
        return Decision(report, judgement.marks if report.success else ())

    async def _judgement(self, stored: StoredVerdict, claim: Result) -> Judgement | None:
        """The judgement on a claim. A failure that is certain needs no files."""
        if not claim.success:
            return _failed(COMPLETE.name, "claimed", "the promisor does not claim success")
        if why := self.underpaid(stored.liability):
            return _failed("fee", "fee-too-low", why)
        try:
            files = await self._fetch(stored, claim.result)
        except ContentTooLarge as error:
            return _failed(COMPLETE.name, error.code, "a file is larger than this validator takes")
        return None if files is None else await self._judged_in_turn(stored, claim, *files)

    async def _judged_in_turn(
        self, stored: StoredVerdict, claim: Result, objective: Path, recording: Path
    ) -> Judgement | None:
        loop, address = asyncio.get_running_loop(), stored.liability.address
        case = Case(
            liability=stored.liability,
            claimed=claim.success,
            message=stored.result,
            since_ns=stored.since_ns - CLOCK_TOLERANCE,
            until_ns=stored.seen_ns + CLOCK_TOLERANCE,
            owner_of=lambda mark: asyncio.run_coroutine_threadsafe(self._owner_of(mark, address), loop).result(),
            model=await self._model(stored.liability.model),
            objective_cid=stored.liability.objective,
            recording_cid=claim.result,
        )
        outcome: asyncio.Future[Judgement | None] = loop.create_future()
        if self._waiting.put(stored.liability.promisor, _Judging(case, objective, recording, outcome)):
            self._parts.drops.count("judgements", stored.liability.promisor)
            return None
        return await outcome

    async def _owner_of(self, mark: str, liability: str) -> str:
        """Another liability that a recording with this mark succeeded for; its verdict may not be signed yet."""
        owner = self._succeeded.get(mark, liability)
        return await self._parts.ledger.owner_of(mark, other_than=liability) if owner == liability else owner

    async def _model(self, cid: str) -> ModelDescription | None:
        with suppress(InvalidDescription):
            return await self._models.find(cid)
        return None

    async def _judge(self, work: _Judging) -> None:
        settings, began, found = self._parts.settings, time.monotonic(), None
        judge_in_thread = partial(
            judge,
            work.case,
            objective=work.objective,
            recording=work.recording,
            policies=self._parts.terms.policies,
            limits=Limits(size=settings.objective_size_limit, expanded=settings.objective_expanded_limit),
        )
        address = work.case.liability.address
        try:
            found = await in_daemon_thread(judge_in_thread)
        except Exception as error:
            facts = log_event("judging-failed", liability=address, error=type(error).__name__)
            log.exception("judging failed; the liability is judged again after a restart", extra=facts)
        self.seconds += time.monotonic() - began
        if found is not None and found.success:
            for mark in found.marks:
                self._succeeded[mark] = address
        if not work.outcome.done():
            work.outcome.set_result(found)

    async def _fetch(self, stored: StoredVerdict, recording: str) -> tuple[Path, Path] | None:
        """The files of objective and recording; None if nobody served them until the liability can be refunded.

        Raises `ContentTooLarge`.
        """
        liability, backoff = stored.liability, Backoff(FETCH_AGAIN)
        until = await self._refundable_from(liability.address)
        of_promisor = self._fetching_of.setdefault(liability.promisor, asyncio.Semaphore(FETCHES_OF_PROMISOR))
        while True:
            try:
                async with of_promisor, self._fetching, asyncio.timeout(FETCH_SECONDS):
                    return (
                        await self._file(liability.objective, liability.address),
                        await self._file(recording, liability.address),
                    )
            except (ContentUnavailable, ContentCorrupt, StoreFull, TimeoutError) as error:
                if until is not None and self._parts.chain_head.head >= until:
                    facts = log_event("files-missing", error=type(error).__name__)
                    log.warning("not judged, it can be refunded now: %s", error, extra=facts)
                    return None
                level = logging.WARNING if not backoff.failures else logging.DEBUG
                log.log(level, "looking for the files again: %s", error, extra=log_event("files-awaited"))
            await backoff.wait()

    async def _file(self, cid: str, label: str) -> Path:
        """A file from the store or from others, pinned with the label."""
        settings, store = self._parts.settings, self._parts.store
        await asyncio.to_thread(store.pin, cid, label, sync=False)
        limit, timeout = settings.objective_size_limit, settings.fetch_timeout
        return await self._parts.exchange.fetch(cid, size_limit=limit, timeout=timeout, sync=False)

    async def _refundable_from(self, address: str) -> int | None:
        """The block from which anybody may refund the liability; None if the contracts don't say."""
        chain = self._parts.chain
        with suppress(NotOffered, NotALiability, NoContracts):
            ask = partial(chain.liabilities.refundable_from, address)
            return await chain.retrying(ask, outages=self._parts.outages)
        return None

    def _report(self, stored: StoredVerdict, claim: Result, judgement: Judgement) -> ValidatorReport:
        signer = self._parts.signer
        return ValidatorReport(
            liability=stored.liability.address,
            objective=stored.liability.objective,
            result=claim.result,
            validator=stored.liability.validator,
            juror=signer.address,
            claimed=claim.success,
            success=claim.success and judgement.success,
            findings=judgement.findings,
            judged_at=int(time.time()),
        ).signed_by(signer)


def _failed(policy: str, code: str, detail: str) -> Judgement:
    """A judgement without a look into the recording."""
    finding = ReportFinding(policy=policy, code=code, holds=False, detail=detail)
    return Judgement(success=False, findings=(finding,))
