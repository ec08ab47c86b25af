"""Restoring a backup: everything is unpacked beside its place and examined, and only then given its name."""

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
from mesh.state.archive import read_about, read_archive
from mesh.state.errors import ArchiveUnusable, StateExists, StateInUse
from mesh.state.layout import CONTENT, LEDGER, TRANSACTIONS, place_of
from mesh.state.ledgers import check_ledger, kept_out, read_ledger

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.work import JobRecord

STAGING: Final = ".restore-"
"""Begins the name of the folder in which a backup is unpacked."""
REPLACED: Final = ".replaced-"
"""Begins the name of the folder in which a state that made room is kept."""
SPARE: Final = 64 << 20
"""Bytes that a backup leaves free on the disk, whatever it says that it holds."""


class Existing(StrEnum):
    """What becomes of a state that is where the restored one belongs."""

    REFUSE = "refuse"
    SET_ASIDE = "set-aside"


@dataclass(frozen=True, kw_only=True)
class Restored:
    """What a restored state has: when it was backed up (ISO 8601), its parts, and its jobs that are not finalized.

    `aside` is where the state is that was there before.
    """

    made: str
    parts: tuple[str, ...]
    jobs: tuple[JobRecord, ...]
    aside: Path | None


async def restore(archive: Path, folder: Path, *, existing: Existing = Existing.REFUSE) -> Restored:
    """Put the state in the file `archive` into the data folder, which is made if it is not there.

    A part (an account's folder, its transactions on a chain) appears whole or not at all, and when one can't be put in
    its place, those before it are taken back. Raises `ArchiveUnusable`, `StateExists`, `StateInUse`, `LedgerUnusable`,
    `StoreFull` and `ConfigurationError`; then all is as it was.
    """
    about = await asyncio.to_thread(read_about, archive)
    with _scratch(folder) as staging, ExitStack() as locks:
        # First, for it takes no time; and again below, for what has come about meanwhile.
        _check_free(folder, about.parts, existing, locks=None)
        await asyncio.to_thread(_unpack, archive, staging)
        parts = tuple(part for part in about.parts if (staging / part).is_dir())
        jobs: list[JobRecord] = []
        for ledger in sorted(staging.glob(f"*/*/{LEDGER}")):
            await asyncio.to_thread(check_ledger, ledger)
            jobs += (await read_ledger(ledger)).jobs.values()
        await asyncio.to_thread(_sync, staging)
        there = _check_free(folder, parts, existing, locks=locks)
        aside = _exchange(staging, folder, parts, there)
    return Restored(made=about.made, parts=parts, jobs=tuple(jobs), aside=aside)


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """A folder in the data folder itself: that one may be all that can be written, as in a container."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=STAGING, dir=folder))
    except OSError as error:
        raise ConfigurationError(
            f"can't restore to {folder}: {error.strerror}", hint="let this user write there, or give another --data-dir"
        ) from None
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
            raise ArchiveUnusable(archive, "it needs more room than the disk has", hint="make room on that disk")
        path = staging / place_of(name)
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with raising_store_full(staging), path.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if path.parent.name == CONTENT:
            path.chmod(0o444)

    read_archive(archive, keep)


def _sync(staging: Path) -> None:
    """Put the names of all that was unpacked on the disk."""
    for path, _, _ in os.walk(staging):
        sync_directory(Path(path))


def _check_free(
    folder: Path, parts: tuple[str, ...], existing: Existing, *, locks: ExitStack | None
) -> tuple[str, ...]:
    """Which parts are there already, and keep agents out of them as long as `locks` is open.

    Raises `StateInUse`, and `StateExists` where they are not to be set aside.
    """
    there = tuple(part for part in parts if (folder / part).exists())
    with ExitStack() as held:
        for part in there:
            _keep_out(folder / part, held)
        if there and existing is Existing.REFUSE:
            raise StateExists(folder, there)
        if locks is not None:
            locks.enter_context(held.pop_all())
    return there


def _keep_out(part: Path, held: ExitStack) -> None:
    for ledger in sorted(part.glob(f"*/{LEDGER}")):
        held.enter_context(kept_out(ledger))
    if (part / CONTENT).is_dir() and is_in_use(part / CONTENT):
        raise StateInUse(part / CONTENT)
    for entry in sorted(part.glob("*.jsonl")):
        file = held.enter_context(entry.open("rb"))
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StateInUse(entry) from None


def _exchange(staging: Path, folder: Path, parts: tuple[str, ...], there: tuple[str, ...]) -> Path | None:
    """Give the parts their names, those that are there another; the transactions first, so that an agent's ledger is
    there only when all else is. Returns where the old parts are."""
    aside = folder / f"{REPLACED}{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}" if there else None
    moved: list[tuple[Path, Path]] = []
    try:
        for part in sorted(parts, key=lambda part: not part.startswith(TRANSACTIONS)):
            if aside is not None and part in there:
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
        target.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        source.rename(target)
    except OSError as error:
        raise ConfigurationError(f"can't put {target} in its place: {error.strerror}") from None
    moved.append((source, target))
