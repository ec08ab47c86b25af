"""The log of a process: every event a line on stderr, and the last ones kept for whoever asks."""

from __future__ import annotations

import logging
import sys
import threading
from typing import TYPE_CHECKING, Final

from mesh.telemetry import context
from mesh.telemetry.events import event_of, human_line, json_line
from mesh.telemetry.ring import Ring

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Any

    from mesh.settings import Settings
    from mesh.telemetry.context import LogSource
    from schemas.logs import LogEvent

log = logging.getLogger(__name__)

OTHERS: Final = ("aiohttp", "asyncio", "eth", "eth_tester", "urllib3", "web3", "websockets", "zenoh")
"""Loggers of libraries, which tell more than an operator wants to know, and what is none of his."""


class Log(logging.Handler):
    """Keeps events in `ring`, and writes them to stderr with `line` (None: does not write)."""

    def __init__(self, line: Any = None, *, speaker: LogSource = context.NOBODY) -> None:
        super().__init__()
        self.ring: Final = Ring()
        self.speaker = speaker
        """Who speaks where nobody is said to: in the threads of libraries."""
        self._line = line

    @property
    def writes_json(self) -> bool:
        """Whether every line is to be a JSON object."""
        return self._line is json_line

    def emit(self, record: logging.LogRecord) -> None:
        """Keep and write an event. What can't be put into words is told as such."""
        try:
            event = event_of(record, default=self.speaker)
        except Exception:  # wrong arguments of a log call, or something of a stranger whose `str` fails
            words = f"what {record.pathname}:{record.lineno} logs can't be put into words: {record.msg!r}"
            record = logging.LogRecord(
                record.name, logging.ERROR, record.pathname, record.lineno, "%s", (words,), sys.exc_info()
            )
            event = event_of(record, default=self.speaker)
        self.ring.add(event)
        if not (getattr(record, "is_said", False) and not self.writes_json):
            self._write(event)

    def _write(self, event: LogEvent) -> None:
        if self._line is None:
            return
        try:
            sys.stderr.write(f"{self._line(event)}\n")
            sys.stderr.flush()
        except (OSError, ValueError):
            pass  # nobody reads stderr any more, or it is closed: there is no place left to say so but the ring


def start_log(*, level: str = "info", form: str = "human", role: str = "") -> None:
    """Write the log to stderr, a line an event, from `level` on, in the format `form` (`human` or `json`).

    `role` is what this process is. Does nothing where logging is set up already.
    """
    root = logging.getLogger()
    if root.handlers:
        return
    handler = Log(json_line if form == "json" else human_line, speaker=context.LogSource(role))
    root.addHandler(handler)
    least = getattr(logging, level.upper())
    root.setLevel(least)
    if least > logging.DEBUG:
        for name in OTHERS:
            logging.getLogger(name).setLevel(max(least, logging.WARNING))
    logging.captureWarnings(True)
    if handler.writes_json:
        sys.excepthook = _uncaught
        threading.excepthook = _uncaught_in_thread
        sys.unraisablehook = _unraisable
    elif least <= logging.DEBUG:
        import zenoh  # its own log, in its own format

        zenoh.init_log_from_env_or("info")


def start_log_of(settings: Settings, role: str) -> None:
    """Write the log as the settings say; `role` is what this process is."""
    start_log(level=settings.log_level, form=settings.log_format, role=role)


def keep_log() -> None:
    """Keep the last events of a program that writes its log in its own way, for the service `logs` of its agents.

    Call it after the program has set up its logging. What that holds back is not kept either.
    """
    if own_log() is None:
        logging.getLogger().addHandler(Log())


def own_log() -> Log | None:
    """The log of this process; None where a program logs in its own way, and keeps nothing."""
    return next((handler for handler in logging.getLogger().handlers if isinstance(handler, Log)), None)


def writes_json() -> bool:
    """Whether everything that this process says is to be a JSON object a line."""
    own = own_log()
    return own is not None and own.writes_json


def introduce(who: LogSource) -> None:
    """Say as whom this process speaks, where it is known by its role only so far."""
    own = own_log()
    if own is not None and own.speaker == context.LogSource(who.role):
        own.speaker = who


def _uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if not isinstance(error, KeyboardInterrupt):
        log.critical("the program failed", exc_info=(kind, error, trace))


def _unraisable(found: sys.UnraisableHookArgs) -> None:
    """What nobody can catch, as it is raised in a finalizer or a callback of C."""
    error = found.exc_value
    if error is not None:
        words = found.err_msg or "raised where nobody can catch it"
        log.error("%s: %r", words, found.object, exc_info=(type(error), error, error.__traceback__))


def _uncaught_in_thread(arguments: threading.ExceptHookArgs) -> None:
    error = arguments.exc_value
    if error is not None:
        name = arguments.thread.name if arguments.thread is not None else "that is gone"
        log.critical("the thread %s failed", name, exc_info=(type(error), error, error.__traceback__))
