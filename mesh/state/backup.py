"""Back up the state of all agents of a data folder while they run.

A ledger is copied as it is at one moment. Then the recordings of its running jobs are opened, and the ledger is copied
again to check that these jobs are still running. If not, this is repeated, so that a backup always contains the
recordings of its running jobs. Each open file is read up to the size that it has when reading starts. A restored agent
finds what a crash at that moment would have left.
"""

from __future__ import annotations

import asyncio
import io
import os
import tempfile
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, TypeAlias

import mesh
from mesh.content import Store
from mesh.state.archive import FORMAT, ArchiveInfo, ArchiveWriter
from mesh.state.inventory import copy_ledger, read_ledger
from mesh.state.layout import (
    LEDGER,
    RECORDINGS,
    STAGES,
    VERDICTS,
    NoState,
    StateChanging,
    account_folders,
    part_of,
    parts_in,
    pin_name,
    provider_files_in,
    transactions_in,
)
from mesh.work import Phase

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.state.inventory import LedgerFacts
    from mesh.state.layout import AccountFolder

TRIES: Final = 10

OpenFile: TypeAlias = "tuple[Path, BinaryIO]"
"""A file's path in the data folder, and the open file to read it from."""


class ContentScope(StrEnum):
    """Which content files are included."""

    NEEDED = "needed"
    """Those that are pinned, and the objectives and results of unfinished jobs and waiting orders."""
    ALL = "all"
    NONE = "none"


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

    Raises `NoState`, `LedgerUnusable`, `StateChanging`, `StoreFull` and `ConfigurationError`; `target` is then as it
    was.
    """
    if not parts_in(folder):
        raise NoState(folder)
    about = ArchiveInfo(
        format=FORMAT,
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        software=f"aira-mesh {mesh.__version__}",
        content=content,
        parts=parts_in(folder),
    )
    homes = account_folders(folder)
    with (
        ArchiveWriter(target, about) as archive,
        tempfile.TemporaryDirectory(prefix=".aira-state-", dir=target.parent) as scratch,
    ):
        writer = _BackupWriter(archive, Path(scratch), content)
        for home in homes:
            await writer.home(home)
        await asyncio.to_thread(writer.transactions, folder)
        await asyncio.to_thread(writer.providers, homes)
    return BackupReport(
        accounts=tuple(home.address for home in homes),
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

    async def home(self, home: AccountFolder) -> None:
        """Add all of an account except its transactions and what its providers keep."""
        wanted: set[str] = set()
        for chain in home.chains:
            if (chain / VERDICTS).is_file():
                await asyncio.to_thread(self._add_copy, home.folder.parent, chain / VERDICTS)  # its files are pinned
            if not (chain / LEDGER).is_file():
                continue
            with ExitStack() as opened:
                facts, files = await self._consistent(chain, opened)
                for file in files:
                    await asyncio.to_thread(self._add, home.folder.parent, *file)
            self.jobs += len(facts.jobs)
            wanted |= _needed(facts)
        if self._content is not ContentScope.NONE and home.content.is_dir():
            await asyncio.to_thread(self._add_content, home, wanted)

    def transactions(self, folder: Path) -> None:
        """Add pending transactions, without those that are settled meanwhile."""
        for path in transactions_in(folder):
            with suppress(FileNotFoundError), path.open("rb") as file:
                self._add(folder, path, file)

    def providers(self, homes: Iterable[AccountFolder]) -> None:
        """Add what providers keep: after the transactions, so that no transaction is included without its order."""
        for home in homes:
            for path in (path for chain in home.chains for path in provider_files_in(chain)):
                self._add_copy(home.folder.parent, path)

    async def _consistent(self, chain: Path, opened: ExitStack) -> tuple[LedgerFacts, list[OpenFile]]:
        """The contents of a chain's ledger, and its copy and the matching recordings as open files."""
        ledger, copy, later = chain / LEDGER, self._scratch / LEDGER, self._scratch / f"later-{LEDGER}"
        for _ in range(TRIES):
            facts = await _copied(ledger, copy)
            with ExitStack() as stack:
                files: list[OpenFile] = [(ledger, stack.enter_context(copy.open("rb")))]
                running = [address for address, job in facts.jobs.items() if job.phase is Phase.RUNNING]
                files += _recordings(chain, running, stack)
                if _still_running(running, facts, await _copied(ledger, later)):
                    opened.enter_context(stack.pop_all())
                    return facts, files
        raise StateChanging(chain)

    def _add_copy(self, folder: Path, database: Path) -> None:
        """Add a database as it is now."""
        copy = self._scratch / "copy.sqlite"
        copy_ledger(database, copy)
        with copy.open("rb") as file:
            self._add(folder, database, file)

    def _add_content(self, home: AccountFolder, needed: set[str]) -> None:
        with Store(home.content) as store:
            pins = store.pins()
            wanted = set(store.list()) if self._content is ContentScope.ALL else {*needed, *pins}
            for cid in sorted(wanted):
                if (path := store.checked(cid)) is None:
                    continue
                with suppress(FileNotFoundError), path.open("rb") as file:
                    self._add(home.folder.parent, path, file)
                    self.files += 1
                    for label in sorted(pins.get(cid, ())):
                        self._archive.add(pin_name(home.address, cid, label), io.BytesIO(), size=0)
            self.missing |= needed - set(store.list())

    def _add(self, folder: Path, path: Path, file: BinaryIO) -> None:
        """Add what an open file holds now, named by its path in the data folder."""
        name = path.relative_to(folder).as_posix()
        if part_of(name) in self._archive.about.parts:  # a part that was created after the backup began is left out
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            self._archive.add(name, file, size=size)


async def _copied(ledger: Path, copy: Path) -> LedgerFacts:
    """Copy a ledger over an earlier copy, and read it."""
    await asyncio.to_thread(copy_ledger, ledger, copy)
    return await read_ledger(copy)


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


def _needed(facts: LedgerFacts) -> set[str]:
    """The CIDs that the jobs and orders of a ledger need."""
    results = {job.result for job in facts.jobs.values() if job.result}
    return {*facts.ordered, *results, *(job.liability.objective for job in facts.jobs.values())}
