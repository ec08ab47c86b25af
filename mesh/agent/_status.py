"""Metrics, health and status of an agent with an account."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from mesh.agent.components import AgentComponents
from mesh.agent.ledger import UNFINISHED, Phase
from mesh.role.status import RoleStatus
from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge
from schemas.status import ALIVE, OFF, StoreUse, Work

if TYPE_CHECKING:
    from mesh.agent.jobs import Executor


class AgentStatus(RoleStatus[AgentComponents]):
    """The metrics, the health and the service `status` of an agent with an account."""

    role = "agent"

    def __init__(self, parts: AgentComponents, executor: Executor, *, model: str = "") -> None:
        super().__init__(parts)
        self._executor = executor
        self._model = model

    def health(self) -> dict[str, str]:
        """The state of each part; the parts are the nodes of the legacy stack. The signer's key is in memory."""
        executor = ALIVE if self._executor.is_running else "has not begun"
        shared = super().health()
        return {
            "executor": executor if self.parts.settings.enable_executor else OFF,
            "channel": shared["channel"],
            "signer": ALIVE,
            "listener": shared["listener"],
        }

    async def _own_status(self, store: StoreUse) -> dict[str, Any]:
        ledger, waiting = self.parts.ledger, sum((await self._waiting()).values())
        return {"model": self._model, "work": Work(jobs=await ledger.jobs_by_phase(), outbox=waiting, store=store)}

    async def _own_families(self) -> tuple[MetricFamily, ...]:
        now, phases = time.time(), await self.parts.ledger.phases()
        counts = {phase.value: 0.0 for phase in Phase} | {phase: float(count) for phase, count, _ in phases}
        ages = {phase.value: 0.0 for phase in UNFINISHED}
        ages |= {phase: max(0.0, now - since) for phase, _, since in phases if phase in ages}
        age = "Seconds since the first of the jobs in a phase entered it; 0 without one"
        kinds = {"demand": 0, "offer": 0, "withdrawal": 0, "result": 0} | await self._waiting()
        unsettled = "Messages that are sent again until their effect is on the chain"
        recorded, traffic = self._executor.recordings.recorders.statistics(), self.parts.exchange.statistics()
        lies = sum(traffic.corrupt_blocks.values())
        return (
            by_label("aira_jobs", "gauge", "Jobs in the ledger, by phase", "phase", counts),
            by_label("aira_job_standing_seconds", "gauge", age, "phase", ages),
            by_label("aira_outbox_messages", "gauge", unsettled, "kind", kinds),
            counter("aira_recorded_messages_total", "Messages written to recordings", recorded.recorded),
            counter("aira_recording_lost_messages_total", "Messages that could not be recorded", recorded.lost),
            gauge("aira_recording_lag_seconds", "Seconds that a message has waited to be written", recorded.lag),
            counter("aira_content_fetched_bytes_total", "Bytes of content fetched from others", traffic.fetched_bytes),
            counter("aira_content_served_blocks_total", "Blocks of content served to others", traffic.served),
            counter("aira_content_lies_total", "Blocks of content that did not match their CID", lies),
        )

    async def _waiting(self) -> dict[str, int]:
        """The messages in the outbox, by kind."""
        return await self.parts.ledger.waiting_by_kind(head=self.parts.chain_head.contract_block)
