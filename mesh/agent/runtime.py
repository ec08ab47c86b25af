"""An agent with an account at work: it listens to the chain, does its jobs, trades, and answers for them."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final

from mesh.agent.contract import Outcome
from mesh.agent.hooks import call
from mesh.agent.metrics import AgentMetrics
from mesh.agent.services import offer_services
from mesh.agent.status_service import StatusService
from mesh.agent.token_events import TokenEvents
from mesh.agent.trade import Trader
from mesh.telemetry.context import with_liability_context
from mesh.telemetry.logs import LogService
from mesh.work.executor import Executor
from mesh.work.liability_events import LiabilityEvents
from mesh.work.lifecycle import Phase
from mesh.work.listener import Listener
from mesh.work.outbox import result_identity
from mesh.work.startup_sync import settle_ended
from schemas.keys import EventKey, LiabilityEvent

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mesh.agent.components import AgentComponents
    from mesh.agent.hooks import Handler
    from mesh.chain import Approval, Transfer
    from mesh.network import Subscription
    from mesh.telemetry.metrics import MetricFamily
    from mesh.work.job import TopicHandler
    from schemas import Liability

log = logging.getLogger(__name__)

PUBLISHED: Final[dict[Phase, LiabilityEvent]] = {
    Phase.INCOMING: "incoming",
    Phase.READY: "ready",
    Phase.COMPLETE: "complete",
    Phase.FINALIZED: "finalized",
}
"""Phases that are told on the agent's keys, and what they are called there."""


class AgentRuntime:
    """The working side of an agent: `run` in a task; the listener's party, the executor's witness."""

    def __init__(self, parts: AgentComponents, *, performer: TopicHandler | None, witnesses: Sequence[Handler]) -> None:
        self.parts = parts
        self.trader = Trader(parts, parts.chain)
        workshop = parts.workshop()
        self.executor = Executor(workshop, performer=performer, witness=self._phase)
        self._dealings = LiabilityEvents(workshop, self.executor, witness=self._phase)
        self._witnesses = witnesses
        self._token_events = TokenEvents(parts.channel.put, parts.signer.address)
        offer_services(parts, self.executor, drives_itself=performer is not None)
        self._listener = Listener(
            parts.chain, parts.ledger, parts.signer.address, self, token=parts.settings.erc20_token
        )
        parts.services.offer("logs", LogService("agent", parts.signer.address).logs)
        self._status = StatusService(parts, self.executor, self._listener)
        self._figures = AgentMetrics(parts, workshop)
        parts.services.offer("status", self._status.status)

    async def run(self) -> None:
        """Work until cancelled."""
        try:
            async with asyncio.TaskGroup() as tasks:
                if self.parts.settings.enable_executor:
                    tasks.create_task(self._do_jobs(), name="executor")
                tasks.create_task(self.parts.outbox.run(), name="outbox")
                tasks.create_task(self._listener.run(), name="listener")
        finally:
            await self.trader.close()

    async def _do_jobs(self) -> None:
        """Do the jobs; first, those of the last time that ended meanwhile are done with."""
        await settle_ended(self.parts.chain, self.parts.ledger, self)
        await self.executor.run()

    async def measure(self, subscriptions: Sequence[Subscription[Any]]) -> tuple[MetricFamily, ...]:
        """The figures of its work, and of what it hears over `subscriptions`."""
        return await self._figures.measure(subscriptions)

    def health(self) -> Mapping[str, str]:
        """The state of each of its parts, as `aira status` shows it."""
        return self._status.parts()

    @with_liability_context
    async def new_liability(self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes) -> None:
        """A contract names us: trade it as a promisee, work for it as a promisor (an account may be both)."""
        await self.trader.matched(liability, demand_hash=demand_hash, offer_hash=offer_hash)
        if liability.promisor == self.parts.signer.address and self.parts.settings.enable_executor:
            await self._dealings.accept(liability)

    @with_liability_context
    async def finalized(self, address: str, *, success: bool, result: str) -> None:
        """A contract has ended, perhaps one of ours."""
        await self._dealings.finalized(address, success=success)
        await self.parts.outbox.settle(result_identity(address))  # of no job, but signed for somebody else
        self.trader.finalized(address, Outcome(success=success, result=result))

    @with_liability_context
    async def taken_back(self, address: str) -> None:
        """The end of a contract, perhaps one of ours, did not happen after all."""
        await self._dealings.taken_back(address)

    @with_liability_context
    async def unmade(self, address: str) -> None:
        """A contract, perhaps one of ours, was not made after all."""
        await self._dealings.unmade(address)
        await self.trader.unmade(address)

    async def token_event(self, event: Transfer | Approval) -> None:
        """Tokens changed hands, or may."""
        self._token_events.tell(event)

    async def token_event_taken_back(self, event: Transfer | Approval) -> None:
        """That did not happen after all, or not yet."""
        self._token_events.take_back(event)

    async def new_head(self, block: int) -> None:
        """The chain has grown."""
        self.parts.clock.pass_to(block)
        self.trader.passed(block)

    async def _phase(self, phase: Phase, liability: Liability) -> None:
        if phase in PUBLISHED:
            key = str(EventKey(self.parts.signer.address, liability.address, PUBLISHED[phase]))
            self.parts.channel.put(key, liability.encode())
        for witness in self._witnesses:
            await call(witness, phase, liability)
