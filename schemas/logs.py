"""Events of a role's log, and how they are asked for: the service `logs` of agents, providers and bridges.

An event as a JSON line on stderr has the same names. These records may have fields that a reader does not know yet.
"""

from __future__ import annotations

from collections.abc import Mapping  # msgspec reads the annotations
from typing import Final

from schemas.records import Record

LEVELS: Final = ("debug", "info", "warning", "error", "critical")
"""How much an event matters, from the least."""


class LogEvent(Record, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=False):
    """Something that happened. Empty fields don't travel."""

    sequence: int = 0
    """Its number in the log of its process, from 1 on."""
    time: str
    """ISO 8601, UTC, with milliseconds and `Z`."""
    level: str
    """One of `LEVELS`."""
    logger: str
    """The module that says it."""
    event: str = ""
    """The stable name of what happened (`contract-created`), for programs; empty for other programs' lines."""
    message: str
    role: str = ""
    """What speaks: agent, provider, router, bridge, edge."""
    address: str = ""
    """Its account (EIP-55)."""
    lighthouse: str = ""
    liability: str = ""
    """The contract that it concerns (EIP-55)."""
    facts: Mapping[str, str] = {}
    """What else is known, by name; members of the event itself in a JSON line."""
    error: str = ""
    """The exception, in a line."""
    trace: str = ""
    """Where it was raised, as Python tells it, with line breaks."""


class ReadLogs(Record, frozen=True, kw_only=True):
    """Ask for events, the oldest first."""

    after: Mapping[str, int] = {}
    """What the asker has by now: the sequence number of the last event, by instance."""
    lines: int = 100
    """How many of the newest events an instance tells that is not in `after`."""
    level: str = "debug"
    """The least that is told, one of `LEVELS`."""
    liability: str = ""
    """Only what concerns this contract (empty: all)."""


class LogsRead(Record, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """As many events as fit into a reply."""

    instance: str
    """One run of the process: after a restart it is another one."""
    began: str
    """When that was; as `LogEvent.time`."""
    role: str = ""
    entries: tuple[LogEvent, ...] = ()
    last: int
    """The sequence number to ask from next."""
    more: bool = False
    """Whether there are further events already."""
    missed: int = 0
    """Events after the one that was asked from that are kept no more."""


__all__ = ["LEVELS", "LogEvent", "LogsRead", "ReadLogs"]
