"""What a contract's parties learn of its validator: the reports of its jurors, and that they are silent or disagree.

Jurors publish a report for each party, and answer queries for earlier ones. Anybody can sign one, so only those count
that are about a contract of ours and signed by a juror whom its validator accepts.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.agent.judged_contract import JudgedContract, judged_progress, verdict_words
from mesh.agent.progress import Progress, nothing, report
from mesh.agent.received import received
from mesh.agent.validators import accepted_of
from mesh.background import Background
from mesh.errors import AiraError
from mesh.flood import BoundedDict, Rate, RateLimiter
from mesh.log_context import liability_context, log_event
from mesh.role import Lifecycle
from mesh.watching.queries import query_all
from schemas import ZERO_ADDRESS, InvalidRecord, Result
from schemas.selectors import report_selector
from schemas.verdicts import LONGEST_REPORT, ValidatorReport

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine, Iterable
    from contextlib import AsyncExitStack

    import zenoh

    from mesh.agent.components import AgentComponents
    from mesh.agent.progress import OnProgress
    from mesh.chain import Chain
    from schemas import Liability

log = logging.getLogger(__name__)

REMEMBERED: Final = 1024
"""Contracts whose reports are remembered."""
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
        self._judged: BoundedDict[str, JudgedContract] = BoundedDict(REMEMBERED)
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
            channel = self._parts.channel
            asked = asked_reports(
                self._parts.network.session,
                channel.lighthouse,
                self._parts.chain,
                liability,
                timeout=channel.answer_timeout,
            )
            for found in await asked:
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
            report(on_progress, judged_progress(found, judged))

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
                    await asyncio.wait_for(changed.wait(), 0 if judged.is_split else self.silence)
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
        if not judged.add(report):
            return
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
    replies = await query_all(session, [selector], timeout=timeout)
    found = await asyncio.to_thread(_signed, replies, liability)
    return [found[juror] for juror in await accepted_of(chain, liability.validator, found)]


def _signed(replies: Iterable[zenoh.Reply], liability: Liability) -> dict[str, ValidatorReport]:
    """The signed reports on a liability among replies, the first of each juror."""
    found: dict[str, ValidatorReport] = {}
    for sample in (reply.ok for reply in replies if reply.ok is not None):
        if len(sample.payload) > LONGEST_REPORT:
            continue
        with suppress(InvalidRecord):
            one = ValidatorReport.decode(sample.payload.to_bytes())
            if one.juror not in found and is_about(one, liability) and one.is_signed:
                found[one.juror] = one
    return found
