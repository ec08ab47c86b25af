"""Log records as `LogEvent`s, and how an event is written: as a line for people, or as a JSON object."""

from __future__ import annotations

import json
import re
import traceback
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace

from mesh import log_context as context
from schemas.logs import LEVELS, LogEvent

if TYPE_CHECKING:
    import logging

    from mesh.log_context import LogSource

MAX_MESSAGE: Final = 4_000
"""Characters kept of a message; an event must fit into a reply."""
MAX_TRACEBACK: Final = 12_000
"""Characters kept of a traceback: the last ones."""
MAX_EVENT: Final = 40_000
"""Bytes of an encoded event. A larger one (with many escapes) has its texts cut to `MAX_SHORT_TEXT`."""
MAX_SHORT_TEXT: Final = 1_000
MAX_FACTS: Final = 16
MARGIN: Final = "    | "
"""Before each line of a traceback. It may quote untrusted text, which must not pass for an event."""
FIELDS: Final = frozenset(LogEvent.__struct_fields__)
"""Names that a fact can't have."""
_URL: Final = re.compile(r"\b(?:https?|wss?)://[^\s'\"<>]+")
_USER: Final = re.compile(r"//[^/?#]*@")
_KEY: Final = re.compile(r"/(?!Qm)[\w-]{16,}")
_QUERY: Final = re.compile(r"\?.*", re.DOTALL)


def event_of(record: logging.LogRecord, *, default: LogSource = context.UNKNOWN_SOURCE) -> LogEvent:
    """The event of a log record in the current context; `default` is its source where the context has none."""
    source = context.current_source()
    if source is context.UNKNOWN_SOURCE:
        source = default
    error = record.exc_info[1] if record.exc_info else None
    facts = _facts(getattr(record, "facts", {}))
    event = LogEvent(
        time=timestamp(record.created),
        level=level_of(record.levelno),
        logger=record.name,
        event=getattr(record, "event", ""),
        message=_cut(_encodable(record.getMessage()), MAX_MESSAGE),
        role=source.role,
        address=source.address,
        lighthouse=source.lighthouse,
        liability=context.current_liability() or facts.get("liability", ""),
        facts=facts,
        error="" if error is None else _cut(_encodable(_describe(error)), MAX_SHORT_TEXT),
        trace="" if error is None else _encodable("".join(traceback.format_exception(error)))[-MAX_TRACEBACK:],
    )
    if len(event.encode()) > MAX_EVENT:
        message, trace = _cut(event.message, MAX_SHORT_TEXT), event.trace[-MAX_SHORT_TEXT:]
        event = replace(event, message=message, trace=trace, facts={})
    return event


def json_line(event: LogEvent) -> str:
    """The event as one JSON object in ASCII. Facts are members of it; empty fields are left out."""
    fields: dict[str, Any] = {name: getattr(event, name) for name in event.__struct_fields__}
    fields |= {name: value for name, value in event.facts.items() if name not in FIELDS}
    del fields["facts"]
    return json.dumps({name: value for name, value in fields.items() if value not in ("", 0)})


def human_line(event: LogEvent) -> str:
    """The event for people: local time, level, liability, message; below it the traceback of an error."""
    about = f"{event.liability}: " if event.liability else ""
    line = printable(f"{_local_time(event.time)} {event.level.upper():<7} {about}{event.message}")
    return "\n".join([line, *(MARGIN + printable(part.rstrip()) for part in event.trace.splitlines())])


def printable(text: str) -> str:
    """The text on one line, with unprintable characters escaped as in Python, so that it can't control a terminal."""
    if text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape", "surrogatepass").decode() for letter in text
    )


def without_secrets(text: str) -> str:
    """The text without the secrets of URLs in it: user names and passwords, keys in the path, queries.

    Node providers put their customers' keys in the path.
    """
    return _URL.sub(_without_secrets, text) if "://" in text else text


def timestamp(seconds: float) -> str:
    """Seconds since the epoch as ISO 8601, UTC, with milliseconds."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def level_of(number: int) -> str:
    """The name of a level; a number between two levels counts as the lower."""
    place = min(max(number // 10, 1), len(LEVELS))
    return LEVELS[place - 1]


def _facts(found: dict[str, str]) -> dict[str, str]:
    return {name: _cut(_encodable(value), MAX_SHORT_TEXT) for name, value in list(found.items())[:MAX_FACTS]}


def _describe(error: BaseException) -> str:
    text = str(error)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _cut(text: str, longest: int) -> str:
    if len(text) <= longest:
        return text
    return f"{text[:longest]}… ({len(text) - longest:,} characters more)"


def _encodable(text: str) -> str:
    """The text without secrets and without lone surrogates, which stand for undecodable bytes in file names."""
    return without_secrets(text).encode("utf-8", "backslashreplace").decode()


def _without_secrets(found: re.Match[str]) -> str:
    scheme, host, path = re.split(r"(?<=//)([^/?#]*)", _USER.sub("//", found[0]), maxsplit=1)
    return f"{scheme}{host}{_QUERY.sub('?…', _KEY.sub('/…', path))}"


def _local_time(time: str) -> str:
    """The local time of day; dashes if another process sent something that is no time."""
    try:
        return f"{datetime.fromisoformat(time).astimezone():%H:%M:%S}"
    except (ValueError, OverflowError, OSError):
        return "--:--:--"
