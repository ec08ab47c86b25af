"""The figures of an agent: what it hears and does, what waits to be sent, what it keeps."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

from mesh.chain.metrics import ChainMetrics, reading_families
from mesh.network.metrics import message_families, network_families
from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge, labelled
from mesh.work.lifecycle import UNFINISHED, Phase

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.agent.components import AgentComponents
    from mesh.network import Subscription
    from mesh.work.workshop import Workshop


class AgentMetrics:
    """The figures of the agent that these parts make up, with its lighthouse; its account's are the chain's."""

    def __init__(self, parts: AgentComponents, workshop: Workshop) -> None:
        self._parts = parts
        self._workshop = workshop
        self._chain = ChainMetrics(parts.chain)

    async def measure(self, subscriptions: Sequence[Subscription[Any]]) -> tuple[MetricFamily, ...]:
        """The figures now; `subscriptions` are what its handlers hear."""
        families = (
            *message_families(subscriptions),
            *await self._jobs(),
            *await self._waiting(),
            *self._recording(),
            *await self._content(),
            *reading_families(head=self._parts.clock.head, read_at=self._parts.clock.passed_at),
        )
        own = labelled(families, lighthouse=self._parts.channel.lighthouse)
        return (*own, *network_families(self._parts.network), *await self._chain.measure())

    async def _jobs(self) -> tuple[MetricFamily, ...]:
        now, standing = time.time(), await self._parts.ledger.standing()
        counts = {phase.value: 0.0 for phase in Phase} | {phase: float(count) for phase, count, _ in standing}
        ages = {phase.value: 0.0 for phase in UNFINISHED}
        ages |= {phase: max(0.0, now - since) for phase, _, since in standing if phase in ages}
        meaning = "Seconds for which the job that came first into a phase has stood there; 0 without one"
        return (
            by_label("aira_jobs", "gauge", "Jobs in the ledger, by phase", "phase", counts),
            by_label("aira_job_standing_seconds", "gauge", meaning, "phase", ages),
        )

    async def _waiting(self) -> tuple[MetricFamily, ...]:
        kinds = {"demand": 0, "offer": 0, "result": 0} | await self._parts.ledger.waiting_by_kind()
        meaning = "Messages that are sent until their effect is on the chain"
        return (by_label("aira_outbox_messages", "gauge", meaning, "kind", kinds),)

    def _recording(self) -> tuple[MetricFamily, ...]:
        done = self._workshop.recorders.statistics()
        return (
            counter("aira_recorded_messages_total", "Messages written into recordings", done.recorded),
            counter("aira_recording_lost_messages_total", "Messages that no recording could take", done.lost),
            gauge("aira_recording_lag_seconds", "For how long a message has waited to be written", done.lag),
        )

    async def _content(self) -> tuple[MetricFamily, ...]:
        usage = await asyncio.to_thread(self._parts.store.usage)
        known = self._parts.exchange.statistics()
        quota = () if usage.quota is None else (gauge("aira_content_quota_bytes", "Most of that", usage.quota),)
        return (
            gauge("aira_content_files", "Files in the content store", usage.files),
            gauge("aira_content_bytes", "Bytes of the content store", usage.bytes),
            *quota,
            counter("aira_content_fetched_bytes_total", "Bytes of content that came from others", known.fetched_bytes),
            counter("aira_content_served_blocks_total", "Blocks of content given to others", known.served),
            counter(
                "aira_content_lies_total",
                "Blocks of content that were not what they should be",
                sum(known.corrupt_blocks.values()),
            ),
        )
