"""How many messages came when, by topic. Pure: no I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.recording.objective import Played


class TopicRates(Struct, frozen=True):
    """Messages of each topic in equal spans of time, `span_ns` nanoseconds each, from the first message on."""

    span_ns: int
    counts: dict[str, list[int]]

    def per_second(self, topic: str) -> list[float]:
        """Messages a second in each span."""
        return [count * 1e9 / self.span_ns for count in self.counts[topic]]


def rates_of(messages: Iterable[Played], *, start_ns: int, duration_ns: int, spans: int) -> TopicRates:
    """Count messages that lie between `start_ns` and `duration_ns` later in so many spans."""
    span = max(1, -(-(duration_ns + 1) // spans))
    counts: dict[str, list[int]] = {}
    for message in messages:
        counted = counts.get(message.topic)
        if counted is None:
            counted = counts[message.topic] = [0] * spans
        counted[(message.log_time_ns - start_ns) // span] += 1
    return TopicRates(span, counts)
