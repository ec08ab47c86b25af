"""Back up the state of all agents of a data folder while they run.

A ledger is copied as it is at one moment. Then the recordings of its running jobs are opened, and the ledger is copied
again to check that these jobs are still running. If not, this is repeated, so that a backup always contains the
recordings of its running jobs. Each open file is read up to the size that it has when reading starts. A restored agent
finds what a crash at that moment would have left.

A backup is restored by unpacking it into a temporary folder and checking it; only then is it renamed into place.
"""

from __future__ import annotations

import asyncio
import io
import os
import shutil
import tempfile
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, Literal, TypeAlias

import mesh
from mesh.agent.ledger import Phase
from mesh.base.private_files import make_missing_folders, open_private, sync_directory
from mesh.content import Store
from mesh.content.files import raising_store_full
from mesh.content.store import is_in_use
from mesh.errors import ConfigurationError
from mesh.ops.state._archive import (
    CONTENT,
    FORMAT,
    LEDGER,
    RECORDINGS,
    STAGES,
    TRANSACTIONS,
    VERDICTS,
    ArchiveInfo,
    account_folders,
    chains_in,
    in_use,
    new_archive,
    part_of,
    parts_in,
    path_of,
    pin_name,
    provider_files_in,
    read_archive,
    read_info,
    transactions_in,
    unusable,
)
from mesh.ops.state._inventory import check_ledger, copy_ledger, locked_ledger, read_ledger
from mesh.role.handover import HANDOVERS, RETIRED

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from mesh.agent.ledger import JobRecord
    from mesh.ops.state._archive import ArchiveWriter
    from mesh.ops.state._inventory import LedgerFacts


ContentScope: TypeAlias = Literal["needed", "all", "none"]
"""The content files to include: those that are pinned or that unfinished jobs and waiting orders need, all, or none."""
OpenFile: TypeAlias = "tuple[Path, BinaryIO]"
"""A file's path in the data folder, and the open file to read it from."""


@dataclass(frozen=True, kw_only=True)
class BackupReport:
    """What a backup contains: the accounts, the number of unfinalized jobs and of content files; its size in bytes.

    `missing` are CIDs that jobs need and the store does not have (or only damaged): agents fetch them again.
    """

    accounts: tuple[str, ...]
    jobs: int
    files: int
    missing: tuple[str, ...]
    size: int


async def back_up(folder: Path, target: Path, *, content: ContentScope) -> BackupReport:
    """Write the state of all agents of the data folder to the file `target`, which is replaced only at the end.

    Raises `LedgerUnusable`, `StoreFull` and `ConfigurationError`; `target` is then as it was.
    """
    about = ArchiveInfo(
        format=FORMAT,
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        software=f"aira-mesh {mesh.__version__}",
        content=content,
        parts=parts_in(folder),
    )
    homes = account_folders(folder)
    with (
        new_archive(target, about) as archive,
        tempfile.TemporaryDirectory(prefix=".aira-state-", dir=target.parent) as scratch,
    ):
        writer = _BackupWriter(archive, Path(scratch), content)
        for home in homes:
            await writer.home(home)
        for path in transactions_in(folder):
            await asyncio.to_thread(writer.add_copy, folder, path)
        # What providers keep comes after the transactions, so that no transaction is included without its order.
        for path in (path for home in homes for chain in chains_in(home) for path in provider_files_in(chain)):
            await asyncio.to_thread(writer.add_copy, folder, path)
    return BackupReport(
        accounts=tuple(home.name for home in homes),
        jobs=writer.jobs,
        files=writer.files,
        missing=tuple(sorted(writer.missing)),
        size=archive.size,
    )


class _BackupWriter:
    """Adds files to an archive and counts them."""

    def __init__(self, archive: ArchiveWriter, scratch: Path, content: ContentScope) -> None:
        self._archive = archive
        self._scratch = scratch
        self._content = content
        self.jobs = 0
        self.files = 0
        self.missing: set[str] = set()

    async def home(self, home: Path) -> None:
        """Add all of an account except its transactions and what its providers keep."""
        wanted: set[str] = set()
        for path in (home / HANDOVERS, home / RETIRED):
            with suppress(FileNotFoundError), path.open("rb") as known:
                self._add(home.parent, path, known)
        for chain in chains_in(home):
            if (chain / VERDICTS).is_file():
                await asyncio.to_thread(self.add_copy, home.parent, chain / VERDICTS)  # its files are pinned
            if not (chain / LEDGER).is_file():
                continue
            with ExitStack() as opened:
                facts, files = await self._consistent(chain, opened)
                for file in files:
                    await asyncio.to_thread(self._add, home.parent, *file)
            self.jobs += len(facts.jobs)
            wanted |= _needed(facts)
        if self._content != "none" and (home / CONTENT).is_dir():
            await asyncio.to_thread(self._add_content, home, wanted)

    async def _consistent(self, chain: Path, opened: ExitStack) -> tuple[LedgerFacts, list[OpenFile]]:
        """The contents of a chain's ledger, and its copy and the matching recordings as open files."""
        ledger, copy, later = chain / LEDGER, self._scratch / LEDGER, self._scratch / f"later-{LEDGER}"
        for _ in range(10):
            facts = await _copied(ledger, copy)
            with ExitStack() as stack:
                files: list[OpenFile] = [(ledger, stack.enter_context(copy.open("rb")))]
                running = [address for address, job in facts.jobs.items() if job.phase is Phase.RUNNING]
                files += _recordings(chain, running, stack)
                if _still_running(running, facts, await _copied(ledger, later)):
                    opened.enter_context(stack.pop_all())
                    return facts, files
        raise ConfigurationError(
            f"the jobs of {chain} change too fast to be copied",
            hint="try again, or stop the agent",
            code="state-changing",
        )

    def add_copy(self, folder: Path, database: Path) -> None:
        """Add a database as it is now."""
        copy = self._scratch / "copy.sqlite"
        copy_ledger(database, copy)
        with copy.open("rb") as file:
            self._add(folder, database, file)

    def _add_content(self, home: Path, needed: set[str]) -> None:
        with Store(home / CONTENT) as store:
            pins = store.pins()
            wanted = set(store.list()) if self._content == "all" else {*needed, *pins}
            for cid in sorted(wanted):
                if (path := store.checked(cid)) is None:
                    continue
                with suppress(FileNotFoundError), path.open("rb") as file:
                    self._add(home.parent, path, file)
                    self.files += 1
                    for label in sorted(pins.get(cid, ())):
                        self._archive.add(pin_name(home.name, cid, label), io.BytesIO(), size=0)
            self.missing |= needed - set(store.list())

    def _add(self, folder: Path, path: Path, file: BinaryIO) -> None:
        """Add what an open file holds now, named by its path in the data folder."""
        name = path.relative_to(folder).as_posix()
        if part_of(name) in self._archive.about.parts:  # a part that was created after the backup began is left out
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            self._archive.add(name, file, size=size)


def _recordings(chain: Path, running: Iterable[str], opened: ExitStack) -> list[OpenFile]:
    """The recordings of these jobs as open files, whatever their suffix."""
    found: list[OpenFile] = []
    for address in running:
        for stage in STAGES:
            path = chain / RECORDINGS / f"{address}{stage}"
            with suppress(FileNotFoundError):
                found.append((path, opened.enter_context(path.open("rb"))))
    return found


def _still_running(running: Iterable[str], before: LedgerFacts, after: LedgerFacts) -> bool:
    """Whether these jobs have neither ended nor restarted between two copies."""
    return all(
        (job := after.jobs.get(address)) is not None
        and job.phase is Phase.RUNNING
        and job.position >= before.jobs[address].position
        for address in running
    )


async def _copied(ledger: Path, copy: Path) -> LedgerFacts:
    await asyncio.to_thread(copy_ledger, ledger, copy)
    return await read_ledger(copy)


def _needed(facts: LedgerFacts) -> set[str]:
    """The CIDs that the jobs and orders of a ledger need."""
    results = {job.result for job in facts.jobs.values() if job.result}
    return {*facts.ordered, *results, *(job.liability.objective for job in facts.jobs.values())}


STAGING: Final = ".restore-"
"""Prefix of the folder in which a backup is unpacked."""
REPLACED: Final = ".replaced-"
"""Prefix of the folder that keeps a replaced state."""


@dataclass(frozen=True, kw_only=True)
class RestoreReport:
    """A restored state: when it was backed up (ISO 8601), its parts, and its jobs that are not finalized.

    `aside` is the folder that keeps the state it replaced.
    """

    made: str
    parts: tuple[str, ...]
    jobs: tuple[JobRecord, ...]
    aside: Path | None


async def restore(archive: Path, folder: Path, *, set_aside: bool = False) -> RestoreReport:
    """Restore the state in the file `archive` to the data folder, which is created if necessary.

    A state that is there is refused, or moved to a folder beside the new one (`set_aside`).

    A part (an account's folder, its transactions on a chain) appears whole or not at all; if one can't be moved into
    place, the others are moved back. Raises `InputError` for the archive, `LedgerUnusable`, `StoreFull` and
    `ConfigurationError`; then nothing has changed.
    """
    about = await asyncio.to_thread(read_info, archive)
    with _scratch(folder) as staging, ExitStack() as locks:
        # A quick check first; repeated below, because agents may have started meanwhile.
        _check_free(folder, about.parts, set_aside=set_aside, locks=None)
        await asyncio.to_thread(_unpack, archive, staging)
        parts = tuple(part for part in about.parts if (staging / part).is_dir())
        jobs: list[JobRecord] = []
        for database in sorted(staging.rglob("*.sqlite")):
            await asyncio.to_thread(check_ledger, database)
            if database.name == LEDGER:
                jobs += (await read_ledger(database)).jobs.values()
        for path, _, _ in os.walk(staging):
            await asyncio.to_thread(sync_directory, Path(path))
        replaced = _check_free(folder, parts, set_aside=set_aside, locks=locks)
        aside = _exchange(staging, folder, parts, replaced)
    return RestoreReport(made=about.made, parts=parts, jobs=tuple(jobs), aside=aside)


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """A temporary folder in the data folder, which may be the only writable one, as in a container."""
    try:
        make_missing_folders(folder)
        staging = Path(tempfile.mkdtemp(prefix=STAGING, dir=folder))
    except OSError as error:
        raise ConfigurationError(
            f"can't restore to {folder}: {error.strerror}",
            hint="give this user write access, or use another --data-dir",
            code="data-folder-unwritable",
        ) from None
    try:
        yield staging
    finally:
        shutil.rmtree(staging)


def _unpack(archive: Path, staging: Path) -> None:
    """Unpack a backup. Whatever size it claims, 64 MiB of the disk stay free. Raises `InputError`, `StoreFull`."""
    left = shutil.disk_usage(staging).free - (64 << 20)

    @contextmanager
    def keep(name: str, size: int) -> Iterator[BinaryIO]:
        nonlocal left
        left -= size
        if left < 0:
            raise unusable(archive, "it needs more space than the disk has free", hint="free some space on that disk")
        path = staging / path_of(name)
        make_missing_folders(path.parent)
        with raising_store_full(staging), open(path, "xb", opener=open_private) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if path.parent.name == CONTENT:
            path.chmod(0o400)

    read_archive(archive, keep)


def _check_free(folder: Path, parts: tuple[str, ...], *, set_aside: bool, locks: ExitStack | None) -> tuple[str, ...]:
    """The parts that already exist; agents can't open them until `locks` is closed.

    Raises `ConfigurationError` if a process uses them, or if they should not be set aside.
    """
    found = tuple(part for part in parts if (folder / part).exists())
    with ExitStack() as held:
        for part in found:
            for database in sorted((folder / part).rglob("*.sqlite")):
                held.enter_context(locked_ledger(database))
            content = folder / part / CONTENT
            if content.is_dir() and is_in_use(content):
                raise in_use(content)
        if found and not set_aside:
            raise ConfigurationError(
                f"{folder} already has a state: {', '.join(found)}",
                hint="use another folder with --data-dir, or move the old state aside with --existing set-aside",
                code="state-exists",
            )
        if locks is not None:
            locks.enter_context(held.pop_all())
    return found


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
