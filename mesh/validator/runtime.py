"""A validator at work: it follows the chain and the market's Results, and works on the cases that name it."""

from __future__ import annotations

import asyncio
import logging
from contextlib import aclosing
from functools import partial
from typing import TYPE_CHECKING, Final

from mesh.chain import (
    Finalized,
    History,
    NewLiability,
    NoContracts,
    NodeUnreachable,
    NotALiability,
    Reorganisation,
    RequestRefused,
)
from mesh.log_context import log_event
from mesh.retry import Backoff
from mesh.role import Role
from mesh.telemetry.logs import LogService
from mesh.validator.cases import Cases
from mesh.validator.decisions import CaseJudge
from mesh.validator.publishing import Announcements, ReportService
from mesh.validator.status import ValidatorStatus
from mesh.validator.times import created_ns
from mesh.work.outbox import RESEND
from schemas import Result

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from contextlib import AsyncExitStack

    from mesh.chain import BlockEvents, ChainEvent
    from mesh.retry import RetryPolicy
    from mesh.telemetry.metrics import MetricFamily
    from mesh.validator.components import ValidatorComponents
    from schemas import Liability

log = logging.getLogger(__name__)

EARLY: Final = 1.0
"""Seconds after which another copy of a Result is accepted whose liability is not known yet."""
READ_AT_ONCE: Final = 8
"""Liabilities of earlier runs that are read at the same time."""


class ValidatorRuntime(Role):
    """`async with ValidatorRuntime(components) as runtime`, then `run`."""

    title = "validator"

    def __init__(self, parts: ValidatorComponents, *, resend: RetryPolicy = RESEND) -> None:
        self.parts = parts
        self.judge = CaseJudge(parts)
        self._resend = resend

    async def _open(self, stack: AsyncExitStack) -> None:
        parts = self.parts
        self.results = await stack.enter_async_context(parts.channel.subscribe(Result))
        self.announcements = await stack.enter_async_context(Announcements(parts))
        await stack.enter_async_context(ReportService(parts))
        self.status = ValidatorStatus(parts, self.judge, self.results)
        parts.services.offer("status", self.status.status)
        parts.services.offer("logs", LogService("validator", parts.signer.address).logs)
        parts.channel.announce("validator", parts.signer.address)

    async def _work(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            self.cases = Cases(self.parts, self.judge, tasks, resend=self._resend)
            await self._resume()
            tasks.create_task(self.judge.run(), name="validator judge")
            tasks.create_task(self._follow_chain(), name="validator listener")
            tasks.create_task(self._take_results(), name="validator results")
            tasks.create_task(self._send_on_return(), name="validator after network loss")
            self.parts.channel.watch_presence(lambda _provider: self.cases.send_again(), role="provider")

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics of its work."""
        return await self.status.measure()

    def health(self) -> Mapping[str, str]:
        """The state of each of its parts, as `aira status` shows it."""
        return self.status.health()

    async def _resume(self) -> None:
        """Continue with the cases of earlier runs, unless they ended meanwhile."""
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
                self.results.forget(result, after=EARLY)

    async def _send_on_return(self) -> None:
        async for _ in self.parts.network.changes():
            if self.parts.network.connected:
                self.cases.send_again()

    async def _follow_chain(self) -> None:
        """Read the chain until cancelled, through outages of the node. Raises `ChainWentBack`."""
        chain, outages = self.parts.chain, self.parts.outages
        backoff = Backoff(chain.node.timing.outage_retry)
        while True:
            cursor, history = await self._position()
            try:
                blocks = chain.follow(cursor, history=history, parties=(), outages=outages)
                async with aclosing(blocks):
                    async for block in blocks:
                        await self._take_block(block, history)
                        backoff.reset()
            except (NodeUnreachable, RequestRefused, NotALiability, NoContracts) as error:
                # A liability can't be read. If a reorganisation took it away, that is what comes next.
                outages.failed(error, f"the chain can't be read on from block {cursor}")
                await backoff.wait()

    async def _position(self) -> tuple[int, History]:
        """The first block to read, and the history of those before it."""
        depth = self.parts.chain.node.timing.reorg_depth
        last, encoded = await self.parts.ledger.cursor()
        assert last is not None, "the validator's components set it"
        history = History.decode(encoded) if encoded else History(depth)
        history.depth = depth  # the setting may have changed
        self.parts.chain_head.begin_after(last)
        return last + 1, history

    async def _take_block(self, block: BlockEvents, history: History) -> None:
        ledger = self.parts.ledger
        if isinstance(block, Reorganisation):
            facts = log_event("chain-reorganised", block=block.block_number, events=len(block.reverted_events))
            log.warning("the chain replaced all blocks after %d", block.block_number, extra=facts)
            for event in block.reverted_events:
                await self._revert(event)
        if block.events:
            # If it is handled only in part, and replaced before the validator is back, it is reverted like others.
            await ledger.set_cursor(block.block_number - 1, history=history.encode())
            await self._take_created(block)
            for event in block.events:
                if isinstance(event, Finalized):
                    await self.cases.end(event.liability, success=event.success)
        await ledger.set_cursor(block.block_number, history=history.encode())
        self.parts.chain_head.advance_to(block.block_number)

    async def _take_created(self, block: BlockEvents) -> None:
        """Open a case for each new liability that names this validator."""
        created = [event.liability for event in block.events if isinstance(event, NewLiability)]
        named = [one for one in await self._read(created) if not one.is_finalized and self._is_named(one)]
        if named:
            since_ns = await created_ns(self.parts.chain, block.block_number)
            for liability in named:
                await self.cases.open(liability, since_ns=since_ns)

    async def _read(self, created: Sequence[str]) -> list[Liability]:
        if not created:
            return []
        read = partial(self.parts.chain.liabilities.get_all_with_orders, created)
        return [liability for liability, _ in await self.parts.chain.retrying(read, outages=self.parts.outages)]

    def _is_named(self, liability: Liability) -> bool:
        return liability.validator in self.parts.bench.validators and liability.lighthouse == self.parts.channel.address

    async def _revert(self, event: ChainEvent) -> None:
        match event:
            case NewLiability():
                await self.cases.set_aside(event.liability)
            case Finalized():
                await self.cases.reopen(event.liability)
