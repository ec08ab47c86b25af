"""The start of a server that waits for what it needs, instead of ending with a line: for its files, a router, a node,
contracts and a stake. Asked for by `connect_timeout = -1`; what is waited for is said once."""

from __future__ import annotations

import logging
import os
from typing import TYPE_CHECKING, Final, TypeVar

from mesh.errors import ConfigurationError, RemoteError
from mesh.outage_log import OutageLog

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from contextlib import AbstractAsyncContextManager, AsyncExitStack
    from pathlib import Path

    from mesh.settings import Settings

log = logging.getLogger(__name__)

AGAIN: Final = 1.0
"""Seconds between two attempts."""

T = TypeVar("T")


def waits_for_ever(settings: Settings) -> bool:
    """Whether a server with these settings waits for what is not there yet."""
    return settings.connect_timeout < 0


class FilesMissing(ConfigurationError):
    """Files that the settings name are not there."""

    code = "files-missing"

    def __init__(self, files: Sequence[str]) -> None:
        super().__init__(f"files that are not there yet: {', '.join(files)}")


class FilesNotReadable(ConfigurationError):
    """Files that the settings name are there, and not for this user to read."""

    code = "files-not-readable"

    def __init__(self, files: Sequence[str]) -> None:
        user = os.geteuid()
        super().__init__(
            f"files that user {user} may not read: {', '.join(files)}", hint=f"give them to it: chown -R {user} FOLDER"
        )


def lacking(settings: Settings) -> Iterator[None]:
    """Yields as long as one of the files that the settings name can't be read, for the caller to sleep; says so once.

    Ends at once where nothing is to be waited for: what reads the file says then that it is not there.
    """
    trouble = OutageLog(log, "files")
    while waits_for_ever(settings) and (error := _lack(settings)) is not None:
        trouble.failed(error, "waiting")
        yield
    trouble.recovered("the files are there")


async def files(settings: Settings) -> None:
    """Wait for the files that the settings name, where they say so."""
    import asyncio  # here, as an edge agent has no event loop

    for _ in lacking(settings):
        await asyncio.sleep(AGAIN)


async def entered(
    stack: AsyncExitStack,
    settings: Settings,
    make: Callable[[], AbstractAsyncContextManager[T]],
    *,
    role: str,
    waits: Callable[[str], None] = lambda why: None,
) -> T:
    """What `make` opens, on the stack; where the settings wait for ever, tried again for as long as what it needs of
    others (a router, a node, contracts, a stake) is not there.

    `role` is who waits, for people to read; `waits` is told why, each time. Raises what opening raises: with an end to
    its patience also `RemoteError`.
    """
    import asyncio

    trouble = OutageLog(log, "startup")
    while True:
        try:
            opened = await stack.enter_async_context(make())
        except RemoteError as error:
            if not waits_for_ever(settings):
                raise
            trouble.failed(error, f"the {role} waits")
            waits(str(error))
            await asyncio.sleep(AGAIN)
        else:
            trouble.recovered(f"the {role} waits no longer")
            return opened


def _lack(settings: Settings) -> ConfigurationError | None:
    """What is the matter with the files that the settings name."""
    missing, closed = [], []
    for path in _named(settings):
        try:
            path.open("rb").close()
        except FileNotFoundError:
            missing.append(str(path))
        except PermissionError:
            closed.append(str(path))
        except OSError:
            continue  # a folder, as an engine makes of a file that is missing: who reads it says what is the matter
    if closed:
        return FilesNotReadable(closed)
    return FilesMissing(missing) if missing else None


def _named(settings: Settings) -> Iterator[Path]:
    """The files that the settings name for a server to have."""
    from pathlib import Path

    for option in ("roster", "tls_ca", "tls_certificate", "tls_key", "keyfile", "keyfile_password_file"):
        if named := getattr(settings, option):
            yield Path(named).expanduser()
