"""The figures of a bridge and its parts, as metrics and health show them. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge, labelled
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from schemas.status import BridgeStatus, ContentMetrics, DirectionStatus


class Standing(NamedTuple):
    """How the bridge of one lighthouse is, and what it stands on: the router and the daemon's subscription."""

    status: BridgeStatus
    routed: bool
    subscribed: bool


def bridge_families(bridges: Iterable[Standing]) -> tuple[MetricFamily, ...]:
    """The figures of each of these bridges, with its lighthouse as a label."""
    return tuple(
        family for bridge in bridges for family in labelled(_bridge(bridge), lighthouse=bridge.status.lighthouse)
    )


def content_families(content: ContentMetrics) -> tuple[MetricFamily, ...]:
    """What was done with content, for all lighthouses together."""
    return (
        counter("aira_bridge_content_fetched_total", "Files fetched from IPFS and kept", content.fetched),
        counter("aira_bridge_content_fetched_bytes_total", "Blocks that came from IPFS, bytes", content.fetched_bytes),
        counter("aira_bridge_content_lies_total", "Blocks from IPFS that did not hash to their name", content.lies),
        counter("aira_bridge_content_answered_total", "Blocks of IPFS given to the mesh", content.answered),
        counter("aira_bridge_content_added_total", "Files of the mesh added to IPFS", content.added),
        counter("aira_bridge_content_added_bytes_total", "Files of the mesh added to IPFS, bytes", content.added_bytes),
        counter("aira_bridge_content_by_blocks_total", "Those of them that went block by block", content.by_blocks),
        counter("aira_bridge_content_pinned_total", "Files pinned by further nodes, once for each", content.pinned),
        counter("aira_bridge_content_failed_total", "Files that could not be had, or not be added", content.failed),
    )


def parts_of(bridges: Iterable[Standing]) -> Mapping[str, str]:
    """What these bridges of one process stand on, part → `ALIVE` or what is wrong with it.

    That nobody listens on IPFS is no fault of theirs, and without the chain they carry too.
    """
    parts: dict[str, str] = {}
    for bridge in bridges:
        parts["router"] = ALIVE if bridge.routed else "waits for a router"
        why = bridge.status.last_error or "waits for the daemon"
        parts[f"daemon for {bridge.status.lighthouse}"] = ALIVE if bridge.subscribed else why
    return parts


def _bridge(bridge: Standing) -> Iterator[MetricFamily]:
    status = bridge.status
    for direction, way in (("to-ipfs", status.to_ipfs), ("to-mesh", status.to_mesh)):
        yield from labelled(_way(way), direction=direction)
    subscribed, carries = float(bridge.subscribed), float(status.carries)
    yield gauge("aira_bridge_daemon_up", "1 while the daemon is subscribed, 0 otherwise", subscribed)
    yield counter("aira_bridge_daemon_losses_total", "How often the daemon was lost", status.losses)
    yield gauge("aira_bridge_carries", "1 while it is this bridge's turn to carry, 0 otherwise", carries)
    yield gauge("aira_bridge_ipfs_peers", "Other nodes on the IPFS topic", len(status.ipfs_peers))
    yield gauge("aira_bridge_mesh_peers", "Who is on the lighthouse's channel in the mesh", len(status.mesh_peers))


def _way(way: DirectionStatus) -> tuple[MetricFamily, ...]:
    return (
        counter("aira_bridge_received_total", "Messages that came in on the other side", way.received),
        by_label("aira_bridge_accepted_total", "counter", "Messages let through, by kind", "kind", way.kinds),
        by_label("aira_bridge_invalid_total", "counter", "Messages not let through, by reason", "reason", way.invalid),
        counter("aira_bridge_known_total", "Messages that were on the far side already", way.known),
        counter("aira_bridge_carried_total", "Messages carried by this bridge", way.carried),
        counter("aira_bridge_carried_bytes_total", "Messages carried by this bridge, bytes", way.bytes),
        counter("aira_bridge_left_total", "Messages carried by another bridge", way.left),
        by_label("aira_bridge_dropped_total", "counter", "Messages lost, by reason", "reason", way.dropped),
        gauge("aira_bridge_waiting", "Messages that wait to be carried", way.waiting),
        gauge("aira_bridge_left_waiting", "Messages left to another bridge and not arrived yet", way.left_waiting),
        gauge("aira_bridge_unheard", "Messages said when nobody listened, to be said again", way.unheard),
    )
