"""An agent with an account at work: it reads the chain, does its jobs, trades, and offers its services."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from mesh.agent.declines import DeclinePublisher
from mesh.agent.demands import DemandDispatcher
from mesh.agent.handlers import call
from mesh.agent.late_results import LateResults
from mesh.agent.listener import ChainListener
from mesh.agent.reports import ContractReports
from mesh.agent.services import offer_services
from mesh.agent.status import AgentStatus
from mesh.agent.trade import Trader
from mesh.agent.validators import ValidatorDirectory
from mesh.chain import NotALiability
from mesh.role import Role
from mesh.telemetry.logs import LogService
from mesh.work.executor import Executor
from mesh.work.objectives import Objectives
from mesh.work.phases import UNFINISHED, Phase
from mesh.work.playbacks import Playbacks
from schemas import ZERO_ADDRESS, Demand, decode
from schemas.agent_keys import EventKey, LiabilityEvent

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from contextlib import AsyncExitStack

    from mesh.agent.components import AgentComponents
    from mesh.agent.handlers import Handler, Handlers
    from mesh.network import Subscription
    from mesh.telemetry.metrics import MetricFamily
    from mesh.work.models import Models
    from schemas import Liability
    from schemas.model import ModelDescription
    from schemas.verdicts import ValidatorReport

PUBLISHED: Final[dict[Phase, LiabilityEvent]] = {
    Phase.INCOMING: "incoming",
    Phase.READY: "ready",
    Phase.COMPLETE: "complete",
    Phase.FINALIZED: "finalized",
}
"""The phases that are published on the agent's keys, with their names there."""


class AgentRuntime(Role):
    """The working side of an agent: `async with AgentRuntime(components, handlers) as runtime`, then `run`."""

    title = "agent"

    def __init__(
        self,
        parts: AgentComponents,
        handlers: Handlers,
        models: Models,
        description: ModelDescription | None = None,
        *,
        model: str = "",
    ) -> None:
        topics = handlers.topics or None
        self.parts = parts
        self.models = models
        self.validators = ValidatorDirectory(parts.network.session, parts.channel, parts.chain)
        self.reports = ContractReports(parts, self._on_report if handlers.reports else None)
        self.trader = Trader(parts, self.reports)
        self.objectives = Objectives(parts.store, parts.exchange, parts.settings, topics, description)
        self.playbacks = Playbacks(
            parts.network.session, parts.signer.address, parts.ledger, parts.settings, parts.recordings
        )
        self.executor = Executor(
            ledger=parts.ledger,
            outbox=parts.outbox,
            store=parts.store,
            signer=parts.signer,
            objectives=self.objectives,
            playbacks=self.playbacks,
            handlers=topics,
            on_phase=self._on_phase,
        )
        self.listener = ChainListener(parts, self.trader, self.executor, on_phase=self._on_phase)
        self._status = AgentStatus(parts, self.executor, self.playbacks.recorders, model=model)
        self._handlers = handlers

    async def _open(self, stack: AsyncExitStack) -> None:
        await stack.enter_async_context(self.reports)
        await stack.enter_async_context(self.trader)
        services = self.parts.services
        offer_services(self.parts, self.executor, has_handlers=bool(self._handlers.topics))
        services.offer("logs", LogService("agent", self.parts.signer.address).logs)
        services.offer("status", self._status.status)

    async def _work(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            if self.parts.settings.enable_executor:
                tasks.create_task(self._do_jobs(), name="executor")
            tasks.create_task(self.parts.outbox.run(), name="outbox")
            tasks.create_task(self.listener.run(), name="listener")
            tasks.create_task(LateResults(self.parts).run(), name="late results")
            tasks.create_task(self._follow_earlier(), name="reports on earlier contracts")

    async def _do_jobs(self) -> None:
        await self.listener.finalize_ended()
        await self.executor.run()

    async def handle_demands(self, subscription: Subscription[Demand], handlers: Sequence[Handler]) -> None:
        """Call the handlers with the demands of a subscription whose makers can pay, until cancelled."""
        parts, names = self.parts, self.parts.chain.names
        token = await parts.chain.retrying(partial(names.address, parts.settings.erc20_token), outages=parts.outages)
        await DemandDispatcher(
            subscription,
            handlers,
            chain=parts.chain,
            token=token,
            customers=self.trader.customers,
            outages=parts.outages,
            declines=DeclinePublisher(parts.channel, parts.signer, parts.drops),
            drops=parts.drops,
        ).run()

    async def require_fit(self, objective: str, model: str) -> None:
        """Raise `ObjectiveUnfit` if an objective does not fit the model's description, as far as both are available."""
        description = await self.models.find(model)
        if description is not None:
            await self.objectives.require_fit(objective, description)

    async def measure(self, subscriptions: Sequence[Subscription[Any]]) -> tuple[MetricFamily, ...]:
        """The metrics of its work, and of the `subscriptions` of its handlers."""
        return await self._status.measure(subscriptions)

    def health(self) -> Mapping[str, str]:
        """The state of each of its parts, as `aira status` shows it."""
        return self._status.health()

    async def _follow_earlier(self) -> None:
        """Ask for the reports on contracts of earlier runs that have not ended."""
        parts = self.parts
        for job in await parts.ledger.jobs(UNFINISHED):
            self.reports.follow(job.liability)
        for payload, address in await parts.ledger.contracts("demand"):
            demand = decode(payload)
            if isinstance(demand, Demand) and demand.validator != ZERO_ADDRESS:
                read = partial(parts.chain.liabilities.get, address)
                with suppress(NotALiability):
                    liability = await parts.chain.retrying(read, outages=parts.outages)
                    if not liability.is_finalized:
                        self.reports.follow(liability)

    async def _on_report(self, report: ValidatorReport) -> None:
        for handler in self._handlers.reports:
            await call(handler, report)

    async def _on_phase(self, phase: Phase, liability: Liability) -> None:
        if phase in PUBLISHED:
            key = str(EventKey(self.parts.signer.address, liability.address, PUBLISHED[phase]))
            self.parts.channel.put(key, liability.encode())
        for handler in self._handlers.liabilities:
            await call(handler, phase, liability)
