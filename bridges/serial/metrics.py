"""The counters, metrics and health of an edge agent. Counters change on the line's thread and are read on any."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from mesh.telemetry.health import STARTING, Health, health_metrics
from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import zenoh

    from bridges.serial.dialect import LineCounters
    from bridges.serial.line import SerialLine


@dataclass(frozen=True, kw_only=True)
class EdgeStatistics:
    """What went over a line, the outcomes of commands and calls (`done`, `read`, or the reason of a failure), and the
    state of the line. `openings` counts how often the port was opened: once, and after each loss."""

    line: LineCounters
    calls: Mapping[str, int]
    openings: int
    board_losses: int
    line_is_open: bool
    board_is_present: bool


class EdgeCounters:
    """The counters of one edge agent."""

    def __init__(self, line: SerialLine) -> None:
        self._line = line
        self._outcomes: Counter[str] = Counter()
        self._board_losses = 0

    def count_outcome(self, outcome: str) -> None:
        """Count a finished command or call: `done`, `read`, or the reason of its failure."""
        self._outcomes[outcome] += 1

    def count_loss(self) -> None:
        """Count the loss of a board that was present."""
        self._board_losses += 1

    def statistics(self) -> EdgeStatistics:
        """The counts now."""
        return EdgeStatistics(
            line=replace(self._line.dialect.counters),
            calls=dict(self._outcomes),
            openings=self._line.openings,
            board_losses=self._board_losses,
            line_is_open=self._line.is_open,
            board_is_present=self._line.dialect.info is not None,
        )


class EdgeMetrics:
    """The metrics and health of an edge agent, also before it has started."""

    def __init__(self) -> None:
        self._started: tuple[EdgeCounters, zenoh.Session] | None = None

    def attach(self, counters: EdgeCounters, session: zenoh.Session) -> None:
        """Report the edge agent with these counters from now on."""
        self._started = counters, session

    def families(self) -> Iterable[MetricFamily]:
        """The metrics now."""
        families = () if self._started is None else families_of(self._started[0].statistics())
        return (*families, health_metrics(self._parts()))

    def health(self) -> Health:
        """The state of its parts now."""
        return Health.of(self._parts())

    def _parts(self) -> Mapping[str, str]:
        if self._started is None:
            return {"start": STARTING}
        counters, session = self._started
        now = counters.statistics()
        linked = not session.is_closed() and bool(session.info.routers_zid())
        return {
            "channel": ALIVE if linked else "waits for a router",
            "line": ALIVE if now.line_is_open else "waits for the port",
            "board": ALIVE if now.board_is_present else "is absent",
        }


def families_of(now: EdgeStatistics) -> tuple[MetricFamily, ...]:
    """The metrics of one edge agent."""
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
            "Frames that are damaged, undecodable, missing, repeated, or unrequested",
            "reason",
            faults,
        ),
        counter("aira_edge_noise_bytes_total", "Bytes on the line that belong to no frame", line.noise),
        by_label("aira_edge_calls_total", "counter", "Commands and calls, by outcome", "outcome", now.calls),
        counter(
            "aira_edge_line_openings_total", "How often the port was opened: once, and after each loss", now.openings
        ),
        counter("aira_edge_board_losses_total", "How often a present board was lost", now.board_losses),
        gauge("aira_edge_board_present", "1 while the board is present, 0 otherwise", float(now.board_is_present)),
    )
