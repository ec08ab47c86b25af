"""A validator at work: it follows the chain and the market's Results, works on the cases that name it, and answers how
it judges and how it judged.

A case is a liability that names the validator, from the promisor's Result to the end on the chain. Each has a task. It
waits for the Result, has it decided (its files are fetched, its recording is judged, and the juror reports what it
found), signs in the ledger, and sends what it signed until the chain has the end. The ledger keeps each step, so a
restarted validator continues there. Files and time are shared fairly: one promisor's cases can't keep those of others
waiting, whatever they consist of.

Recordings must have been made between the liability and its Result, by the chain's clock and this machine's. If the two
differ, the longer time counts: a wrong clock of the validator must not fail honest work.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from weakref import WeakValueDictionary

import zenoh

from mesh.amounts import XRT
from mesh.base.background import Background, in_daemon_thread
from mesh.base.flood import BoundedDict, FairQueue, Rate, RateLimiter
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import liability_context, log_event
from mesh.base.retry import Backoff, RetryPolicy
from mesh.chain import (
    FeeTooHigh,
    Finalized,
    InsufficientFunds,
    NewLiability,
    NoContracts,
    NodeUnreachable,
    NotALiability,
    NotOffered,
    RequestRefused,
    Reverted,
)
from mesh.content import ContentCorrupt, ContentTooLarge, ContentUnavailable, StoreFull
from mesh.errors import ChainError
from mesh.network.services import answering
from mesh.recording import Limits
from mesh.role.composition import RoleParts, open_parts, opened_chain
from mesh.role.following import follow_chain
from mesh.role.models import Models
from mesh.role.program import RESEND, RoleStatus
from mesh.telemetry.logs import LogService
from mesh.telemetry.metrics import by_label, counter
from mesh.validator.judging import COMPLETE, Case, Judgement, judge
from mesh.validator.ledger import VERDICTS, VerdictLedger, signed_result
from schemas import ReportKey, Result, decode, parse_address
from schemas.keys import LIABILITY, ValidatorKey, market_selector
from schemas.model import InvalidDescription
from schemas.status import StoreUse, ValidationStatus
from schemas.verdicts import ReportFinding, ValidatorAnnouncement, ValidatorReport

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
    from contextlib import AbstractAsyncContextManager
    from pathlib import Path

    from mesh.base.flood import Drops
    from mesh.chain import Account, BlockHeader, Chain, ChainEvent
    from mesh.role.following import Created
    from mesh.settings import Settings
    from mesh.telemetry.metrics import MetricFamily
    from mesh.validator.judging import Policy
    from mesh.validator.ledger import StoredVerdict
    from schemas import Liability, Verified
    from schemas.model import ModelDescription

log = logging.getLogger(__name__)

LOOKBACK: Final = 50_400
"""Blocks that a validator reads at most of those before its start: after so many, liabilities can be refunded."""


@dataclass(frozen=True, kw_only=True)
class Court:
    """As what a validator judges: its account (generation 3) and, if it has one, its contract (generation 5).

    A result needs the signatures of `quorum` of the contract's `jurors`.
    """

    account: str
    contract: str = ""
    quorum: int = 1
    jurors: int = 1

    @property
    def validators(self) -> tuple[str, ...]:
        """The addresses that liabilities may name, the contract first."""
        return (self.contract, self.account) if self.contract else (self.account,)


@dataclass(frozen=True, kw_only=True)
class ValidatorComponents(RoleParts[VerdictLedger]):
    """The open components of a validator, and how it judges, for what least `fee` (wn)."""

    policies: Sequence[Policy]
    fee: int
    title: str
    court: Court


@asynccontextmanager
async def judging(
    settings: Settings,
    account: Account,
    chain: Chain | None,
    *,
    policies: Sequence[Policy],
    fee: int,
    title: str,
    drops: Drops,
) -> AsyncIterator[ValidatorComponents]:
    """The components of a validator on `chain` (open), or on the chain that the settings name.

    Raises `ChainError`, and the errors of opening what it needs.
    """
    async with AsyncExitStack() as stack:
        chain = await opened_chain(stack, settings, account, chain)
        court = await court_of(chain, account.address, settings.validator_contract)
        if not court.contract:
            await _introduce(chain, account.address)

        def ledger(folder: Path) -> VerdictLedger:
            return VerdictLedger(folder / VERDICTS, account.signer)

        shared = await open_parts(stack, settings, account, chain, ledger=ledger, drops=drops, lookback=LOOKBACK)
        yield ValidatorComponents(**vars(shared), policies=policies, fee=fee, title=title, court=court)


async def court_of(chain: Chain, account: str, contract: str) -> Court:
    """As what the account may judge, with the contract (ENS name or address) that the settings name, if any.

    Raises `ChainError` if it may not judge there.
    """
    if not contract:
        if not await chain.tokens.eth_balance():
            why = "%s has no ETH: it can't finalize liabilities that name the account itself"
            log.warning(why, account, extra=log_event("validator-without-eth", account=account))
        return Court(account=account)
    address = await chain.names.address(contract)
    why = ""
    if await chain.lighthouses.exists(address):
        why = "is a lighthouse, not a validator contract"
    elif not await chain.node.code(address):
        why = "has no code: it is not a validator contract"
    if why:
        hint = "create one with `aira validator deploy`, then pass its address with --validator-contract"
        raise ChainError(f"{address} {why}", hint=hint, code="not-a-validator")
    if not await chain.validators.accepts(address, account):
        hint = "create a contract that names this account: `aira validator deploy`"
        why = f"{account} is no juror of the validator contract {address}"
        raise ChainError(why, hint=hint, code="not-a-juror")
    jury = await chain.validators.jury(address)
    if jury is None:  # another contract with `isValidator`, to which one signature is enough
        return Court(account=account, contract=address)
    return Court(account=account, contract=address, quorum=jury.quorum, jurors=len(jury.jurors))


async def _introduce(chain: Chain, account: str) -> None:
    """Make the account known: orders name only accounts that have sent a transaction."""
    try:
        await chain.validators.introduce()
    except (InsufficientFunds, FeeTooHigh, RequestRefused) as error:
        facts = log_event("validator-not-known", account=account)
        log.warning("%s has sent no transaction yet, so nobody can name it: %s", account, error, extra=facts)


async def created_ns(chain: Chain, block: int) -> int:
    """When a block was made, in nanoseconds of Unix time, never in the future.

    The clock of a development chain may be ahead, because each block is a second later than the one before.
    """
    now, header, head = time.time_ns(), await _header(chain, block), await _header(chain, "latest")
    if header is None or head is None:
        return now
    ahead = max(0, head.timestamp * 10**9 - now)
    return min(now, header.timestamp * 10**9 - ahead)


async def arrived_ns(chain: Chain) -> int:
    """What time it is now, in nanoseconds of Unix time: the later of the two clocks."""
    head = await _header(chain, "latest")
    return time.time_ns() if head is None else max(time.time_ns(), head.timestamp * 10**9)


async def _header(chain: Chain, block: int | str) -> BlockHeader | None:
    """A block; None if the node does not say."""
    with suppress(NodeUnreachable, RequestRefused):
        return await chain.node.header(block)
    return None


class CaseLimits(NamedTuple):
    """How many cases a validator works on."""

    open: int = 4096
    """Cases that are open at once; liabilities beyond them are not judged."""
    open_of_promisor: int = 512
    """The same for one promisor."""
    fetched: int = 16
    """Cases whose files are fetched at once."""
    waiting_of_promisor: int = 512
    """Recordings of one promisor that wait to be judged; of all, so many times those that are fetched at once."""


CASE_LIMITS: Final = CaseLimits()
CLOCK_TOLERANCE: Final = 60 * 10**9
"""Nanoseconds by which the clocks of robot, chain and validator may differ."""


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
        per_promisor = CASE_LIMITS.waiting_of_promisor
        total = per_promisor * CASE_LIMITS.fetched
        self._fetching = asyncio.Semaphore(CASE_LIMITS.fetched)
        self._fetching_of: WeakValueDictionary[str, asyncio.Semaphore] = WeakValueDictionary()
        self._waiting: FairQueue[_Judging] = FairQueue(per_sender=per_promisor, total=total)
        self._succeeded: BoundedDict[str, str] = BoundedDict(total)
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
        pays, asks = liability.validator_fee, self._parts.fee
        if pays >= asks:
            return ""
        return f"not judged: the liability pays {XRT.show(pays)}, and this validator asks for {XRT.show(asks)}"

    async def decide(self, stored: StoredVerdict) -> tuple[ValidatorReport, tuple[str, ...]] | None:
        """The report on a case whose Result has arrived, and the marks of its recording if it is a success.

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
        return report, judgement.marks if report.success else ()

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
            policies=self._parts.policies,
            bags=settings.validator_bags,
            limits=Limits.of(settings),
        )
        address = work.case.liability.address
        try:
            found = await asyncio.wrap_future(in_daemon_thread(judge_in_thread, "judge"))
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
        liability, backoff = stored.liability, Backoff(RetryPolicy(initial=1.0, ceiling=60.0))
        until = await self._refundable_from(liability.address)
        # of one promisor: files that nobody serves must not delay the cases of others
        of_promisor = self._fetching_of.setdefault(liability.promisor, asyncio.Semaphore(4))
        while True:
            try:
                async with of_promisor, self._fetching, asyncio.timeout(600.0):
                    return (
                        await self._file(liability.objective, liability.address),
                        await self._file(recording, liability.address),
                    )
            except (ContentUnavailable, ContentCorrupt, StoreFull, TimeoutError) as error:
                if until is not None and self._parts.chain_head.contract_block >= until:
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


RESEND_RATE: Final = Rate(per_second=50.0, burst=250)
"""Verdicts that are sent again, in all: strangers can appear as providers."""


@dataclass(eq=False)
class OpenCase:
    """A case at work. `changed` is set when its Result arrives, and when it should be sent again."""

    stored: StoredVerdict
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    task: asyncio.Task[None] | None = None
    is_settling: bool = False
    """Whether a transaction is being sent, which is never cancelled halfway."""
    has_ended: bool = False

    async def wait(self, seconds: float | None = None) -> bool:
        """Wait for a change, `seconds` at most; whether there was one."""
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self.changed.wait()
                self.changed.clear()
                return True
        return False


class Cases:
    """The open cases of a validator. `resend` is how often verdicts are sent again; `judge` decides them."""

    def __init__(
        self, parts: ValidatorComponents, judge: CaseJudge, tasks: Background, *, resend: RetryPolicy = RESEND
    ) -> None:
        self._parts = parts
        self._judge = judge
        self._tasks = tasks
        self._resend = resend
        self._open: dict[str, OpenCase] = {}
        self._of_promisor: Counter[str] = Counter()
        self._rate = RateLimiter(per_sender=RESEND_RATE)

    async def open(self, liability: Liability, *, since_ns: int) -> None:
        """A liability names this validator: begin, or continue with what the ledger has of it."""
        promisor = liability.promisor
        if liability.address in self._open:
            return
        if len(self._open) >= CASE_LIMITS.open or self._of_promisor[promisor] >= CASE_LIMITS.open_of_promisor:
            self._parts.drops.count("cases", promisor)
            return
        case = OpenCase(await self._parts.ledger.open(liability, since_ns=since_ns))
        self._open[liability.address] = case
        self._of_promisor[promisor] += 1
        facts = log_event("case-opened", liability=liability.address, validator=liability.validator)
        log.info("it names this validator", extra=facts)
        case.task = self._tasks.start(self._work(case), f"case {liability.address}")

    async def take(self, result: Verified[Result]) -> bool:
        """Take the Result of a case's promisor. False if no case waits for it: it may come before its liability."""
        case = self._open.get(result.message.liability)
        if case is None:
            return False
        address, ledger = case.stored.liability.address, self._parts.ledger
        is_promisors = result.signer == case.stored.liability.promisor
        if is_promisors and not case.stored.result:
            await ledger.take(address, result.message, seen_ns=await arrived_ns(self._parts.chain))
            case.stored = await ledger.verdict(address) or case.stored
            case.changed.set()
        return True

    async def end(self, liability: str, *, success: bool) -> None:
        """The chain has the end of a case."""
        if self._close(liability):
            await self._parts.ledger.end(liability)
            await asyncio.to_thread(self._parts.store.release, liability)
            facts = log_event("case-ended", liability=liability, success=success)
            log.info("it has ended: %s", "paid" if success else "refunded", extra=facts)

    async def reopen(self, liability: str) -> None:
        """A reorganisation reverted the end of a case: what was signed is sent again."""
        await self._parts.ledger.end(liability, ended=False)
        if (stored := await self._parts.ledger.verdict(liability)) is not None:
            log.warning("its end was reverted", extra=log_event("case-reopened", liability=liability))
            await self.open(stored.liability, since_ns=stored.since_ns)

    async def set_aside(self, liability: str) -> None:
        """A reorganisation reverted a case's liability; it may come back at the same address."""
        if self._close(liability):
            log.warning("the liability was reverted", extra=log_event("case-set-aside", liability=liability))
            await asyncio.to_thread(self._parts.store.release, liability)
        await self._parts.ledger.set_aside(liability)

    def send_again(self) -> None:
        """Send what is signed now: a provider appeared, or the network is back."""
        for case in self._open.values():
            case.changed.set()

    def _close(self, liability: str) -> bool:
        """Stop working on a case; False if it is not open."""
        case = self._open.pop(liability, None)
        if case is None or case.task is None:
            return False
        self._of_promisor[case.stored.liability.promisor] -= 1
        self._of_promisor += Counter()  # forgets zeros
        case.has_ended = True
        case.changed.set()
        if not case.is_settling:
            case.task.cancel()
        return True

    async def _work(self, case: OpenCase) -> None:
        """Do what is left to do for a case, until it ends."""
        address = case.stored.liability.address
        with liability_context(address):
            if not case.stored.signed and not await self._decide(case):
                return
            backoff = Backoff(self._resend)
            while not case.has_ended:
                if backoff.failures == 0 or self._rate.allow(""):
                    await self._send(case)
                if await case.wait(backoff.next_delay()):
                    backoff.reset()

    async def _decide(self, case: OpenCase) -> bool:
        """Sign what was decided. False if the case can't be decided."""
        ledger, address = self._parts.ledger, case.stored.liability.address
        if why := self._judge.underpaid(case.stored.liability):
            facts = log_event("case-underpaid", fee=case.stored.liability.validator_fee)
            log.warning("%s; its result will not count", why, extra=facts)
        while not case.stored.result:
            await case.wait()
        if (decision := await self._judge.decide(case.stored)) is None:
            self._judge.verdicts["none"] += 1
            return False
        report, marks = decision
        signed = Result(liability=address, result=report.result, success=report.success)
        case.stored = await ledger.sign(signed, report=report.encode(), marks=marks)
        self._judge.verdicts["success" if report.success else "no-success"] += 1
        codes = ",".join(finding.code for finding in report.failures)
        facts = log_event("verdict-signed", success=report.success, result=report.result, findings=codes)
        log.info("judged: %s", "success" if report.success else f"no success ({codes})", extra=facts)
        return True

    async def _send(self, case: OpenCase) -> None:
        """Send the report to both parties, and the verdict to the providers or, in generation 3, to the chain."""
        stored, channel = case.stored, self._parts.channel
        with suppress(StoreFull):
            await asyncio.to_thread(self._parts.store.put_bytes, stored.report, pin=stored.liability.address)
        for party in {stored.liability.promisee, stored.liability.promisor}:
            channel.put(str(ReportKey(channel.lighthouse, party)), stored.report)
        if stored.liability.validator != self._parts.signer.address:
            channel.publish(signed_result(stored))
            return
        case.is_settling = True
        try:
            await self._settle(stored)
        finally:
            case.is_settling = False

    async def _settle(self, stored: StoredVerdict) -> None:
        """Finalize a generation-3 liability, which names the account itself. One that has ended refuses it."""
        claim = decode(stored.result)
        assert isinstance(claim, Result)
        try:
            settled = await self._parts.chain.liabilities.validate(claim, agree=signed_result(stored).success)
        except (NodeUnreachable, RequestRefused, NotALiability, NoContracts) as error:
            log.debug("the verdict is sent to the chain again: %s", error)
        except Reverted as error:  # it has ended, which the chain's events will say
            log.info("the chain refuses the verdict: %s", error, extra=log_event("verdict-refused", code=error.code))
        except ChainError as error:
            log.warning("the verdict waits: %s", error, extra=log_event("verdict-waits", code=error.code))
        else:
            facts = log_event("verdict-settled", tx=settled.tx, gas=settled.gas_used)
            log.info("finalized, gas %d", settled.gas_used, extra=facts)


ANSWERS: Final = Rate(per_second=100.0, burst=1000)
"""Answers to queries of a kind."""


class Announcements:
    """The signed announcements of a validator, one for each of the addresses that it judges for.

    An announcement is signed again when it is older than `refresh` seconds. `clock` is the time of day in seconds.
    """

    refresh: float = 600.0
    """Seconds: parties ignore old announcements."""

    def __init__(self, parts: ValidatorComponents, *, clock: Callable[[], float] = time.time) -> None:
        self._parts = parts
        self._clock = clock
        self._signed: dict[str, ValidatorAnnouncement] = {}
        """By validator."""

    def announcement(self, validator: str) -> ValidatorAnnouncement:
        """The signed announcement for one of the addresses."""
        now, found = int(self._clock()), self._signed.get(validator)
        if found is None or not 0 <= now - found.made_at < self.refresh:
            found = self._signed[validator] = self._sign(validator, now)
        return found

    def answering(self, validator: str) -> AbstractAsyncContextManager[None]:
        """Meanwhile answer queries of `ValidatorKey` with the announcement for one of the addresses."""
        key = str(ValidatorKey(self._parts.channel.lighthouse, validator))

        async def answer(query: zenoh.Query) -> None:
            query.reply(key, self.announcement(validator).encode(), encoding="application/json")

        return answering(self._parts.network.session, key, answer, ANSWERS, self._parts.drops)

    def _sign(self, validator: str, now: int) -> ValidatorAnnouncement:
        parts, court, signer = self._parts, self._parts.court, self._parts.signer
        is_contract = validator == court.contract
        return ValidatorAnnouncement(
            validator=validator,
            juror=signer.address,
            title=parts.title,
            policies=tuple(policy.note for policy in parts.policies),
            fee=parts.fee,
            quorum=court.quorum if is_contract else 1,
            jurors=court.jurors if is_contract else 1,
            made_at=now,
        ).signed_by(signer)


def answering_reports(parts: ValidatorComponents) -> AbstractAsyncContextManager[None]:
    """Meanwhile answer queries of `ReportKey` for a liability (`?liability=ADDRESS`) with the report in the ledger."""

    async def answer(query: zenoh.Query) -> None:
        stored = await parts.ledger.verdict(parse_address(query.parameters.get(LIABILITY) or ""))
        if stored is None or not stored.report:
            return
        for party in {stored.liability.promisee, stored.liability.promisor}:
            key = str(ReportKey(parts.channel.lighthouse, party))
            if query.key_expr.intersects(zenoh.KeyExpr(key)):
                query.reply(key, stored.report, encoding="application/json")

    selector = market_selector(parts.channel.lighthouse, "report", "*")
    return answering(parts.network.session, selector, answer, ANSWERS, parts.drops)


class ValidatorStatus(RoleStatus[ValidatorComponents]):
    """The metrics, the health and the service `status` of a validator."""

    role = "validator"

    def __init__(self, parts: ValidatorComponents, judge: CaseJudge) -> None:
        super().__init__(parts)
        self._judge = judge

    async def _own_status(self, store: StoreUse) -> dict[str, Any]:
        parts = self.parts
        validation = ValidationStatus(
            validators=parts.court.validators,
            policies=tuple(policy.name for policy in parts.policies),
            fee=parts.fee,
            cases=await parts.ledger.stages(),
            store=store,
        )
        return {"validation": validation}

    async def _own_families(self) -> tuple[MetricFamily, ...]:
        verdicts = {"success": 0.0, "no-success": 0.0, "none": 0.0} | dict(self._judge.verdicts)
        stages = {stage: float(count) for stage, count in (await self.parts.ledger.stages()).items()}
        seconds = self._judge.seconds
        return (
            by_label("aira_validator_cases", "gauge", "Liabilities that name the validator, by stage", "stage", stages),
            by_label("aira_verdicts_total", "counter", "Cases that it decided or gave up", "verdict", verdicts),
            counter("aira_judging_seconds_total", "Seconds that judging recordings took", seconds),
        )


class ValidatorRuntime(Lifecycle):
    """A validator at work: `async with ValidatorRuntime(components) as runtime`, then its `tasks`."""

    title = "validator"

    def __init__(self, parts: ValidatorComponents, *, resend: RetryPolicy = RESEND) -> None:
        self.parts = parts
        self.judge = CaseJudge(parts)
        self.status = ValidatorStatus(parts, self.judge)
        self._resend = resend
        self._made: tuple[int, int] = (0, 0)
        """The last block in which a case began, and when it was made."""

    async def _open(self, stack: AsyncExitStack) -> None:
        parts = self.parts
        self.results = await stack.enter_async_context(parts.channel.subscribe(Result))
        self.announcements = Announcements(parts)
        for validator in parts.court.validators:
            await stack.enter_async_context(self.announcements.answering(validator))
        await stack.enter_async_context(answering_reports(parts))
        parts.services.offer("status", self.status.status)
        parts.services.offer("logs", LogService("validator", parts.signer.address).logs)
        parts.channel.announce("validator", parts.signer.address)
        self.cases = Cases(parts, self.judge, await stack.enter_async_context(Background()), resend=self._resend)

    def tasks(self) -> Iterator[tuple[str, Coroutine[Any, Any, object]]]:
        yield "validator judge", self.judge.run()
        yield "validator listener", self._follow_chain()
        yield "validator results", self._take_results()
        yield "validator after network loss", self._send_on_return()

    async def measure(self) -> tuple[MetricFamily, ...]:
        return await self.status.measure([self.results])

    async def _follow_chain(self) -> None:
        """Continue with the cases of earlier runs, then read the chain. Raises `ChainWentBack`."""
        parts = self.parts
        await self._resume()
        parts.channel.watch_presence(lambda _provider: self.cases.send_again(), role="provider")
        await follow_chain(self, parts.chain, parts.chain_head, parts.outages, store=parts.ledger)

    async def on_event(self, event: ChainEvent, created: Created | None, block: int) -> None:
        """Open a case for a new liability that names this validator; close one that has ended."""
        if created is not None and not created[0].is_finalized and self._is_named(created[0]):
            if self._made[0] != block:
                self._made = block, await created_ns(self.parts.chain, block)
            await self.cases.open(created[0], since_ns=self._made[1])
        elif isinstance(event, Finalized):
            await self.cases.end(event.liability, success=event.success)

    async def on_revert(self, event: ChainEvent) -> None:
        """Set the case of a liability aside that is gone; work again on one whose end is."""
        if isinstance(event, NewLiability):
            await self.cases.set_aside(event.liability)
        elif isinstance(event, Finalized):
            await self.cases.reopen(event.liability)

    async def on_reorganised(self, block: int) -> None:
        """Nothing else is reverted."""

    async def on_head(self, block: int) -> None:
        """Nothing depends on the number of the block."""

    async def _resume(self) -> None:
        """Take up the cases of earlier runs, unless they ended meanwhile."""
        unended, at_once = await self.parts.ledger.unended(), 8
        for start in range(0, len(unended), at_once):
            some = unended[start : start + at_once]
            records = await asyncio.gather(*(self._record(one.liability.address) for one in some))
            for stored, record in zip(some, records, strict=True):
                if record is None:
                    await self.parts.ledger.set_aside(stored.liability.address)
                elif record.is_finalized:
                    await self.parts.ledger.end(record.address)
                    await asyncio.to_thread(self.parts.store.release, record.address)
                else:
                    await self.cases.open(stored.liability, since_ns=stored.since_ns)

    async def _record(self, address: str) -> Liability | None:
        """The record of a liability; None if a reorganisation reverted it."""
        read = partial(self.parts.chain.liabilities.get, address)
        try:
            return await self.parts.chain.retrying(read, outages=self.parts.outages)
        except (NotALiability, NoContracts):
            return None

    async def _take_results(self) -> None:
        async for result in self.results:
            if not await self.cases.take(result):
                self.results.forget(result, after=1.0)  # its liability may not be known yet

    async def _send_on_return(self) -> None:
        async for _ in self.parts.network.changes():
            if self.parts.network.connected:
                self.cases.send_again()

    def _is_named(self, liability: Liability) -> bool:
        return liability.validator in self.parts.court.validators and liability.lighthouse == self.parts.channel.address
