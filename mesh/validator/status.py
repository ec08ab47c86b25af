"""Metrics, health and status of a validator."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

import mesh
from mesh.chain.metrics import reading_families
from mesh.network.metrics import drop_family, link_state, message_families, network_families
from mesh.telemetry.metrics import by_label, counter, gauge, labelled
from schemas.status import ALIVE, Status, StoreUse, ValidationStatus

if TYPE_CHECKING:
    from mesh.network import Subscription
    from mesh.telemetry.metrics import MetricFamily
    from mesh.validator.components import ValidatorComponents
    from mesh.validator.decisions import CaseJudge
    from schemas import Result
    from schemas.rpc import Nothing


class ValidatorStatus:
    """The metrics, the health and the service `status` of a validator. Nothing here asks the network."""

    def __init__(self, parts: ValidatorComponents, judge: CaseJudge, results: Subscription[Result]) -> None:
        self._parts = parts
        self._judge = judge
        self._results = results
        self._started = time.monotonic()

    async def status(self, _request: Nothing) -> Status:
        """The answer of the service `status`."""
        parts = self._parts
        usage = await asyncio.to_thread(parts.store.usage)
        return Status(
            role="validator",
            address=parts.signer.address,
            version=mesh.__version__,
            zenoh_id=parts.network.id,
            lighthouse=parts.channel.lighthouse,
            parts=self.health(),
            head=parts.chain_head.head,
            chain_id=parts.chain.chain_id,
            xrt=parts.chain.xrt,
            uptime=round(time.monotonic() - self._started, 3),
            dropped=parts.drops.totals(),
            heaviest=parts.drops.senders(),
            validation=ValidationStatus(
                validators=parts.bench.validators,
                policies=tuple(policy.name for policy in parts.terms.policies),
                fee=parts.terms.fee,
                cases=await parts.ledger.stages(),
                store=StoreUse(files=usage.files, bytes=usage.bytes, quota=usage.quota),
            ),
        )

    def health(self) -> dict[str, str]:
        """The state of each part."""
        return {
            "channel": link_state(self._parts.network),
            "listener": "waits for the node" if self._parts.outages.is_down else ALIVE,
        }

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics now."""
        parts, judge = self._parts, self._judge
        usage = await asyncio.to_thread(parts.store.usage)
        verdicts = {"success": 0.0, "no-success": 0.0, "none": 0.0} | dict(judge.verdicts)
        stages = {stage: float(count) for stage, count in (await parts.ledger.stages()).items()}
        families = (
            *message_families([self._results]),
            drop_family(parts.drops),
            by_label("aira_validator_cases", "gauge", "Liabilities that name the validator, by stage", "stage", stages),
            by_label("aira_verdicts_total", "counter", "Cases that it decided or gave up", "verdict", verdicts),
            counter("aira_judging_seconds_total", "Seconds that judging recordings took", judge.seconds),
            gauge("aira_content_files", "Files in the content store", usage.files),
            gauge("aira_content_bytes", "Bytes of the content store", usage.bytes),
            *reading_families(head=parts.chain_head.head, read_at=parts.chain_head.advanced_at),
        )
        own = labelled(families, lighthouse=parts.channel.lighthouse)
        return (*own, *network_families(parts.network), *await parts.chain.measure())
