"""Metrics, health and status: what is the same for each role. Nothing here asks the network."""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import mesh
from mesh.network.channel import message_families
from mesh.telemetry.metrics import drop_family, gauge, labelled, public_parts
from schemas.status import ALIVE, Status, StoreUse

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mesh.base.flood import Drops
    from mesh.network import Channel, Network, Subscription
    from mesh.role.composition import RoleParts
    from mesh.telemetry.metrics import MetricFamily
    from schemas.rpc import Nothing

P = TypeVar("P", bound="RoleParts[Any]")


class WatcherStatus:
    """The metrics and the health of a role without an account, which only receives the market's messages."""

    def __init__(self, network: Network, channel: Channel, drops: Drops) -> None:
        self._drops = drops
        self._network = network
        self._channel = channel

    async def measure(self, subscriptions: Sequence[Subscription[Any]]) -> tuple[MetricFamily, ...]:
        """The metrics of its subscriptions and its session."""
        received = labelled(
            (*message_families(subscriptions), drop_family(self._drops)), lighthouse=self._channel.lighthouse
        )
        return (*received, *self._network.families())

    def health(self) -> Mapping[str, str]:
        """The state of its one part, the channel."""
        return {"channel": self._network.state}


class RoleStatus(ABC, Generic[P]):
    """The metrics, the health and the service `status` of a role with `parts`."""

    role: ClassVar[str]

    def __init__(self, parts: P) -> None:
        self.parts = parts
        self._started = time.monotonic()

    async def status(self, _request: Nothing) -> Status:
        """The answer of the service `status`."""
        parts, usage = self.parts, await asyncio.to_thread(self.parts.store.usage)
        return Status(
            role=self.role,
            address=parts.signer.address,
            version=mesh.__version__,
            zenoh_id=parts.network.id,
            lighthouse=parts.channel.lighthouse,
            parts=public_parts(self.health()),
            head=parts.chain_head.head,
            chain_id=parts.chain.chain_id,
            xrt=parts.chain.xrt,
            uptime=round(time.monotonic() - self._started, 3),
            dropped=parts.drops.totals(),
            heaviest=parts.drops.senders(),
            **await self._own_status(StoreUse(files=usage.files, bytes=usage.bytes, quota=usage.quota)),
        )

    def health(self) -> dict[str, str]:
        """The state of each part."""
        return {
            "channel": self.parts.network.state,
            "listener": "waits for the node" if self.parts.outages.is_down else ALIVE,
        }

    async def measure(self, subscriptions: Sequence[Subscription[Any]]) -> tuple[MetricFamily, ...]:
        """The metrics now; `subscriptions` are those of its market."""
        parts, usage = self.parts, await asyncio.to_thread(self.parts.store.usage)
        families = (
            *message_families(subscriptions),
            drop_family(parts.drops),
            *await self._own_families(),
            gauge("aira_content_files", "Files in the content store", usage.files),
            gauge("aira_content_bytes", "Bytes of the content store", usage.bytes),
            *(() if usage.quota is None else (gauge("aira_content_quota_bytes", "The store's quota", usage.quota),)),
            *parts.chain_head.families(),
        )
        own = labelled(families, lighthouse=parts.channel.lighthouse)
        return (*own, *parts.network.families(), *await parts.chain.measure())

    @abstractmethod
    async def _own_status(self, store: StoreUse) -> dict[str, Any]:
        """The fields of its status that others don't have; `store` is what it has in its store."""

    @abstractmethod
    async def _own_families(self) -> tuple[MetricFamily, ...]:
        """The metrics that others don't have."""
