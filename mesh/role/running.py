"""Running a program: signals, error messages, exit codes; and starting while something is missing.

By default a server exits with an error if a file, the router, the node, contracts or a stake is missing. With
`connect_timeout = -1` it retries, and logs once what it waits for. So does every server that runs already when another
chain takes the place of the one that it served on.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, NoReturn, TypeVar

from mesh.base.log_context import log_event
from mesh.base.outage_log import OutageLog
from mesh.base.retry import Backoff, RetryPolicy
from mesh.errors import AiraError, ChainError, ConfigurationError, InputError, RemoteError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterator
    from contextlib import AbstractAsyncContextManager, AsyncExitStack
    from pathlib import Path

    from mesh.chain import ChainWentBack
    from mesh.settings import NetworkSettings, Settings


log = logging.getLogger(__name__)

INTERRUPTED: Final = 130
"""Exit code of a command that was interrupted by Ctrl-C or SIGTERM."""
STOPPING: Final = (signal.SIGINT, signal.SIGTERM)
"""The signals that stop a program."""


def run_to_end(main: Callable[[], Coroutine[Any, Any, object]], *, interrupted: int = INTERRUPTED) -> None:
    """Run a command; Ctrl-C and SIGTERM end it with the exit code `interrupted`, errors with 1 or 2."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_WarningFormatter())
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


class _WarningFormatter(logging.Formatter):
    """Warnings of a command that keeps no log, which Python writes to stderr: as logged, without time and level."""

    def format(self, record: logging.LogRecord) -> str:
        from mesh.telemetry.logs import event_of, text_lines

        return text_lines(event_of(record))


def fail(error: AiraError) -> NoReturn:
    """Report an error and exit: with 2 for an `InputError` or a `ConfigurationError`, else with 1."""
    report(error)
    sys.exit(2 if isinstance(error, InputError | ConfigurationError) else 1)


def report(error: AiraError) -> None:
    """Print an error and its hint to stderr, one line each, without secrets in URLs.

    A server that logs in JSON logs an event instead.
    """
    from mesh.telemetry.logs import logs_json, without_secrets

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
        """Keep the loop awake for a second Ctrl-C: without handlers, a signal to a thread would not end its sleep."""
        loop.call_later(0.1, wake)

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


STARTUP: Final = RetryPolicy(initial=0.5, ceiling=5.0)
"""Shorter delays than elsewhere: on start, someone is usually setting up the missing parts."""

T = TypeVar("T")
S = TypeVar("S", bound="NetworkSettings")


def waits_forever(settings: NetworkSettings) -> bool:
    """Whether a server with these settings waits for what is missing."""
    return settings.connect_timeout < 0


async def wait_for_files(settings: Settings) -> None:
    """Wait until the files that the settings name are readable, if the settings say to wait."""
    import asyncio  # here, as an edge agent has no event loop

    for delay in file_delays(settings):
        await asyncio.sleep(delay)


def file_delays(settings: Settings) -> Iterator[float]:
    """Yield the seconds until the next check, as long as a file that the settings name is not readable.

    Ends at once if the settings don't say to wait; reading the file then reports the error.
    """
    outages, backoff = OutageLog(log, "files"), Backoff(STARTUP)
    while waits_forever(settings) and (error := _file_error(settings)) is not None:
        outages.failed(error, "waiting for files")
        yield backoff.next_delay() or 0.0
    outages.recovered("the files are readable")


async def open_when_ready(
    stack: AsyncExitStack,
    settings: NetworkSettings,
    make: Callable[[], AbstractAsyncContextManager[T]],
    *,
    role: str,
    on_wait: Callable[[str], None] = lambda reason: None,
    retry: RetryPolicy = STARTUP,
) -> T:
    """Enter what `make` returns on `stack`. If the settings say to wait, try again after each `RemoteError`.

    `role` names the server in the log; `on_wait` is called with the reason of each failure. Raises the errors of
    entering; `RemoteError` only if the settings don't say to wait.
    """
    outages, backoff = OutageLog(log, "startup"), Backoff(retry)
    while True:
        try:
            opened = await stack.enter_async_context(make())
        except RemoteError as error:
            if not waits_forever(settings):
                raise
            on_wait(str(error))  # first: a reader of the log may ask for the health at once
            outages.failed(error, f"the {role} waits")
            if not await backoff.wait():
                raise
        else:
            outages.recovered(f"the {role} starts")
            return opened


async def serve_on_each_chain(
    settings: S, serve: Callable[[S], Awaitable[object]], *, place: Callable[[], object] = object
) -> None:
    """Await `serve(settings)`; and again each time that the chain it served on is gone: a development chain may be
    started afresh. Then the settings say to wait for what is missing.

    `place` is called after a failure and names the chain that was served on, None if there was none yet. Other errors
    are raised, and those of a chain that was given up before: that can't be followed.
    """
    served: object = None
    while True:
        try:
            await serve(settings)
            return
        except (ChainError, BaseExceptionGroup) as error:
            gone, here = _chain_gone(error), place()
            if gone is None or here is None or (gone.is_final and here == served):
                raise
            fields = log_event("chain-gone", code=gone.code)
            log.warning("the chain was started afresh (%s); serving the new one", gone, extra=fields)
            served, settings = here, replace(settings, connect_timeout=-1.0)


def _chain_gone(error: ChainError | BaseExceptionGroup[BaseException]) -> ChainWentBack | None:
    """The error that says so, if it is one."""
    from mesh.chain import ChainWentBack  # loaded before, as it is an error of a chain

    cause = cause_of(error) if isinstance(error, BaseExceptionGroup) else error
    return cause if isinstance(cause, ChainWentBack) else None


def _file_error(settings: Settings) -> ConfigurationError | None:
    """The error of the files that the settings name; None if all are readable."""
    missing, unreadable = [], []
    for path in _required_files(settings):
        try:
            path.open("rb").close()
        except FileNotFoundError:
            missing.append(str(path))
        except PermissionError:
            unreadable.append(str(path))
        except OSError:
            continue  # such as a folder that a container engine created for a missing file: reading it fails later
    if unreadable:
        user = os.geteuid()
        why = f"user {user} has no permission to read {', '.join(unreadable)}"
        return ConfigurationError(why, hint=f"change the owner: chown -R {user} FOLDER", code="files-not-readable")
    return ConfigurationError(f"missing files: {', '.join(missing)}", code="files-missing") if missing else None


def _required_files(settings: Settings) -> Iterator[Path]:
    from pathlib import Path

    for option in ("roster", "tls_ca", "tls_certificate", "tls_key", "keyfile", "keyfile_password_file"):
        if path := getattr(settings, option):
            yield Path(path).expanduser()
