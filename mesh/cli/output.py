"""What commands print: lines, facts, tables, JSON, progress bars, and the announcement of a server."""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import time
from contextlib import contextmanager
from functools import wraps
from typing import TYPE_CHECKING, Any, Final, ParamSpec, TypeVar

import click
import msgspec

from mesh.errors import AiraError
from mesh.role.running import INTERRUPTED, STOPPING, fail
from schemas.address import shortened

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from logging import Logger

T = TypeVar("T")
P = ParamSpec("P")

COLUMN_GAP: Final = "  "
SIZE_UNITS: Final = ("bytes", "KiB", "MiB", "GiB", "TiB")
BAR_INTERVAL: Final = 0.1
"""Seconds between two updates of a progress bar."""
SHOW_CURSOR: Final = "\x1b[?25h"


def interruptible(function: Callable[P, T]) -> Callable[P, T]:
    """Let Ctrl-C and SIGTERM raise `KeyboardInterrupt` in a command without an event loop.

    So it removes unfinished files and restores the cursor before it exits with 130.
    """

    @wraps(function)
    def run(*arguments: P.args, **options: P.kwargs) -> T:
        before = {number: signal.signal(number, signal.default_int_handler) for number in STOPPING}
        try:
            return function(*arguments, **options)
        except KeyboardInterrupt:
            if sys.stderr.isatty():  # a bar that is interrupted while it begins or ends leaves the cursor hidden
                click.echo(SHOW_CURSOR, file=sys.stderr, nl=False)
            sys.exit(INTERRUPTED)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    return run


def print_line(text: str = "") -> None:
    """Print a line to stdout. If that fails, print the reason to stderr and exit with 1."""
    try:
        click.echo(text)
    except BrokenPipeError:  # the reader closed the pipe: click ends the program quietly
        raise
    except OSError as error:
        with open(os.devnull, "w") as nowhere:  # flushing the rest of the buffer at exit would fail again
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
        fail(AiraError(f"can't write to stdout: {error.strerror}", code="output-failed"))


def print_json(value: Any) -> None:
    """Print one JSON value on a line. Structs have the field names that they have on the wire.

    Numbers that JSON can't hold exactly are printed as text, also NaN and infinity; characters that stdout can't take
    are escaped, so that nothing is lost.
    """
    plain = _exact(msgspec.to_builtins(value))
    try:
        text = msgspec.json.encode(plain).decode()
        text.encode(getattr(sys.stdout, "encoding", None) or "utf-8")
    except UnicodeEncodeError:
        text = json.dumps(plain, separators=(",", ":"))
    print_line(text)


def json_text(value: Any) -> str:
    """A value as JSON for people: bytes as base64, and NaN and infinity by these names."""
    plain = msgspec.to_builtins(value, builtin_types=(float,))
    return json.dumps(plain, ensure_ascii=False, separators=(",", ":"))


def print_facts(facts: Mapping[str, object]) -> None:
    """Print a name and its value on each line, in two columns. Values that are None are left out."""
    known = {name: str(fact) for name, fact in facts.items() if fact is not None}
    width = max(map(len, known), default=0)
    for name, fact in known.items():
        print_line(f"{name:<{width}}{COLUMN_GAP}{fact}".rstrip())


def print_result(result: Mapping[str, object], shown: Mapping[str, object] | str, *, as_json: bool) -> None:
    """Print what a command has done: `result` as JSON, or what is `shown` to people, facts or a line."""
    if as_json:
        print_json(result)
    elif isinstance(shown, str):
        print_line(shown)
    else:
        print_facts(shown)


def print_table(head: Sequence[str], rows: Sequence[Sequence[object]], *, numbers: Sequence[str] = ()) -> None:
    """Print rows below their heads, in columns as wide as needed. The columns in `numbers` are aligned to the right."""
    cells = [list(head), *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(row[place]) for row in cells) for place in range(len(head))]
    for row in cells:
        columns = zip(head, row, widths, strict=True)
        aligned = (cell.rjust(width) if name in numbers else cell.ljust(width) for name, cell, width in columns)
        print_line(COLUMN_GAP.join(aligned).rstrip())


def printable(text: str) -> str:
    """Text from others without control characters, which could control the terminal."""
    return "".join(letter if letter.isprintable() else "\ufffd" for letter in text)


def said_by(error: Exception) -> str:
    """What an error of Zenoh says, without the place in its source."""
    return str(error).partition(" at /")[0]


def plural(count: int, one: str) -> str:
    """A count with its noun: `1 block`, `2 blocks`."""
    return f"{count:,} {one}" if count == 1 else f"{count:,} {one}s"


def short_address(address: str, *, own: str | None = None) -> str:
    """An address shortened to its ends, for lines with a full address beside it; `you` for the user's own."""
    return "you" if address == own else shortened(address)


def format_size(size: int) -> str:
    """A number of bytes for people: `512 bytes`, `2.0 KiB`."""
    scaled, unit = float(size), 0
    while scaled >= 1024 and unit < len(SIZE_UNITS) - 1:
        scaled, unit = scaled / 1024, unit + 1
    return f"{size:,} bytes" if not unit else f"{scaled:.1f} {SIZE_UNITS[unit]}"


def format_duration(nanoseconds: int) -> str:
    """A duration for people: `1.5 s`, or `1:02:03` from two minutes on."""
    if nanoseconds < 120 * 10**9:
        return f"{nanoseconds / 1e9:.3f}".rstrip("0").rstrip(".") + " s"
    minutes, rest = divmod(nanoseconds // 10**9, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"


def format_time(seconds: float) -> str:
    """A Unix time in UTC, as people and spreadsheets read it: `2026-11-28 01:03:23`."""
    return time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(seconds))


def iso_time(seconds: float) -> str:
    """A Unix time in UTC for JSON: `2026-11-28T01:03:23Z`."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(seconds))


def announce(log: Logger, event: str, text: str, **fields: object) -> None:
    """Print `text`, which says that a server has started, and log it as `event` at every log level.

    Nothing is printed if the program logs in JSON. The log gets the text on one line; the event has those of `fields`
    that are text.
    """
    import logging

    from mesh.base.log_context import log_event
    from mesh.telemetry.logs import process_log

    own = process_log()
    if own is None or not own.writes_json:
        print_line(text)
    if own is not None:
        texts = {name: value for name, value in fields.items() if isinstance(value, str)}
        line = "; ".join(" ".join(part.split()) for part in text.splitlines())
        extra = log_event(event, **texts)
        record = log.makeRecord(log.name, logging.INFO, __file__, 0, "%s", (line,), None, extra=extra)
        record.is_said = True
        log.handle(record)


@contextmanager
def progress(label: str) -> Iterator[Callable[[int, int | None], None]]:
    """Show a progress bar on stderr, if that is a terminal.

    Yields a function to call, from any one thread, with the amount done and the total (None if unknown).
    """
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    with click.progressbar(length=1, label=label, file=sys.stderr, show_pos=False) as bar:
        seen, shown = 0, 0.0

        def report(done: int, total: int | None) -> None:
            nonlocal seen, shown
            if total and (done >= total or time.monotonic() >= shown + BAR_INTERVAL):
                bar.length = total
                bar.update(max(0, done - seen))
                seen, shown = max(seen, done), time.monotonic()

        yield report


async def wait_for_broken_pipe() -> None:
    """Raise `BrokenPipeError`, which ends the program quietly, when stdout is a pipe whose reader has closed it.

    A command that waits for events runs this beside its work; otherwise it would notice only when it prints. Returns at
    once if stdout is not a file of the system.
    """
    import asyncio
    import errno
    import io
    import select

    try:
        number = sys.stdout.fileno()
    except (io.UnsupportedOperation, AttributeError, ValueError):
        return
    poll = select.poll()
    poll.register(number, 0)
    while True:
        if any(event & select.POLLERR for _, event in poll.poll(0)):
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
        await asyncio.sleep(0.5)


def _exact(value: Any) -> Any:
    match value:
        case dict():
            return {name: _exact(member) for name, member in value.items()}
        case list() | tuple():
            return [_exact(member) for member in value]
        case int() if abs(value) >= 2**53:  # loses digits in programs that read JSON numbers as doubles
            return str(value)
        case float() if not math.isfinite(value):  # which JSON can't hold
            return str(value)
    return value
