"""The figures of a session, and of the messages that came over it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh.telemetry.metrics import MetricFamily, MetricSample, counter, gauge
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from mesh.network.session import Network
    from mesh.network.subscription import Subscription
    from mesh.network.validation import Statistics


def message_families(subscriptions: Iterable[Subscription[Any]]) -> tuple[MetricFamily, ...]:
    """What came in over these subscriptions: by kind and verdict, and what was lost before it had one."""
    told = [(subscription.kind, subscription.statistics()) for subscription in subscriptions]
    return (
        MetricFamily(
            "aira_messages_total",
            "counter",
            "Messages that came in, by kind and verdict: accepted, duplicate, or the reason why they are not let in",
            tuple(
                MetricSample(count, {"kind": kind, "verdict": verdict})
                for kind, statistics in told
                for verdict, count in _verdicts(statistics)
            ),
        ),
        MetricFamily(
            "aira_messages_dropped_total",
            "counter",
            "Messages that fell out of the queue unseen, the oldest first, as they came faster than they were taken",
            tuple(MetricSample(statistics.dropped, {"kind": kind}) for kind, statistics in told),
        ),
    )


def network_families(network: Network) -> tuple[MetricFamily, ...]:
    """How well a session holds."""
    return (
        gauge(
            "aira_network_links",
            "Routers that this session is linked to; of a router, all who are linked to it",
            network.links,
        ),
        counter("aira_network_losses_total", "How often the last link to a router was lost", network.losses),
    )


def link_state(network: Network) -> str:
    """The state of a session as a part of its role."""
    return ALIVE if network.connected else "waits for a router"


def _verdicts(statistics: Statistics) -> Iterator[tuple[str, int]]:
    yield "accepted", statistics.accepted
    yield "duplicate", statistics.duplicate
    yield from sorted(statistics.invalid.items())
