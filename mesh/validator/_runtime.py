"""A validator at work: it follows the chain and the market's Results, works on the cases that name it, and answers how
it judges and how it judged."""

from __future__ import annotations

import asyncio
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import zenoh

from mesh.base.background import Background
from mesh.base.flood import Rate
from mesh.base.lifecycle import Lifecycle
from mesh.chain import Finalized, NewLiability, NoContracts, NotALiability
from mesh.network.services import answering
from mesh.role.following import follow_chain
from mesh.role.program import RESEND
from mesh.role.status import RoleStatus
from mesh.telemetry.logs import LogService
from mesh.telemetry.metrics import by_label, counter
from mesh.validator._cases import CaseJudge, Cases, created_ns
from mesh.validator.components import ValidatorComponents
from schemas import ReportKey, Result, parse_address
from schemas.keys import LIABILITY, ValidatorKey, market_selector
from schemas.status import StoreUse, ValidationStatus
from schemas.verdicts import ValidatorAnnouncement

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator
    from contextlib import AbstractAsyncContextManager, AsyncExitStack

    from mesh.base.retry import RetryPolicy
    from mesh.chain import ChainEvent
    from mesh.role.following import Created
    from mesh.telemetry.metrics import MetricFamily
    from schemas import Liability

ANSWERS: Final = Rate(per_second=100.0, burst=1000)
"""Answers to queries of a kind."""
REFRESH: Final = 600.0
"""Seconds after which an announcement is signed again: parties ignore old ones."""


class Announcements:
    """The signed announcements of a validator, one for each of the addresses that it judges for.

    An announcement is signed again when it is older than `refresh` seconds. `clock` is the time of day in seconds.
    """

    refresh: float = REFRESH
    """Seconds."""

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


READ_AT_ONCE: Final = 8
"""Liabilities of earlier runs that are read at the same time."""


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
        """What it does until it is cancelled."""
        yield "validator judge", self.judge.run()
        yield "validator listener", self._follow_chain()
        yield "validator results", self._take_results()
        yield "validator after network loss", self._send_on_return()

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics of its work."""
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
        unended = await self.parts.ledger.unended()
        for start in range(0, len(unended), READ_AT_ONCE):
            some = unended[start : start + READ_AT_ONCE]
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
