"""Reading the logs of other processes: the events they keep, and new ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.network.services import Failure, ServiceFailed
from mesh.watching.queries import TIMEOUT, query_all
from schemas import InvalidRecord
from schemas.logs import LogsRead, ReadLogs

if TYPE_CHECKING:
    import zenoh

    from schemas.logs import LogEvent

ALL: Final = 1_000_000
"""Events to request from a process that started meanwhile: all that it keeps."""


class LogUpdate(NamedTuple):
    """The new events since the last poll."""

    events: list[LogEvent]
    """In order of time."""
    answered: bool = False
    more: bool = False
    """Whether there are more events already."""
    missed: int = 0
    """Events that were dropped before they could be read."""
    began: tuple[str, ...] = ()
    """Start times of processes that were not there at the last poll."""


class LogReader:
    """Reads the log served on `key`, from its last `lines` events on: call `poll` repeatedly.

    Several processes may reply, such as an agent and a provider of one account; each is followed separately. `level` is
    the lowest level, `liability` the contract that events are about (empty: any).
    """

    def __init__(
        self, session: zenoh.Session, key: str, *, lines: int, level: str = "debug", liability: str = ""
    ) -> None:
        self._session = session
        self._key = key
        self._wanted = ReadLogs(lines=lines, level=level, liability=liability)
        self._after: dict[str, int] = {}

    @property
    def instances(self) -> frozenset[str]:
        """The processes whose logs are followed."""
        return frozenset(self._after)

    async def poll(self, *, timeout: float = TIMEOUT) -> LogUpdate:
        """The events since the last poll. Raises `ServiceFailed` if all replies are errors."""
        first = not self._after
        found, failures = await self._query(timeout)
        if not found and failures:
            raise ServiceFailed("logs", failures[0].error, hint=failures[0].hint)
        events: list[LogEvent] = []
        missed, began = 0, []
        for reply in found:
            if reply.instance in self._after:
                missed += reply.missed
            elif not first:
                began.append(reply.began)
            self._after[reply.instance] = reply.last
            events += reply.entries
        # Python's sort is stable: the events of one process keep their order.
        events.sort(key=lambda event: event.time)
        more = any(reply.more for reply in found)
        return LogUpdate(events, answered=bool(found), more=more, missed=missed, began=tuple(began))

    async def _query(self, timeout: float) -> tuple[list[LogsRead], list[Failure]]:
        wanted = self._wanted
        lines = ALL if self._after else wanted.lines
        request = ReadLogs(after=self._after, lines=lines, level=wanted.level, liability=wanted.liability)
        found: dict[str, LogsRead] = {}
        failures = []
        for reply in await query_all(self._session, [self._key], payload=request.encode(), timeout=timeout):
            try:
                if reply.ok is not None:
                    # A process may reply twice: for two markets with one account.
                    read = LogsRead.decode(reply.ok.payload.to_bytes())
                    found.setdefault(read.instance, read)
                elif reply.err is not None:
                    failures.append(Failure.decode(reply.err.payload.to_bytes()))
            except InvalidRecord as error:
                if reply.ok is not None:  # Zenoh's own error says `Timeout`, which is no record
                    failures.append(Failure(f"the answer can't be read: {error}"))
        return list(found.values()), failures
