"""The cases of a validator: liabilities that name it, from the promisor's Result to the end on the chain.

Each case has a task. It waits for the Result, has it decided, signs in the ledger, and sends what it signed until the
chain has the end. The ledger keeps each step, so a restarted validator continues there.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from mesh.chain import NoContracts, NodeUnreachable, NotALiability, RequestRefused, Reverted
from mesh.content import StoreFull
from mesh.errors import ChainError
from mesh.flood import Rate, RateLimiter
from mesh.log_context import liability_context, log_event
from mesh.retry import Backoff, RetryPolicy
from mesh.validator.ledger import signed_result
from mesh.validator.times import arrived_ns
from mesh.work.outbox import RESEND
from schemas import ReportKey, Result, decode

if TYPE_CHECKING:
    from mesh.validator.components import ValidatorComponents
    from mesh.validator.decisions import CaseJudge
    from mesh.validator.ledger import StoredVerdict
    from schemas import Liability, Verified

log = logging.getLogger(__name__)

OPEN_CASES: Final = 4096
"""Cases that are open at once; liabilities beyond them are not judged."""
OPEN_OF_PROMISOR: Final = 512
"""The same for one promisor."""
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
        self,
        parts: ValidatorComponents,
        judge: CaseJudge,
        tasks: asyncio.TaskGroup,
        *,
        resend: RetryPolicy = RESEND,
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
        if len(self._open) >= OPEN_CASES or self._of_promisor[promisor] >= OPEN_OF_PROMISOR:
            self._parts.drops.count("cases", promisor)
            return
        case = OpenCase(await self._parts.ledger.open(liability, since_ns=since_ns))
        self._open[liability.address] = case
        self._of_promisor[promisor] += 1
        facts = log_event("case-opened", liability=liability.address, validator=liability.validator)
        log.info("it names this validator", extra=facts)
        case.task = self._tasks.create_task(self._work(case), name=f"case {liability.address}")

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
        report = decision.report
        signed = Result(liability=address, result=report.result, success=report.success)
        case.stored = await ledger.sign(signed, report=report.encode(), marks=decision.marks)
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
