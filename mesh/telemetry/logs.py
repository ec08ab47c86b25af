"""The log of a process: a line on stderr for each event, for people or as a JSON object, and the last events in
memory for the service `logs`.
"""

from __future__ import annotations

import json
import logging
import os
import re
import sys
import threading
import time
import traceback
from collections import deque
from contextlib import suppress
from datetime import UTC, datetime
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from msgspec.structs import replace

from mesh.base import log_context as context
from mesh.base.log_context import UNKNOWN_SOURCE, LogSource, log_event
from mesh.errors import AiraError, InputError, public_text
from schemas.records import MAX_RECORD_SIZE
from schemas.status import LEVELS, LogEvent, LogsRead

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import TracebackType

    from mesh.settings import TelemetrySettings
    from schemas.status import ReadLogs


log = logging.getLogger(__name__)


class LogEventLimits(NamedTuple):
    """How much is kept of one event; it must fit into a reply."""

    message: int = 4_000
    """Characters of a message."""
    trace: int = 12_000
    """Characters of a traceback: the last ones."""
    short: int = 1_000
    """Characters of an error, and of a fact."""
    size: int = 40_000
    """Bytes when encoded. A larger event (with many escapes) has a short message and traceback, and no facts."""


LOG_EVENT_LIMITS: Final = LogEventLimits()
MARGIN: Final = "    | "
"""Before each line of a traceback. It may quote untrusted text, which must not pass for an event."""
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
    found: dict[str, str] = getattr(record, "facts", {})
    facts = {name: _cut(_encodable(value), LOG_EVENT_LIMITS.short) for name, value in list(found.items())[:16]}
    raised = "" if error is None else f"{type(error).__name__}: {error}".removesuffix(": ")
    event = LogEvent(
        time=timestamp(record.created),
        level=level_of(record.levelno),
        logger=record.name,
        event=getattr(record, "event", ""),
        message=_cut(_encodable(record.getMessage()), LOG_EVENT_LIMITS.message),
        role=source.role,
        address=source.address,
        lighthouse=source.lighthouse,
        liability=context.current_liability() or facts.get("liability", ""),
        facts=facts,
        error=_cut(_encodable(raised), LOG_EVENT_LIMITS.short),
        trace=""
        if error is None
        else _encodable("".join(traceback.format_exception(error)))[-LOG_EVENT_LIMITS.trace :],
    )
    if len(event.encode()) > LOG_EVENT_LIMITS.size:
        message, trace = _cut(event.message, LOG_EVENT_LIMITS.short), event.trace[-LOG_EVENT_LIMITS.short :]
        event = replace(event, message=message, trace=trace, facts={})
    return event


def json_line(event: LogEvent) -> str:
    """The event as one JSON object in ASCII. Facts are members of it, unless a field of that name has a value.

    What is empty is left out.
    """
    fields: dict[str, Any] = {name: getattr(event, name) for name in event.__struct_fields__ if name != "facts"}
    shown = {name: value for name, value in fields.items() if value not in ("", 0)}
    return json.dumps(shown | {name: value for name, value in event.facts.items() if value and name not in shown})


def human_line(event: LogEvent) -> str:
    """The event for people: local time, level, liability, message; below it the traceback of an error."""
    about = f"{event.liability}: " if event.liability else ""
    return printable(f"{_local_time(event.time)} {event.level.upper():<7} {about}") + text_lines(event)


def text_lines(event: LogEvent) -> str:
    """The message alone, and below it the traceback of an error."""
    lines = [printable(event.message), *(MARGIN + printable(part.rstrip()) for part in event.trace.splitlines())]
    return "\n".join(lines)


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


LIBRARIES: Final = (
    "aiohttp",
    "asyncio",
    "eth",
    "eth_tester",
    "mcp",
    "urllib3",
    "uvicorn",
    "web3",
    "websockets",
    "zenoh",
)
"""Loggers of libraries; below level debug only their warnings are shown."""


class LogBufferLimits(NamedTuple):
    """How much of its log a process keeps."""

    events: int = 2_000
    """Events."""
    size: int = 2 << 20
    """Bytes of encoded events."""
    reply: int = MAX_RECORD_SIZE - 4_096
    """Bytes of events in a reply; the rest of the record is for its other fields."""


BUFFER_LIMITS: Final = LogBufferLimits()


class _BufferedEvent(NamedTuple):
    event: LogEvent
    size: int
    """Bytes of the encoded event."""


class LogBuffer:
    """Keeps the last events of a process, numbered from 1. Every method may be called from any thread."""

    def __init__(self, *, max_events: int = BUFFER_LIMITS.events, max_bytes: int = BUFFER_LIMITS.size) -> None:
        self.instance: Final = os.urandom(8).hex()
        """Identifies this run of the process."""
        self.began: Final = timestamp(time.time())
        self._max_events = max_events
        self._max_bytes = max_bytes
        self._lock = threading.Lock()
        self._events: deque[_BufferedEvent] = deque()
        self._bytes = 0
        self._last = 0

    def __len__(self) -> int:
        return len(self._events)

    @property
    def size(self) -> int:
        """Bytes of all kept events, encoded."""
        return self._bytes

    def add(self, event: LogEvent) -> None:
        """Keep an event and drop the oldest ones beyond the limits."""
        with self._lock:
            self._last += 1
            event = replace(event, sequence=self._last)
            size = len(event.encode())
            self._events.append(_BufferedEvent(event, size))
            self._bytes += size
            while len(self._events) > self._max_events or self._bytes > self._max_bytes:
                self._bytes -= self._events.popleft().size

    def read(self, request: ReadLogs, *, address: str = "", role: str = "") -> LogsRead:
        """The requested events, as many as fit into a reply.

        With `address`, events of other accounts in the same process are left out. Raises `InputError` for an unknown
        level.
        """
        wanted = _filter(request, address)
        with self._lock:
            events, last = list(self._events), self._last
        first = last - len(events) + 1
        if (after := request.after.get(self.instance)) is None:
            newest = [one for one in events if wanted(one.event)][-request.lines :] if request.lines > 0 else []
            missed, found = 0, newest
        else:
            missed = max(0, first - after - 1)
            found = [one for one in islice(events, max(0, after + 1 - first), None) if wanted(one.event)]
        entries = tuple(_that_fit(found))
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


def _filter(request: ReadLogs, address: str) -> Callable[[LogEvent], bool]:
    """Whether an event is one of those requested. Raises `InputError`."""
    if request.level not in LEVELS:
        raise InputError(f"there is no log level {request.level[:20]!r}", hint=f"one of {', '.join(LEVELS)}")
    least, liability = LEVELS.index(request.level), request.liability.lower()
    return lambda event: (
        LEVELS.index(event.level) >= least
        and (not address or event.address in ("", address))
        and (not liability or event.liability.lower() == liability)
    )


def _that_fit(found: list[_BufferedEvent]) -> Iterator[LogEvent]:
    """The first events that fit into one reply. A single event always does."""
    left = BUFFER_LIMITS.reply
    for event, size in found:
        left -= size + 1
        if left < 0:
            return
        yield event


class LogHandler(logging.Handler):
    """Keeps events in `buffer` and writes each to stderr with `format_line` (None: does not write)."""

    def __init__(
        self,
        format_line: Callable[[LogEvent], str] | None = None,
        *,
        source: LogSource = UNKNOWN_SOURCE,
        buffer: LogBuffer | None = None,
    ) -> None:
        super().__init__()
        self.buffer: Final = LogBuffer() if buffer is None else buffer
        self.source = source
        """The source of events without a `source_context`, as in the threads of libraries."""
        self._format_line = format_line

    @property
    def writes_json(self) -> bool:
        """Whether every line is a JSON object."""
        return self._format_line is json_line

    def emit(self, record: logging.LogRecord) -> None:
        """Keep and write an event. A record that can't be formatted becomes an error event that says so."""
        try:
            event = event_of(record, default=self.source)
        except Exception:  # wrong arguments of the log call, or an argument whose `str` fails
            message = f"{record.pathname}:{record.lineno} logs what can't be formatted: {record.msg!r}"
            record = logging.LogRecord(
                record.name, logging.ERROR, record.pathname, record.lineno, "%s", (message,), sys.exc_info()
            )
            vars(record).update(log_event("record-malformed"))
            event = event_of(record, default=self.source)
        self.buffer.add(event)
        if self._format_line is None or (getattr(record, "is_said", False) and not self.writes_json):
            return
        with suppress(OSError, ValueError):  # stderr is closed; the event is in the buffer
            sys.stderr.write(f"{self._format_line(event)}\n")
            sys.stderr.flush()


class LogService:
    """The service `logs` of a role: its last events, for everyone whom the router lets ask.

    It changes nothing and is as open as `status`: on a router without a roster to everyone on the machine, on a closed
    site to operators. No event holds a key or a password. In a process with several roles, each serves its own events.
    """

    def __init__(self, role: str, address: str) -> None:
        self._role = role
        self._address = address

    async def logs(self, request: ReadLogs) -> LogsRead:
        """The requested events. Raises `AiraError`, `InputError`."""
        return self.read(request)

    def read(self, request: ReadLogs) -> LogsRead:
        """The same for callers without an event loop."""
        handler = process_log()
        if handler is None:
            raise AiraError(
                f"this {self._role} is part of a program that keeps no log",
                hint="the program may call mesh.telemetry.logs.keep_log()",
                code="log-not-kept",
            )
        found = handler.buffer.read(request, address=self._address, role=self._role)
        return replace(found, entries=tuple(map(_public, found.entries)))


def _public(event: LogEvent) -> LogEvent:
    """The event as strangers may read it. Its own limits are kept: nothing gets longer."""
    message, error, trace = (
        public_text(text, longest=LOG_EVENT_LIMITS.trace) for text in (event.message, event.error, event.trace)
    )
    facts = {name: public_text(value, longest=LOG_EVENT_LIMITS.trace) for name, value in event.facts.items()}
    return replace(event, message=message, error=error, trace=trace, facts=facts)


def configure_logging(*, level: str = "info", form: str = "human", role: str = "") -> None:
    """Write events from `level` on to stderr, one per line, as `form` says (`human` or `json`).

    `role` names this process. Does nothing if the program has set up logging already.
    """
    root = logging.getLogger()
    if root.handlers:
        return
    handler = LogHandler(json_line if form == "json" else human_line, source=LogSource(role))
    root.addHandler(handler)
    least = getattr(logging, level.upper())
    root.setLevel(least)
    if least > logging.DEBUG:
        for name in LIBRARIES:
            logging.getLogger(name).setLevel(max(least, logging.WARNING))
    logging.captureWarnings(True)
    if handler.writes_json:
        sys.excepthook = _uncaught
        threading.excepthook = _uncaught_in_thread
        sys.unraisablehook = _unraisable
    elif least <= logging.DEBUG:
        import zenoh  # its own log, in its own format

        zenoh.init_log_from_env_or("info")


def configure_logging_from(settings: TelemetrySettings, role: str) -> None:
    """Configure logging as the settings say; `role` names this process."""
    configure_logging(level=settings.log_level, form=settings.log_format, role=role)


def keep_log(*, max_events: int = BUFFER_LIMITS.events) -> None:
    """Keep the last events of a program that logs in its own way, for the service `logs` of its agents.

    Call it after the program has set up its logging. Events that its level holds back are not kept.
    """
    if process_log() is None:
        logging.getLogger().addHandler(LogHandler(buffer=LogBuffer(max_events=max_events)))


def process_log() -> LogHandler | None:
    """The log handler of this process; None if the program logs in its own way and keeps nothing."""
    return next((handler for handler in logging.getLogger().handlers if isinstance(handler, LogHandler)), None)


def logs_json() -> bool:
    """Whether everything that this process writes has to be one JSON object per line."""
    handler = process_log()
    return handler is not None and handler.writes_json


def set_process_source(source: LogSource) -> None:
    """Set the source of this process's events, if only its role is known so far."""
    handler = process_log()
    if handler is not None and handler.source == LogSource(source.role):
        handler.source = source


def _uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if not isinstance(error, KeyboardInterrupt):
        log.critical("the program failed", exc_info=(kind, error, trace), extra=log_event("program-failed"))


def _unraisable(found: sys.UnraisableHookArgs) -> None:
    """Log an error raised where nothing can catch it, as in a finalizer or a callback from C."""
    error = found.exc_value
    if error is not None:
        message = found.err_msg or "raised where nothing can catch it"
        info = (type(error), error, error.__traceback__)
        log.error("%s: %r", message, found.object, exc_info=info, extra=log_event("finalizer-failed"))


def _uncaught_in_thread(arguments: threading.ExceptHookArgs) -> None:
    error = arguments.exc_value
    if error is not None:
        name = arguments.thread.name if arguments.thread is not None else "that is gone"
        info = (type(error), error, error.__traceback__)
        log.critical("the thread %s failed", name, exc_info=info, extra=log_event("thread-failed", thread=name))
