"""Metrics, health and status of an agent."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

import mesh
from mesh.network.metrics import drop_family, link_state, message_families, network_families
from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge, labelled
from mesh.work.phases import UNFINISHED, Phase
from schemas.status import ALIVE, OFF, Status, StoreUse, Work

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mesh.agent.components import AgentComponents
    from mesh.flood import Drops
    from mesh.network import Channel, Network, Subscription
    from mesh.recording import Recorders
    from mesh.work.executor import Executor
    from schemas.rpc import Nothing


class WatcherStatus:
    """The metrics and the health of an agent without an account, which only receives the market's messages."""

    def __init__(self, network: Network, channel: Channel, drops: Drops) -> None:
        self._drops = drops
        self._network = network
        self._channel = channel

    async def measure(self, subscriptions: Sequence[Subscription[Any]]) -> tuple[MetricFamily, ...]:
        """The metrics of its subscriptions and its session."""
        received = labelled(
            (*message_families(subscriptions), drop_family(self._drops)), lighthouse=self._channel.lighthouse
        )
        return (*received, *network_families(self._network))

    def health(self) -> Mapping[str, str]:
        """The state of its one part, the channel."""
        return {"channel": link_state(self._network)}


class AgentStatus:
    """The metrics, the health and the service `status` of an agent with an account. Nothing here asks the network."""

    def __init__(self, parts: AgentComponents, executor: Executor, recorders: Recorders, *, model: str = "") -> None:
        self._parts = parts
        self._executor = executor
        self._recorders = recorders
        self._model = model
        self._started = time.monotonic()

    async def status(self, _request: Nothing) -> Status:
        """The answer of the service `status`."""
        parts = self._parts
        usage = await asyncio.to_thread(parts.store.usage)
        return Status(
            role="agent",
            address=parts.signer.address,
            version=mesh.__version__,
            zenoh_id=parts.network.id,
            lighthouse=parts.channel.lighthouse,
            parts=self.health(),
            head=parts.chain_head.head,
            chain_id=parts.chain.chain_id,
            xrt=parts.chain.xrt,
            uptime=round(time.monotonic() - self._started, 3),
            model=self._model,
            dropped=parts.drops.totals(),
            heaviest=parts.drops.senders(),
            work=Work(
                jobs=await parts.ledger.jobs_by_phase(),
                outbox=sum((await parts.ledger.waiting_by_kind(head=parts.chain_head.head)).values()),
                store=StoreUse(files=usage.files, bytes=usage.bytes, quota=usage.quota),
            ),
        )

    def health(self) -> dict[str, str]:
        """The state of each part; the parts are the nodes of the legacy stack. The signer's key is in memory."""
        if not self._parts.settings.enable_executor:
            executor = OFF
        else:
            executor = ALIVE if self._executor.is_running else "has not begun"
        return {
            "executor": executor,
            "channel": link_state(self._parts.network),
            "signer": ALIVE,
            "listener": "waits for the node" if self._parts.outages.is_down else ALIVE,
        }

    async def measure(self, subscriptions: Sequence[Subscription[Any]]) -> tuple[MetricFamily, ...]:
        """The metrics now; `subscriptions` are those of its handlers."""
        from mesh.chain.metrics import reading_families

        families = (
            *message_families(subscriptions),
            drop_family(self._parts.drops),
            *await self._jobs(),
            *await self._outbox(),
            *self._recording(),
            *await self._content(),
            *reading_families(head=self._parts.chain_head.head, read_at=self._parts.chain_head.advanced_at),
        )
        own = labelled(families, lighthouse=self._parts.channel.lighthouse)
        return (*own, *network_families(self._parts.network), *await self._parts.chain.measure())

    async def _jobs(self) -> tuple[MetricFamily, ...]:
        now, phases = time.time(), await self._parts.ledger.phases()
        counts = {phase.value: 0.0 for phase in Phase} | {phase: float(count) for phase, count, _ in phases}
        ages = {phase.value: 0.0 for phase in UNFINISHED}
        ages |= {phase: max(0.0, now - since) for phase, _, since in phases if phase in ages}
        meaning = "Seconds since the first of the jobs in a phase entered it; 0 without one"
        return (
            by_label("aira_jobs", "gauge", "Jobs in the ledger, by phase", "phase", counts),
            by_label("aira_job_standing_seconds", "gauge", meaning, "phase", ages),
        )

    async def _outbox(self) -> tuple[MetricFamily, ...]:
        waiting = await self._parts.ledger.waiting_by_kind(head=self._parts.chain_head.head)
        kinds = {"demand": 0, "offer": 0, "withdrawal": 0, "result": 0} | waiting
        meaning = "Messages that are sent again until their effect is on the chain"
        return (by_label("aira_outbox_messages", "gauge", meaning, "kind", kinds),)

    def _recording(self) -> tuple[MetricFamily, ...]:
        total = self._recorders.statistics()
        return (
            counter("aira_recorded_messages_total", "Messages written to recordings", total.recorded),
            counter("aira_recording_lost_messages_total", "Messages that could not be recorded", total.lost),
            gauge("aira_recording_lag_seconds", "Seconds that a message has waited to be written", total.lag),
        )

    async def _content(self) -> tuple[MetricFamily, ...]:
        usage = await asyncio.to_thread(self._parts.store.usage)
        traffic = self._parts.exchange.statistics()
        quota = () if usage.quota is None else (gauge("aira_content_quota_bytes", "The store's quota", usage.quota),)
        fetched, corrupt = traffic.fetched_bytes, sum(traffic.corrupt_blocks.values())
        return (
            gauge("aira_content_files", "Files in the content store", usage.files),
            gauge("aira_content_bytes", "Bytes of the content store", usage.bytes),
            *quota,
            counter("aira_content_fetched_bytes_total", "Bytes of content fetched from others", fetched),
            counter("aira_content_served_blocks_total", "Blocks of content served to others", traffic.served),
            counter("aira_content_lies_total", "Blocks of content that did not match their CID", corrupt),
        )
