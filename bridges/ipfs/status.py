"""A bridge's status: message rates, metrics, health, and the counters in its log. Pure."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge, labelled
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from schemas.status import BridgeStatus, ContentMetrics, DirectionStatus

RATE_WINDOW: Final = 10.0
"""Seconds over which a rate is measured."""
GAUGES: Final = ("waiting", "left_waiting", "unheard", "adds_queued", "fetches_queued")
"""Fields of a direction that are current values rather than counts."""


class RateMeter:
    """Events per second, over the last `RATE_WINDOW` seconds. `clock` returns seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._buckets: deque[tuple[int, int]] = deque()

    def count(self) -> None:
        """Count one event."""
        second = int(self._clock())
        if self._buckets and self._buckets[-1][0] == second:
            self._buckets[-1] = (second, self._buckets[-1][1] + 1)
        else:
            self._buckets.append((second, 1))
            self._trim()

    def per_second(self) -> float:
        """The mean rate within the window."""
        self._trim()
        return sum(count for _, count in self._buckets) / RATE_WINDOW

    def _trim(self) -> None:
        while self._buckets and self._buckets[0][0] <= self._clock() - RATE_WINDOW:
            self._buckets.popleft()


class BridgeHealth(NamedTuple):
    """The status of one lighthouse's bridge, and whether its router and its daemon's subscription work."""

    status: BridgeStatus
    routed: bool
    subscribed: bool


def health_parts(bridges: Iterable[BridgeHealth]) -> Mapping[str, str]:
    """The health of these bridges of one process: part → `ALIVE` or the problem.

    Having no listeners on IPFS is healthy, and so is a bridge without a chain.
    """
    parts: dict[str, str] = {}
    for bridge in bridges:
        parts["router"] = ALIVE if bridge.routed else "waits for a router"
        problem = bridge.status.last_error or "waits for the daemon"
        parts[f"daemon for {bridge.status.lighthouse}"] = ALIVE if bridge.subscribed else problem
    return parts


def bridge_families(bridges: Iterable[BridgeHealth]) -> tuple[MetricFamily, ...]:
    """The metrics of each bridge, labelled with its lighthouse."""
    return tuple(
        family for bridge in bridges for family in labelled(_bridge(bridge), lighthouse=bridge.status.lighthouse)
    )


def content_families(content: ContentMetrics) -> tuple[MetricFamily, ...]:
    """The metrics of content, for all lighthouses together."""
    return (
        counter("aira_bridge_content_fetched_total", "Files fetched from IPFS and stored", content.fetched),
        counter("aira_bridge_content_fetched_bytes_total", "Blocks received from IPFS, bytes", content.fetched_bytes),
        counter("aira_bridge_content_lies_total", "Blocks from IPFS that did not match their CID", content.lies),
        counter("aira_bridge_content_answered_total", "IPFS blocks served to the mesh", content.answered),
        counter("aira_bridge_content_added_total", "Files of the mesh added to IPFS", content.added),
        counter("aira_bridge_content_added_bytes_total", "Files of the mesh added to IPFS, bytes", content.added_bytes),
        counter("aira_bridge_content_by_blocks_total", "Of these, files added block by block", content.by_blocks),
        counter("aira_bridge_content_pinned_total", "Pins of files on further nodes", content.pinned),
        counter("aira_bridge_content_failed_total", "Files that could not be fetched or added", content.failed),
        counter("aira_bridge_content_joined_total", "Files not transferred once more for a repetition", content.joined),
        gauge("aira_bridge_content_adds_queued", "Files that wait to be added to IPFS", content.adds_queued),
        gauge("aira_bridge_content_fetches_queued", "Files that wait to be fetched from IPFS", content.fetches_queued),
    )


def counters_of(status: BridgeStatus) -> dict[str, int]:
    """All counters of a status, by names such as `to_ipfs.invalid.signature`."""
    counters = {"losses": status.losses}
    for name in ("to_ipfs", "to_mesh", "content"):
        part = getattr(status, name)
        if part is not None:
            counters.update(_flat(name, msgspec.structs.asdict(part)))
    return counters


def changes_between(before: Mapping[str, int], now: Mapping[str, int]) -> str:
    """The changed counters, as `name=+12` for counts and `name=12` for current values; empty without a change."""
    return " ".join(
        f"{name}={value}" if name.rpartition(".")[2] in GAUGES else f"{name}={value - before.get(name, 0):+d}"
        for name, value in now.items()
        if value != before.get(name, 0)
    )


def _flat(name: str, values: Mapping[str, Any]) -> Iterator[tuple[str, int]]:
    for key, value in values.items():
        match value:
            case int():
                yield f"{name}.{key}", value
            case dict():
                yield from _flat(f"{name}.{key}", value)


def _bridge(bridge: BridgeHealth) -> Iterator[MetricFamily]:
    status = bridge.status
    for direction, counts in (("to-ipfs", status.to_ipfs), ("to-mesh", status.to_mesh)):
        yield from labelled(_direction(counts), direction=direction)
    subscribed, carries = float(bridge.subscribed), float(status.carries)
    yield gauge("aira_bridge_daemon_up", "1 while the daemon is subscribed, 0 otherwise", subscribed)
    yield counter("aira_bridge_daemon_losses_total", "How often the daemon was lost", status.losses)
    yield gauge("aira_bridge_carries", "1 while this bridge is active, 0 while it stands by", carries)
    yield gauge("aira_bridge_ipfs_peers", "Other nodes on the IPFS topic", len(status.ipfs_peers))
    yield gauge("aira_bridge_mesh_peers", "Agents on the lighthouse's channel in the mesh", len(status.mesh_peers))


def _direction(counts: DirectionStatus) -> tuple[MetricFamily, ...]:
    return (
        counter("aira_bridge_received_total", "Messages received from the other side", counts.received),
        by_label("aira_bridge_accepted_total", "counter", "Messages accepted, by kind", "kind", counts.kinds),
        by_label("aira_bridge_invalid_total", "counter", "Messages rejected, by reason", "reason", counts.invalid),
        counter("aira_bridge_known_total", "Messages that were on the destination side already", counts.known),
        counter("aira_bridge_carried_total", "Messages sent by this bridge", counts.carried),
        counter("aira_bridge_carried_bytes_total", "Messages sent by this bridge, bytes", counts.bytes),
        counter("aira_bridge_left_total", "Messages sent by another bridge", counts.left),
        by_label("aira_bridge_dropped_total", "counter", "Messages lost, by reason", "reason", counts.dropped),
        gauge("aira_bridge_waiting", "Messages waiting to be sent", counts.waiting),
        gauge("aira_bridge_left_waiting", "Messages left to another bridge that have not arrived", counts.left_waiting),
        gauge("aira_bridge_unheard", "Messages sent without listeners, to be sent again", counts.unheard),
    )
