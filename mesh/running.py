"""Running a program: signals, error messages, exit codes."""

from __future__ import annotations

import logging
import signal
import sys
from typing import TYPE_CHECKING, Any, Final, NoReturn

from mesh.errors import AiraError, ConfigurationError, InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from mesh.settings import Settings

log = logging.getLogger(__name__)

INTERRUPTED: Final = 130
"""Exit code of a command that was interrupted by Ctrl-C or SIGTERM."""
STOPPING: Final = (signal.SIGINT, signal.SIGTERM)
"""The signals that stop a program."""
WAKE_INTERVAL: Final = 0.1
"""Seconds between two wake-ups of the event loop during cleanup, at which a second Ctrl-C takes effect."""


def run_to_end(main: Callable[[], Coroutine[Any, Any, object]], *, interrupted: int = INTERRUPTED) -> None:
    """Run a command; Ctrl-C and SIGTERM end it with the exit code `interrupted`, errors with 1 or 2."""
    if not _run(main):
        sys.exit(interrupted)


def run_until_stopped(
    main: Callable[[], Coroutine[Any, Any, object]], *, settings: Settings | None = None, role: str = ""
) -> None:
    """Run a server until Ctrl-C or SIGTERM, which are its normal end. Errors end it with exit code 1 or 2.

    `settings` configures its log; `role` is its name there.
    """
    from mesh.telemetry.logs import configure_logging, configure_logging_from

    if settings is None:
        configure_logging(role=role)
    else:
        configure_logging_from(settings, role)
    _run(main)


def fail(error: AiraError) -> NoReturn:
    """Report an error and exit: with 2 for an `InputError` or a `ConfigurationError`, else with 1."""
    report(error)
    sys.exit(2 if isinstance(error, InputError | ConfigurationError) else 1)


def report(error: AiraError) -> None:
    """Print an error and its hint to stderr, one line each, without secrets in URLs.

    A server that logs in JSON logs an event instead.
    """
    from mesh.log_context import log_event  # imported here because most commands never need it
    from mesh.telemetry.events import without_secrets
    from mesh.telemetry.logs import logs_json

    if logs_json():
        log.error("%s", error, extra=log_event("program-failed", code=error.code, hint=error.hint))
        return
    print(f"aira: {without_secrets(str(error))} [{error.code}]", file=sys.stderr)
    if error.hint:
        print(f"      {without_secrets(error.hint)}", file=sys.stderr)


def _run(main: Callable[[], Coroutine[Any, Any, object]]) -> bool:
    """Run `main`; returns False if a signal stopped it."""
    import asyncio  # imported here because small commands only use `fail`

    before = {number: signal.getsignal(number) for number in STOPPING}
    try:
        return asyncio.run(_until_signal(main))
    except KeyboardInterrupt:  # before the loop handles signals, or by a second Ctrl-C
        return False
    except AiraError as error:
        fail(error)
    except BaseExceptionGroup as group:
        cause = cause_of(group)
        if cause is None:
            raise
        fail(cause)
    finally:
        for number, handler in before.items():
            if handler is not None:  # None: it was not set by Python
                signal.signal(number, handler)


async def _until_signal(main: Callable[[], Coroutine[Any, Any, object]]) -> bool:
    """Run `main` as a task; the first signal cancels it, a second one has its default effect."""
    import asyncio

    loop = asyncio.get_running_loop()
    work = loop.create_task(main(), name="main")
    stopped = False

    def stop(number: int) -> None:
        nonlocal stopped
        stopped = True
        if number == signal.SIGINT and sys.stderr.isatty():
            print(file=sys.stderr)  # ends the line on which the terminal shows ^C
        for number in STOPPING:
            loop.remove_signal_handler(number)
        work.cancel()
        wake()

    def wake() -> None:
        """Keep the loop awake: without handlers a signal to another thread would not end its sleep."""
        loop.call_later(WAKE_INTERVAL, wake)

    for number in STOPPING:
        loop.add_signal_handler(number, stop, number)
    try:
        await work
    except asyncio.CancelledError:
        if not stopped:
            raise
    return not stopped


def cause_of(group: BaseExceptionGroup[BaseException]) -> AiraError | None:
    """The first error of a group that holds only `AiraError`s (they mostly have one cause); None for other groups."""
    matching, rest = group.split(AiraError)
    if matching is None or rest is not None:
        return None
    first = matching.exceptions[0]
    return cause_of(first) if isinstance(first, BaseExceptionGroup) else first
