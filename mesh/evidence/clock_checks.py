"""Checks of when a recording was made, by what its recorder wrote of its clock.

Each time a recorder opens the file, it writes the time of day and the log time that stands for it. From there it counts
by a monotonic clock, so that setting the machine's clock moves no message.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from mesh.evidence.claims import Finding
from mesh.recording import CLOCK_RECORD, RECOVERED

if TYPE_CHECKING:
    from collections.abc import Mapping

MOST_SEAMS: Final = 256
"""Crashes of one job that are believed."""
_SECOND: Final = 10**9
_LONGEST_NUMBER: Final = 20
"""Digits of a time or a number of messages."""


@dataclass(frozen=True)
class RecorderParts:
    """The parts of a recording, as its metadata state them: each begins where a recorder was opened.

    `begins` are the numbers of their first messages; the first is 0. `unix_ns` and `log_ns` are the time of day at
    which each was begun, and its log time. `fault` is why no recorder writes such metadata; empty if one does.
    """

    begins: tuple[int, ...]
    unix_ns: tuple[int, ...] = ()
    log_ns: tuple[int, ...] = ()
    fault: str = ""

    @classmethod
    def of(cls, metadata: Mapping[str, Mapping[str, str]]) -> RecorderParts:
        """The parts that the metadata of a recording state."""
        seams = _numbers(metadata.get(RECOVERED, {}).get("seams", ""))
        if seams is None or list(seams) != sorted(seams):
            return cls(
                (0,), fault=f"it does not state in order where the agent continued after at most {MOST_SEAMS} crashes"
            )
        stated = metadata.get(CLOCK_RECORD, {})
        unix, log = _numbers(stated.get("unix_ns", "")), _numbers(stated.get("log_ns", ""))
        later = tuple(seam for seam in seams if seam)
        if not unix or not log or len(unix) != len(log):
            return cls((0, *later), fault="it does not state at what time of day it was begun")
        # A part without messages may be lost with its metadata.
        at_once = len(unix) - len(later)
        if not 1 <= at_once <= 1 + len(seams) - len(later):
            return cls(
                (0, *later), fault=f"it states {len(unix)} times at which it was begun, and {len(seams)} crashes"
            )
        return cls((0,) * at_once + later, unix, log)


@dataclass
class ClockCheck:
    """Compares the times of messages, added in file order, with the clock that the recorder wrote."""

    parts: RecorderParts
    part: int = 0
    _count: int = 0
    _last: int = 0
    """The latest log time so far."""
    _counted: int = 0
    """Nanoseconds from the begin of each earlier part to its last message, together."""
    _fault: str = field(default="", init=False)

    def __post_init__(self) -> None:
        self._next = self._following()
        self._fault = self.parts.fault or self._begin_fault(0)

    def add(self, time: int) -> int:
        """Add the log time of the next message. Returns the number of its part, from 0."""
        while self._count == self._next:
            self._enter()
        self._count += 1
        if time < self._begun() and not self._fault:
            self._fault = f"message {self._count - 1} was recorded before the recorder was opened"
        self._last = max(self._last, time)
        return self.part

    def finding(self) -> Finding:
        """Whether the recorder's clock and the times of the messages agree, once all are added."""
        while self.part + 1 < len(self.parts.begins) and self.parts.begins[self.part + 1] <= self._count:
            self._enter()
        if not self._fault and self.part + 1 < len(self.parts.begins):
            self._fault = f"it states a crash after message {self.parts.begins[self.part + 1]}, and has {self._count}"
        if self._fault:
            return Finding("clock", False, self._fault)
        return Finding("clock", True, f"it was begun at {_shown(self.parts.unix_ns[0])} by the robot's clock")

    def period(self, since_ns: int, until_ns: int) -> Finding:
        """Whether it was made between these times of day, once all are added.

        What a crash adds counts as nothing: only the robot's clock says how long it took.
        """
        if not self.parts.log_ns:
            return Finding("period", False, self._fault or "it does not state when it was made")
        start = self.parts.log_ns[0]
        end = start + self._counted + max(0, self._last - self._begun())
        made = f"it was made from {_shown(start)} to {_shown(end)} by the robot's clock"
        if start < since_ns:
            return Finding("period", False, f"{made}, which begins before the job did, at {_shown(since_ns)}")
        if end > until_ns:
            return Finding("period", False, f"{made}, which ends after its result was there, at {_shown(until_ns)}")
        return Finding("period", True, made)

    def _enter(self) -> None:
        """Enter the next part."""
        self._counted += max(0, self._last - self._begun())
        self.part += 1
        self._next = self._following()
        self._fault = self._fault or self._begin_fault(self.part)

    def _following(self) -> int:
        """The number of the next part's first message; -1 if this is the last part."""
        begins = self.parts.begins
        return begins[self.part + 1] if self.part + 1 < len(begins) else -1

    def _begun(self) -> int:
        """The log time at which this part was begun."""
        return self.parts.log_ns[self.part] if self.parts.log_ns else 0

    def _begin_fault(self, part: int) -> str:
        if self.parts.fault or self.parts.log_ns[part] == max(self.parts.unix_ns[part], self._last):
            return ""
        return f"part {part + 1} of it begins at another time than the one at which its recorder was opened"


def _numbers(text: str) -> tuple[int, ...] | None:
    """Numbers separated by commas, at most `MOST_SEAMS` and one more; None for anything else."""
    words = text.split(",", MOST_SEAMS + 1) if text else []
    if len(words) > MOST_SEAMS + 1:
        return None
    if not all(word.isascii() and word.isdigit() and len(word) <= _LONGEST_NUMBER for word in words):
        return None
    return tuple(map(int, words))


def _shown(time_ns: int) -> str:
    """A time of day for people: UTC, in seconds."""
    try:
        return f"{datetime.fromtimestamp(time_ns // _SECOND, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (ValueError, OverflowError, OSError):
        return f"{time_ns} ns"
