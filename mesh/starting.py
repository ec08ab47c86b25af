"""Starting a server while a dependency is missing: a file, the router, the node, contracts, a stake.

By default the server exits with an error. With `connect_timeout = -1` it retries, and logs once what it waits for. So
does every server that runs already when another chain takes the place of the one that it served on.
"""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

from mesh.errors import ChainError, ConfigurationError, RemoteError
from mesh.log_context import log_event
from mesh.outage_log import OutageLog
from mesh.retry import Backoff, RetryPolicy

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator, Sequence
    from contextlib import AbstractAsyncContextManager, AsyncExitStack
    from pathlib import Path

    from mesh.chain import ChainWentBack
    from mesh.settings import NetworkSettings, Settings

log = logging.getLogger(__name__)

STARTUP: Final = RetryPolicy(initial=0.5, ceiling=5.0)
"""Shorter delays than elsewhere: on start, someone is usually setting up the missing parts."""

T = TypeVar("T")
S = TypeVar("S", bound="NetworkSettings")


class FilesMissing(ConfigurationError, code="files-missing"):
    """Files that the settings name do not exist."""

    def __init__(self, files: Sequence[str]) -> None:
        super().__init__(f"missing files: {', '.join(files)}")
        self.files = tuple(files)


class FilesNotReadable(ConfigurationError, code="files-not-readable"):
    """The user has no permission to read files that the settings name."""

    def __init__(self, files: Sequence[str]) -> None:
        user = os.geteuid()
        super().__init__(
            f"user {user} has no permission to read {', '.join(files)}",
            hint=f"change the owner: chown -R {user} FOLDER",
        )
        self.files = tuple(files)


def waits_forever(settings: NetworkSettings) -> bool:
    """Whether a server with these settings waits for what is missing."""
    return settings.connect_timeout < 0


async def wait_for_files(settings: Settings, *, retry: RetryPolicy = STARTUP) -> None:
    """Wait until the files that the settings name are readable, if the settings say to wait."""
    import asyncio  # here, as an edge agent has no event loop

    for delay in file_delays(settings, retry=retry):
        await asyncio.sleep(delay)


def file_delays(settings: Settings, *, retry: RetryPolicy = STARTUP) -> Iterator[float]:
    """Yield the seconds until the next check, as long as a file that the settings name is not readable.

    Ends at once if the settings don't say to wait; reading the file then reports the error.
    """
    outages, backoff = OutageLog(log, "files"), Backoff(retry)
    while waits_forever(settings) and (error := _file_error(settings)) is not None:
        outages.failed(error, "waiting for files")
        delay = backoff.next_delay()
        if delay is None:
            return
        yield delay
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
    """Await `serve(settings)`; and again each time that the chain it served on is gone, such as a development chain
    that was started afresh. From the second time on, the settings say to wait for what is missing.

    `place` is called after a failure and names the chain that was served on, None if there was none yet. Other errors
    are raised, and so is one about a chain that was given up before: it is the same, and can't be followed.
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
    from mesh.running import cause_of

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
        return FilesNotReadable(unreadable)
    return FilesMissing(missing) if missing else None


def _required_files(settings: Settings) -> Iterator[Path]:
    from pathlib import Path

    for option in ("roster", "tls_ca", "tls_certificate", "tls_key", "keyfile", "keyfile_password_file"):
        if path := getattr(settings, option):
            yield Path(path).expanduser()
