"""How a program of the mesh runs and ends: signals, errors as one line, exit codes."""

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
"""Exit code of a command that Ctrl-C kept from its end."""
STOPPING: Final = (signal.SIGINT, signal.SIGTERM)
"""The signals that ask a program to end."""
BEAT: Final = 0.1
"""Seconds between two moments at which a program that is tidying up notices a second Ctrl-C."""


def run_to_end(main: Callable[[], Coroutine[Any, Any, object]]) -> None:
    """Run what has an end; Ctrl-C and SIGTERM break it off with exit code 130. Exits 1 or 2 on errors."""
    if not _run(main):
        sys.exit(INTERRUPTED)


def run_until_stopped(
    main: Callable[[], Coroutine[Any, Any, object]], *, settings: Settings | None = None, role: str = ""
) -> None:
    """Run a server; Ctrl-C and SIGTERM are its normal end. Exits 1 or 2 on errors.

    It logs as the `settings` say, and is called `role` there.
    """
    from mesh.telemetry.logs import configure_logging, configure_logging_from

    if settings is None:
        configure_logging(role=role)
    else:
        configure_logging_from(settings, role)
    _run(main)


def fail(error: AiraError) -> NoReturn:
    """Say what is wrong, and exit: 2 for what the caller gave, 1 for the rest."""
    tell(error)
    sys.exit(2 if isinstance(error, InputError | ConfigurationError) else 1)


def tell(error: AiraError) -> None:
    """Say what is wrong and what to do in a line each, without what opens doors in the addresses that it names.

    Where a server logs in JSON, that is an event of its log.
    """
    from mesh.telemetry.context import log_event  # here, as few commands come to this
    from mesh.telemetry.events import without_secrets
    from mesh.telemetry.logs import logs_json

    if logs_json():
        log.error("%s", error, extra=log_event("failed", code=error.code, hint=error.hint))
        return
    print(f"aira: {without_secrets(str(error))} [{error.code}]", file=sys.stderr)
    if error.hint:
        print(f"      {without_secrets(error.hint)}", file=sys.stderr)


def _run(main: Callable[[], Coroutine[Any, Any, object]]) -> bool:
    """Whether `main` came to its end (false: a signal stopped it)."""
    import asyncio  # here, as the small commands need nothing of it but `fail`

    before = {number: signal.getsignal(number) for number in STOPPING}
    try:
        return asyncio.run(_until_signal(main))
    except KeyboardInterrupt:  # before the loop listens to signals, or the second Ctrl-C
        return False
    except AiraError as error:
        fail(error)
    except BaseExceptionGroup as group:
        cause = _cause(group)
        if cause is None:
            raise
        fail(cause)
    finally:
        for number, handler in before.items():
            if handler is not None:  # none was set by Python
                signal.signal(number, handler)


async def _until_signal(main: Callable[[], Coroutine[Any, Any, object]]) -> bool:
    """Run `main` as a task; the first signal cancels it, a second one has its usual effect."""
    import asyncio

    loop = asyncio.get_running_loop()
    work = loop.create_task(main(), name="main")
    stopped = False

    def stop() -> None:
        nonlocal stopped
        stopped = True
        for number in STOPPING:
            loop.remove_signal_handler(number)
        work.cancel()
        beat()

    def beat() -> None:
        """A loop without handlers sleeps on when a signal comes to another thread, or just before it goes to sleep."""
        loop.call_later(BEAT, beat)

    for number in STOPPING:
        loop.add_signal_handler(number, stop)
    try:
        await work
    except asyncio.CancelledError:
        if not stopped:
            raise
    return not stopped


def _cause(group: BaseExceptionGroup[BaseException]) -> AiraError | None:
    """The one error that explains a group, if there is one: tasks that fail together mostly fail for one reason."""
    matching, rest = group.split(AiraError)
    if matching is None or rest is not None:
        return None
    first = matching.exceptions[0]
    return _cause(first) if isinstance(first, BaseExceptionGroup) else first
