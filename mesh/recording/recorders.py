"""The recorders of a process, counted together."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from mesh.clock import SYSTEM_CLOCK
from mesh.recording.recorder import Recorder, RecorderStatistics

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.clock import Clock
    from mesh.recording.partial import RecordingAbout


class Recorders:
    """Opens recorders, and adds up their statistics, including those of closed ones. For any thread."""

    def __init__(self, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._open: list[Recorder] = []
        self._recorded = 0
        self._lost = 0

    def open(self, path: Path, about: RecordingAbout) -> Recorder:
        """Open a `Recorder`; the caller closes it. Raises as that does."""
        recorder = Recorder(path, about, clock=self._clock)
        with self._lock:
            self._drop_finished()
            self._open.append(recorder)
        return recorder

    def statistics(self) -> RecorderStatistics:
        """What all have done together; `lag` is that of the slowest."""
        with self._lock:
            self._drop_finished()
            now = [recorder.statistics() for recorder in self._open]
            return RecorderStatistics(
                recorded=self._recorded + sum(one.recorded for one in now),
                lost=self._lost + sum(one.lost for one in now),
                lag=max((one.lag for one in now), default=0.0),
            )

    def _drop_finished(self) -> None:
        """Add the statistics of finished recorders to the totals, and drop them."""
        for recorder in [recorder for recorder in self._open if recorder.is_done]:
            done = recorder.statistics()
            self._recorded += done.recorded
            self._lost += done.lost
            self._open.remove(recorder)
