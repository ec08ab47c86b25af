"""Log events, and the requests for them: the service `logs` of agents, providers, bridges and edge agents.

An event as a JSON line on stderr has the same fields. Readers ignore unknown fields.
"""

from __future__ import annotations

from collections.abc import Mapping  # msgspec reads the annotations
from typing import Final

from schemas.records import Record

LEVELS: Final = ("debug", "info", "warning", "error", "critical")
"""The levels, in ascending order."""


class LogEvent(Record, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=False):
    """One event of a log. Empty fields are not sent."""

    sequence: int = 0
    """Its number in the log of its process, from 1."""
    time: str
    """ISO 8601, UTC, with milliseconds and `Z`."""
    level: str
    """One of `LEVELS`."""
    logger: str
    """The module that logged it."""
    event: str = ""
    """The stable name of what happened (`contract-created`), for programs; empty for other programs' lines."""
    message: str
    role: str = ""
    """The role of the process: agent, provider, router, bridge, edge."""
    address: str = ""
    """The account of the process (EIP-55)."""
    lighthouse: str = ""
    liability: str = ""
    """The contract that it concerns (EIP-55)."""
    facts: Mapping[str, str] = {}
    """Further fields by name; in a JSON line they are members of the event itself."""
    error: str = ""
    """The exception, in one line."""
    trace: str = ""
    """Its traceback, with line breaks."""


class ReadLogs(Record, frozen=True, kw_only=True):
    """A request for events, the oldest first."""

    after: Mapping[str, int] = {}
    """The sequence number of the last event that the caller has, by instance."""
    lines: int = 100
    """How many of the newest events to return from an instance that is not in `after`."""
    level: str = "debug"
    """The lowest level to return, one of `LEVELS`."""
    liability: str = ""
    """Return only events that concern this contract (empty: all)."""


class LogsRead(Record, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """The reply: as many events as fit."""

    instance: str
    """An id of this run of the process; it changes at a restart."""
    began: str
    """When this run started; as `LogEvent.time`."""
    role: str = ""
    entries: tuple[LogEvent, ...] = ()
    last: int
    """The sequence number to continue from."""
    more: bool = False
    """Whether there are more events now."""
    missed: int = 0
    """How many of the requested events are no longer in memory."""


__all__ = ["LEVELS", "LogEvent", "LogsRead", "ReadLogs"]
