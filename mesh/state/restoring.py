"""Restore a backup: unpack it into a temporary folder, check it, and only then rename it into place."""

from __future__ import annotations

import asyncio
import fcntl
import os
import shutil
import tempfile
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

from mesh.content.files import raising_store_full, sync_directory
from mesh.content.recovery import is_in_use
from mesh.errors import ConfigurationError
from mesh.private_files import make_missing_folders, open_private
from mesh.state.archive import read_archive, read_info
from mesh.state.inventory import check_ledger, locked_ledger, read_ledger
from mesh.state.layout import (
    CONTENT,
    LEDGER,
    TRANSACTIONS,
    ArchiveUnusable,
    DataFolderUnwritable,
    StateExists,
    StateInUse,
    path_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.work import JobRecord

STAGING: Final = ".restore-"
"""Prefix of the folder in which a backup is unpacked."""
REPLACED: Final = ".replaced-"
"""Prefix of the folder that keeps a replaced state."""
SPARE: Final = 64 << 20
"""Bytes that unpacking leaves free on the disk, whatever size the backup claims."""


class ExistingState(StrEnum):
    """What to do with an existing state."""

    REFUSE = "refuse"
    SET_ASIDE = "set-aside"


@dataclass(frozen=True, kw_only=True)
class RestoreReport:
    """A restored state: when it was backed up (ISO 8601), its parts, and its jobs that are not finalized.

    `aside` is the folder that keeps the state it replaced.
    """

    made: str
    parts: tuple[str, ...]
    jobs: tuple[JobRecord, ...]
    aside: Path | None


async def restore(archive: Path, folder: Path, *, existing: ExistingState = ExistingState.REFUSE) -> RestoreReport:
    """Restore the state in the file `archive` to the data folder, which is created if necessary.

    A part (an account's folder, its transactions on a chain) appears whole or not at all; if one can't be moved into
    place, the others are moved back. Raises `ArchiveUnusable`, `StateExists`, `StateInUse`, `LedgerUnusable`,
    `StoreFull` and `ConfigurationError`; then nothing has changed.
    """
    about = await asyncio.to_thread(read_info, archive)
    with _scratch(folder) as staging, ExitStack() as locks:
        # A quick check first; repeated below, because agents may have started meanwhile.
        _check_free(folder, about.parts, existing, locks=None)
        await asyncio.to_thread(_unpack, archive, staging)
        parts = tuple(part for part in about.parts if (staging / part).is_dir())
        jobs: list[JobRecord] = []
        for database in sorted(staging.glob("*/*/*.sqlite")):
            await asyncio.to_thread(check_ledger, database)
            if database.name == LEDGER:
                jobs += (await read_ledger(database)).jobs.values()
        await asyncio.to_thread(_sync, staging)
        replaced = _check_free(folder, parts, existing, locks=locks)
        aside = _exchange(staging, folder, parts, replaced)
    return RestoreReport(made=about.made, parts=parts, jobs=tuple(jobs), aside=aside)


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """A temporary folder in the data folder, which may be the only writable one, as in a container."""
    try:
        make_missing_folders(folder)
        staging = Path(tempfile.mkdtemp(prefix=STAGING, dir=folder))
    except OSError as error:
        raise DataFolderUnwritable(folder, error.strerror) from None
    try:
        yield staging
    finally:
        shutil.rmtree(staging)


def _unpack(archive: Path, staging: Path) -> None:
    """Unpack a backup. Raises `ArchiveUnusable`, `StoreFull`."""
    left = shutil.disk_usage(staging).free - SPARE

    @contextmanager
    def keep(name: str, size: int) -> Iterator[BinaryIO]:
        nonlocal left
        left -= size
        if left < 0:
            raise ArchiveUnusable(
                archive, "no-space", "it needs more space than the disk has free", hint="free some space on that disk"
            )
        path = staging / path_of(name)
        make_missing_folders(path.parent)
        with raising_store_full(staging), open(path, "xb", opener=open_private) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if path.parent.name == CONTENT:
            path.chmod(0o400)

    read_archive(archive, keep)


def _sync(staging: Path) -> None:
    """Sync all unpacked directories to disk."""
    for path, _, _ in os.walk(staging):
        sync_directory(Path(path))


def _check_free(
    folder: Path, parts: tuple[str, ...], existing: ExistingState, *, locks: ExitStack | None
) -> tuple[str, ...]:
    """The parts that already exist; agents can't open them until `locks` is closed.

    Raises `StateInUse`, and `StateExists` unless they should be set aside.
    """
    found = tuple(part for part in parts if (folder / part).exists())
    with ExitStack() as held:
        for part in found:
            _lock(folder / part, held)
        if found and existing is ExistingState.REFUSE:
            raise StateExists(folder, found)
        if locks is not None:
            locks.enter_context(held.pop_all())
    return found


def _lock(part: Path, held: ExitStack) -> None:
    for database in sorted(part.glob("*/*.sqlite")):
        held.enter_context(locked_ledger(database))
    if (part / CONTENT).is_dir() and is_in_use(part / CONTENT):
        raise StateInUse(part / CONTENT)
    for entry in sorted(part.glob("*.jsonl")):
        file = held.enter_context(entry.open("rb"))
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StateInUse(entry) from None


def _exchange(staging: Path, folder: Path, parts: tuple[str, ...], replaced: tuple[str, ...]) -> Path | None:
    """Move the old parts aside and the new ones into place. Transactions go first, so that a ledger appears only after
    everything else. Returns the folder of the old parts."""
    aside = folder / f"{REPLACED}{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}" if replaced else None
    moved: list[tuple[Path, Path]] = []
    try:
        for part in sorted(parts, key=lambda part: not part.startswith(TRANSACTIONS)):
            if aside is not None and part in replaced:
                _move(folder / part, aside / part, moved)
            _move(staging / part, folder / part, moved)
    except BaseException:
        for source, target in reversed(moved):
            target.rename(source)
        raise
    for path in {folder, *(target.parent for _, target in moved)}:
        sync_directory(path)
    return aside


def _move(source: Path, target: Path, moved: list[tuple[Path, Path]]) -> None:
    try:
        make_missing_folders(target.parent)
        source.rename(target)
    except OSError as error:
        raise ConfigurationError(f"can't move {target} into place: {error.strerror}") from None
    moved.append((source, target))
