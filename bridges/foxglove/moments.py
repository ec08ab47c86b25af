"""What a recording showed at a moment: the last message of each topic. Found fast, also far into a long recording."""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.recording import Objective, Played

POINTS: Final = 64
"""Points of a recording from which a moment is found."""
TOPICS: Final = 512
"""Topics whose last message is shown."""
REMEMBERED: Final = 32 << 20
"""Bytes of the messages that are remembered at the points; beyond, there are no more points."""


class Moment(NamedTuple):
    """The number of the first message after a time, and the last message of each topic before."""

    number: int
    last: tuple[Played, ...]


class _Point(NamedTuple):
    time_ns: int
    number: int
    last: Mapping[str, Played]


class Moments:
    """The moments of a recording. Everything here blocks: use one thread at a time. The first one reads it all."""

    def __init__(self, recording: Objective) -> None:
        self._recording = recording
        self._points: list[_Point] = []

    def at(self, time_ns: int) -> Moment:
        """What the recording showed at a time (ns). Raises `CorruptRecording` if the file has changed."""
        if time_ns < self._recording.start_ns:
            return Moment(0, ())
        if not self._points:
            self._points = self._read_points()
        # The time of a point is that of its first message, which the point itself does not have.
        place = bisect_right(self._points, time_ns, key=lambda point: point.time_ns) - 1
        index, last = self._points[place].number, dict(self._points[place].last)
        for message in self._recording.messages(from_index=index):
            if message.log_time_ns > time_ns:
                break
            index += 1
            _note(last, message)
        return Moment(index, tuple(sorted(last.values(), key=lambda message: message.log_time_ns)))

    def _read_points(self) -> list[_Point]:
        step = max(1, -(-self._recording.count // POINTS))
        points: list[_Point] = []
        last: dict[str, Played] = {}
        remembered, since = 0, dict[str, int]()
        for index, message in enumerate(self._recording.messages()):
            if index % step == 0:
                remembered += sum(since.values())
                if points and remembered > REMEMBERED:
                    break
                points.append(_Point(message.log_time_ns, index, dict(last)))
                since = {}
            if _note(last, message):
                since[message.topic] = len(message.payload)
        return points


def _note(last: dict[str, Played], message: Played) -> bool:
    """Remember a message as the last one of its topic, unless there are too many topics."""
    if message.topic not in last and len(last) >= TOPICS:
        return False
    last[message.topic] = message
    return True
