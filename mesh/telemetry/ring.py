"""The last events of a process, for whoever asks: bounded in number and in bytes."""

from __future__ import annotations

import secrets
import threading
import time
from collections import deque
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

from msgspec.structs import replace

from mesh.errors import InputError
from mesh.telemetry.events import moment
from schemas.logs import LEVELS, LogsRead
from schemas.records import MAX_RECORD_SIZE

if TYPE_CHECKING:
    from collections.abc import Iterator

    from schemas.logs import LogEvent, ReadLogs

MOST: Final = 2_000
"""Events that are kept."""
MOST_BYTES: Final = 2 * 1024 * 1024
"""Bytes of all events that are kept, as they travel."""
REPLY: Final = MAX_RECORD_SIZE - 4_096
"""Bytes of events in a reply; the rest of a record is for what else it says."""


class Kept(NamedTuple):
    """An event, and how many bytes it has as it travels."""

    event: LogEvent
    size: int


class Ring:
    """Keeps the last events, numbered from 1 on. Every method may be called from any thread."""

    def __init__(self, *, most: int = MOST, most_bytes: int = MOST_BYTES) -> None:
        self.instance: Final = secrets.token_hex(8)
        """The name of this run of the process."""
        self.began: Final = moment(time.time())
        self._most = most
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        self._kept: deque[Kept] = deque()
        self._bytes = 0
        self._last = 0

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def size(self) -> int:
        """Bytes of what is kept, as it travels."""
        return self._bytes

    def add(self, event: LogEvent) -> None:
        """Keep an event; the oldest make room for it."""
        with self._lock:
            self._last += 1
            event = replace(event, sequence=self._last)
            size = len(event.encode())
            self._kept.append(Kept(event, size))
            self._bytes += size
            while len(self._kept) > self._most or self._bytes > self._most_bytes:
                self._bytes -= self._kept.popleft().size

    def read(self, asked: ReadLogs, *, address: str = "", role: str = "") -> LogsRead:
        """As many of the events asked for as fit into a reply.

        Those of others than `address` in the same process are left out (empty: none are). Raises `InputError` for a
        level that there isn't.
        """
        if asked.level not in LEVELS:
            raise InputError(f"{asked.level[:20]!r} is no level", hint=f"one of {', '.join(LEVELS)}")
        least, liability = LEVELS.index(asked.level), asked.liability.lower()

        def wanted(event: LogEvent) -> bool:
            return (
                LEVELS.index(event.level) >= least
                and (not address or event.address in ("", address))
                and (not liability or event.liability.lower() == liability)
            )

        with self._lock:
            kept, last = list(self._kept), self._last
        first = last - len(kept) + 1
        if (after := asked.after.get(self.instance)) is None:
            newest = [one for one in kept if wanted(one.event)][-asked.lines :] if asked.lines > 0 else []
            missed, found = 0, newest
        else:
            missed = max(0, first - after - 1)
            found = [one for one in islice(kept, max(0, after + 1 - first), None) if wanted(one.event)]
        entries = tuple(_fitting(found))
        more = len(entries) < len(found)
        return LogsRead(
            instance=self.instance,
            began=self.began,
            role=role,
            entries=entries,
            last=entries[-1].sequence if more else last,
            more=more,
            missed=missed,
        )


def _fitting(found: list[Kept]) -> Iterator[LogEvent]:
    """Those that go into one reply. An event alone always does."""
    room = REPLY
    for event, size in found:
        room -= size + 1
        if room < 0:
            return
        yield event
