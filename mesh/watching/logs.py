"""Reading the logs of others: what they keep of it, and what comes after that."""

from __future__ import annotations

import asyncio
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

import zenoh

from mesh.network.services import Failure, ServiceFailed
from mesh.watching.asking import ANSWERS, TIMEOUT
from schemas import InvalidRecord
from schemas.logs import LogsRead, ReadLogs

if TYPE_CHECKING:
    from schemas.logs import LogEvent

ALL: Final = 1_000_000
"""Lines to ask for of somebody who began while we watched: as many as are kept."""


class Look(NamedTuple):
    """What one look at a log has shown."""

    events: list[LogEvent]
    """In the order of their times."""
    answered: bool = False
    more: bool = False
    """Whether there is more already."""
    missed: int = 0
    """Events that were kept no more when they were asked for."""
    began: tuple[str, ...] = ()
    """When those began who were not there at the last look."""


class LogReader:
    """Reads the log that is told on `key`, from its last `lines` events on: `look`, again and again.

    Several may answer, such as an agent and a provider of one account; each is followed by itself. `level` is the least
    that is told, `liability` the contract that it has to concern (empty: any).
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

    async def look(self, *, timeout: float = TIMEOUT) -> Look:
        """What has come since the last look. Raises `ServiceFailed` when all who answer do so with an error."""
        first = not self._after
        told, failures = await self._ask(timeout)
        if not told and failures:
            raise ServiceFailed("logs", failures[0].error, hint=failures[0].hint)
        events: list[LogEvent] = []
        missed, began = 0, []
        for reply in told:
            if reply.instance in self._after:
                missed += reply.missed
            elif not first:
                began.append(reply.began)
            self._after[reply.instance] = reply.last
            events += reply.entries
        # Python's sort is stable: the events of one process keep their order.
        events.sort(key=lambda event: event.time)
        more = any(reply.more for reply in told)
        return Look(events, answered=bool(told), more=more, missed=missed, began=tuple(began))

    async def _ask(self, timeout: float) -> tuple[list[LogsRead], list[Failure]]:
        wanted = self._wanted
        lines = ALL if self._after else wanted.lines
        request = ReadLogs(after=self._after, lines=lines, level=wanted.level, liability=wanted.liability)
        asking = zenoh.CancellationToken()
        try:
            return await asyncio.to_thread(self._answers, request.encode(), timeout, asking)
        finally:
            asking.cancel()  # type: ignore[no-untyped-call]

    def _answers(
        self, request: bytes, timeout: float, asking: zenoh.CancellationToken
    ) -> tuple[list[LogsRead], list[Failure]]:
        replies = self._session.get(
            self._key,
            zenoh.handlers.FifoChannel(ANSWERS),
            payload=request,
            encoding="application/json",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
            cancellation_token=asking,
        )
        told: dict[str, LogsRead] = {}
        failures = []
        for reply in islice(replies, ANSWERS):
            try:
                if reply.ok is not None:
                    # A process may answer twice, for two markets with one account.
                    read = LogsRead.decode(reply.ok.payload.to_bytes())
                    told.setdefault(read.instance, read)
                elif reply.err is not None:
                    failures.append(Failure.decode(reply.err.payload.to_bytes()))
            except InvalidRecord as error:
                if reply.ok is not None:  # Zenoh's own error says `Timeout`, which is no record
                    failures.append(Failure(f"the answer can't be read: {error}"))
        return list(told.values()), failures
