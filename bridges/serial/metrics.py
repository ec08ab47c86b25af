"""The figures and the health of an edge agent. Asked for on other threads than that of its line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.telemetry.health import STARTING, Health, health_metrics
from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import zenoh

    from bridges.serial.edge import Edge
    from bridges.serial.tally import EdgeStatistics


class EdgeMetrics:
    """Of an edge agent that may not have begun yet."""

    def __init__(self) -> None:
        self._begun: tuple[Edge, zenoh.Session] | None = None

    def begin(self, edge: Edge, session: zenoh.Session) -> None:
        """These are what is told of from now on."""
        self._begun = edge, session

    def families(self) -> Iterable[MetricFamily]:
        """The figures now."""
        figures = () if self._begun is None else families_of(self._begun[0].tally.statistics())
        return (*figures, health_metrics(self._parts()))

    def health(self) -> Health:
        """The state of its parts now."""
        return Health.of(self._parts())

    def _parts(self) -> Mapping[str, str]:
        if self._begun is None:
            return {"start": STARTING}
        edge, session = self._begun
        now = edge.tally.statistics()
        linked = not session.is_closed() and bool(session.info.routers_zid())
        return {
            "channel": ALIVE if linked else "waits for a router",
            "line": ALIVE if now.line_is_open else "waits for the port",
            "board": ALIVE if now.board_is_present else "is absent",
        }


def families_of(now: EdgeStatistics) -> tuple[MetricFamily, ...]:
    """The figures of one edge agent."""
    line = now.line
    directions = {"in": line.received, "out": line.sent}
    faults = {
        "damaged": line.damaged,
        "refused": line.refused,
        "missed": line.missed,
        "repeated": line.repeated,
        "stray": line.stray,
    }
    return (
        by_label("aira_edge_frames_total", "counter", "Whole frames from the board and to it", "direction", directions),
        by_label(
            "aira_edge_frame_faults_total",
            "counter",
            "Frames with a wrong check, that can't be what they claim, that are missing, sent again, or not asked for",
            "reason",
            faults,
        ),
        counter("aira_edge_noise_bytes_total", "Bytes of the line that belong to no frame", line.noise),
        by_label("aira_edge_calls_total", "counter", "Commands and calls, by how they ended", "outcome", now.calls),
        counter(
            "aira_edge_line_openings_total", "How often the port was opened: once, and after each loss", now.openings
        ),
        counter("aira_edge_board_losses_total", "How often a board that was there was lost", now.board_losses),
        gauge("aira_edge_board_present", "1 while the board is there, 0 otherwise", float(now.board_is_present)),
    )
