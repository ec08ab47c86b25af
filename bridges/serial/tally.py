"""What an edge agent has come to, counted: figures for an operator."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bridges.serial.dialect import Counters
    from bridges.serial.line import Line


@dataclass(frozen=True, kw_only=True)
class EdgeStatistics:
    """What went over a line, how commands and calls have ended (`done`, `read`, or the reason why not), and how the
    line is now. `openings` of the port are its losses and one more."""

    line: Counters
    calls: Mapping[str, int]
    openings: int
    board_losses: int
    line_is_open: bool
    board_is_present: bool


class Tally:
    """Counts for one line. Counted on the line's thread, told on any."""

    def __init__(self, line: Line) -> None:
        self._line = line
        self._endings: Counter[str] = Counter()
        self._board_losses = 0

    def ended(self, how: str) -> None:
        """A command or a call has come to its end: `done`, `read`, or a reason why not."""
        self._endings[how] += 1

    def board_lost(self) -> None:
        """A board that was there is there no more."""
        self._board_losses += 1

    def statistics(self) -> EdgeStatistics:
        """The counts now."""
        return EdgeStatistics(
            line=replace(self._line.dialect.counters),
            calls=dict(self._endings),
            openings=self._line.openings,
            board_losses=self._board_losses,
            line_is_open=self._line.is_open,
            board_is_present=self._line.dialect.about is not None,
        )
