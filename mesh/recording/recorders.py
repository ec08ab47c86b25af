"""The recorders of one agent, one after the other or several at once, and what all of them have done."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from mesh.recording.recorder import Recorder, RecorderStatistics

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.recording.recorder import RecordingAbout


class Recorders:
    """Opens recorders, and adds up their figures, those of the ones that are closed included. For any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: list[Recorder] = []
        self._recorded = 0
        self._lost = 0

    def open(self, path: Path, about: RecordingAbout) -> Recorder:
        """A `Recorder`, whose is to close it. Raises as that does."""
        recorder = Recorder(path, about)
        with self._lock:
            self._settle()
            self._open.append(recorder)
        return recorder

    def statistics(self) -> RecorderStatistics:
        """What all have done together; the lag is that of the slowest."""
        with self._lock:
            self._settle()
            now = [recorder.statistics() for recorder in self._open]
            return RecorderStatistics(
                recorded=self._recorded + sum(one.recorded for one in now),
                lost=self._lost + sum(one.lost for one in now),
                lag=max((one.lag for one in now), default=0.0),
            )

    def _settle(self) -> None:
        """Keep the figures of those that are done, and not them."""
        for recorder in [recorder for recorder in self._open if recorder.is_done]:
            done = recorder.statistics()
            self._recorded += done.recorded
            self._lost += done.lost
            self._open.remove(recorder)
