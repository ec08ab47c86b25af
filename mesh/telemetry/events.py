"""Events of the log: what is known of each, and how it is written: as a line for people, or a JSON object."""

from __future__ import annotations

import json
import re
import traceback
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace

from mesh.telemetry import context
from schemas.logs import LEVELS, LogEvent

if TYPE_CHECKING:
    import logging

    from mesh.telemetry.context import LogSource

LONGEST_MESSAGE: Final = 4_000
"""Characters of a message that are kept, and of an error; an event must fit into a reply."""
LONGEST_TRACE: Final = 12_000
"""Characters of a traceback that are kept, the last ones."""
LARGEST: Final = 40_000
"""Bytes of an event as it travels; what is larger, as it has to be written with many escapes, is cut to `SHORT`."""
SHORT: Final = 1_000
MOST_FACTS: Final = 16
MARGIN: Final = "    | "
"""Before the lines of a traceback, which may quote a stranger: none can be taken for an event."""
_URL: Final = re.compile(r"\b(?:https?|wss?)://[^\s'\"<>]+")
_USER: Final = re.compile(r"//[^/?#]*@")
_KEY: Final = re.compile(r"/(?!Qm)[\w-]{16,}")
_QUERY: Final = re.compile(r"\?.*", re.DOTALL)
NAMES: Final = frozenset(LogEvent.__struct_fields__)
"""No fact can have the name of a field."""


def event_of(record: logging.LogRecord, *, default: LogSource = context.NOBODY) -> LogEvent:
    """What `record` says, in its context; `default` speaks where nobody is said to."""
    who = context.speaker()
    if who is context.NOBODY:
        who = default
    error = record.exc_info[1] if record.exc_info else None
    event = LogEvent(
        time=moment(record.created),
        level=level_of(record.levelno),
        logger=record.name,
        event=getattr(record, "event", ""),
        message=_cut(_encodable(record.getMessage()), LONGEST_MESSAGE),
        role=who.role,
        address=who.address,
        lighthouse=who.lighthouse,
        liability=context.liability(),
        facts=_facts(getattr(record, "facts", {})),
        error="" if error is None else _cut(_encodable(_name(error)), SHORT),
        trace="" if error is None else _encodable("".join(traceback.format_exception(error)))[-LONGEST_TRACE:],
    )
    if len(event.encode()) > LARGEST:
        event = replace(event, message=_cut(event.message, SHORT), trace=event.trace[-SHORT:], facts={})
    return event


def json_line(event: LogEvent) -> str:
    """The event as one JSON object of ASCII; what is empty is left out."""
    fields: dict[str, Any] = {name: getattr(event, name) for name in event.__struct_fields__}
    fields |= {name: value for name, value in event.facts.items() if name not in NAMES}
    del fields["facts"]
    return json.dumps({name: value for name, value in fields.items() if value not in ("", 0)})


def human_line(event: LogEvent) -> str:
    """The event as people read it: local time, level, the contract, the words; below it where an error was raised."""
    about = f"{event.liability}: " if event.liability else ""
    line = escaped(f"{_clock(event.time)} {event.level.upper():<7} {about}{event.message}")
    return "\n".join([line, *(MARGIN + escaped(part.rstrip()) for part in event.trace.splitlines())])


def escaped(text: str) -> str:
    """The text on one line, unable to steer a terminal: what can't be printed is written as Python would."""
    if text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape", "surrogatepass").decode() for letter in text
    )


def without_secrets(text: str) -> str:
    """The text without what may open doors in the URLs it quotes: names and passwords, keys in the path, queries.

    Providers of nodes of the chain have their customers' keys in the path.
    """
    return _URL.sub(_without_secrets, text) if "://" in text else text


def moment(seconds: float) -> str:
    """A time since the epoch, in ISO 8601, UTC, with milliseconds."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def level_of(number: int) -> str:
    """The name of a level; one of Python's that lies between two is the lower."""
    place = min(max(number // 10, 1), len(LEVELS))
    return LEVELS[place - 1]


def _facts(found: dict[str, str]) -> dict[str, str]:
    return {name: _cut(_encodable(value), SHORT) for name, value in list(found.items())[:MOST_FACTS]}


def _name(error: BaseException) -> str:
    said = str(error)
    return f"{type(error).__name__}: {said}" if said else type(error).__name__


def _cut(text: str, longest: int) -> str:
    if len(text) <= longest:
        return text
    return f"{text[:longest]}… ({len(text) - longest:,} characters more)"


def _encodable(text: str) -> str:
    """Without secrets, and without the halves of characters that stand for undecodable bytes, as in names of files."""
    return without_secrets(text).encode("utf-8", "backslashreplace").decode()


def _without_secrets(found: re.Match[str]) -> str:
    scheme, host, path = re.split(r"(?<=//)([^/?#]*)", _USER.sub("//", found[0]), maxsplit=1)
    return f"{scheme}{host}{_QUERY.sub('?…', _KEY.sub('/…', path))}"


def _clock(time: str) -> str:
    """The local time of day. What comes from elsewhere need not be one."""
    try:
        return f"{datetime.fromisoformat(time).astimezone():%H:%M:%S}"
    except (ValueError, OverflowError, OSError):
        return "--:--:--"
