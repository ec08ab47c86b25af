"""Metrics of a session and of the messages received over it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh.telemetry.metrics import MetricFamily, MetricSample, by_label, counter, gauge
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from mesh.base.flood import Drops
    from mesh.network._validation import ValidationStatistics
    from mesh.network.channel import Subscription
    from mesh.network.session import Network


def message_families(subscriptions: Iterable[Subscription[Any]]) -> tuple[MetricFamily, ...]:
    """Messages received over these subscriptions, by kind and verdict, and those dropped before validation."""
    counts = [(subscription.kind, subscription.statistics()) for subscription in subscriptions]
    return (
        MetricFamily(
            "aira_messages_total",
            "counter",
            "Messages received, by kind and verdict: accepted, duplicate, or the reason for rejection",
            tuple(
                MetricSample(count, {"kind": kind, "verdict": verdict})
                for kind, statistics in counts
                for verdict, count in _verdicts(statistics)
            ),
        ),
        MetricFamily(
            "aira_messages_dropped_total",
            "counter",
            "Messages dropped unseen, the oldest first, because they arrived faster than they were processed",
            tuple(MetricSample(statistics.dropped, {"kind": kind}) for kind, statistics in counts),
        ),
    )


def drop_family(drops: Drops) -> MetricFamily:
    """What a role dropped because of floods."""
    meaning = "Messages, requests and the like that were dropped because there were too many, by reason"
    return by_label("aira_dropped_total", "counter", meaning, "reason", drops.totals())


def network_families(network: Network) -> tuple[MetricFamily, ...]:
    """The connection of a session."""
    return (
        gauge(
            "aira_network_links",
            "Connected routers; for a router, all sessions connected to it",
            network.links,
        ),
        counter("aira_network_losses_total", "How often the last connected router was lost", network.losses),
    )


def link_state(network: Network) -> str:
    """The health of a session as a part of its role."""
    return ALIVE if network.connected else "waits for a router"


def _verdicts(statistics: ValidationStatistics) -> Iterator[tuple[str, int]]:
    yield "accepted", statistics.accepted
    yield "duplicate", statistics.duplicate
    yield from sorted(statistics.invalid.items())
