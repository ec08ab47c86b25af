"""Backing up the state of all agents of a data folder, while they run.

A ledger is copied as it is at one moment; then the recordings of the jobs that run are opened; then the ledger is
copied again, to see that these jobs run still. If not, all is done anew: so no ledger that says "running" comes without
what the job has recorded. From the open files as much is read as they had then, whatever becomes of them meanwhile. A
restored agent finds what a crash at that moment would have left.
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
from mesh.state.archive import FORMAT, About, ArchiveWriter
from mesh.state.errors import NoState, StateRestless
from mesh.state.layout import LEDGER, RECORDINGS, STAGES, homes_in, part_of, parts_in, pin_name, transactions_in
from mesh.state.ledgers import copy_ledger, read_ledger
from mesh.work import Phase

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.state.layout import Home
    from mesh.state.ledgers import LedgerFacts

TRIES: Final = 10

Opened: TypeAlias = "tuple[Path, BinaryIO]"
"""Where a file belongs in the data folder, and what to read it from."""


class Extent(StrEnum):
    """Which files by CID go along."""

    NEEDED = "needed"
    """Those that are pinned, and the objectives and results of unfinished jobs and waiting orders."""
    ALL = "all"
    NONE = "none"


@dataclass(frozen=True, kw_only=True)
class BackedUp:
    """What a backup has: the accounts, jobs that are not finalized, files by CID; how large it is, in bytes.

    `missing` are CIDs that jobs need and the store does not hold (or not whole): they are fetched again in time.
    """

    accounts: tuple[str, ...]
    jobs: int
    files: int
    missing: tuple[str, ...]
    size: int


async def back_up(folder: Path, target: Path, *, content: Extent) -> BackedUp:
    """Write the state of all agents of the data folder to the file `target`, replacing it in the end.

    Raises `NoState`, `LedgerUnusable`, `StateRestless`, `StoreFull` and `ConfigurationError`; `target` is then as it
    was.
    """
    if not parts_in(folder):
        raise NoState(folder)
    about = About(
        format=FORMAT,
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        software=f"aira-mesh {mesh.__version__}",
        content=content,
        parts=parts_in(folder),
    )
    homes = homes_in(folder)
    with (
        ArchiveWriter(target, about) as archive,
        tempfile.TemporaryDirectory(prefix=".aira-state-", dir=target.parent) as scratch,
    ):
        copying = _Copying(archive, Path(scratch), content)
        for home in homes:
            await copying.home(home)
        await asyncio.to_thread(copying.transactions, folder)
    return BackedUp(
        accounts=tuple(home.address for home in homes),
        jobs=copying.jobs,
        files=copying.files,
        missing=tuple(sorted(copying.missing)),
        size=archive.size,
    )


class _Copying:
    """Fills one archive, and counts what it takes."""

    def __init__(self, archive: ArchiveWriter, scratch: Path, content: Extent) -> None:
        self._archive = archive
        self._scratch = scratch
        self._content = content
        self.jobs = 0
        self.files = 0
        self.missing: set[str] = set()

    async def home(self, home: Home) -> None:
        """Take all of an account but its transactions."""
        wanted: set[str] = set()
        for chain in home.chains:
            with ExitStack() as opened:
                facts, files = await self._settled(chain, opened)
                for file in files:
                    await asyncio.to_thread(self._add, home.folder.parent, *file)
            self.jobs += len(facts.jobs)
            wanted |= _needed(facts)
        if self._content is not Extent.NONE and home.content.is_dir():
            await asyncio.to_thread(self._add_content, home, wanted)

    def transactions(self, folder: Path) -> None:
        """Take what was sent and is not settled; what is settled just now is left out."""
        for path in transactions_in(folder):
            with suppress(FileNotFoundError), path.open("rb") as file:
                self._add(folder, path, file)

    async def _settled(self, chain: Path, opened: ExitStack) -> tuple[LedgerFacts, list[Opened]]:
        """What the ledger of a chain's folder holds, its copy and the recordings that belong to it, open."""
        ledger, copy, later = chain / LEDGER, self._scratch / LEDGER, self._scratch / f"later-{LEDGER}"
        for _ in range(TRIES):
            facts = await _copied(ledger, copy)
            with ExitStack() as stack:
                files: list[Opened] = [(ledger, stack.enter_context(copy.open("rb")))]
                running = [address for address, job in facts.jobs.items() if job.phase is Phase.RUNNING]
                files += _recordings(chain, running, stack)
                if _runs_still(running, facts, await _copied(ledger, later)):
                    opened.enter_context(stack.pop_all())
                    return facts, files
        raise StateRestless(chain)

    def _add_content(self, home: Home, needed: set[str]) -> None:
        with Store(home.content) as store:
            pins = store.pins()
            wanted = set(store.list()) if self._content is Extent.ALL else {*needed, *pins}
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
        """Add what an open file holds now, under its place in the data folder."""
        name = path.relative_to(folder).as_posix()
        if part_of(name) in self._archive.about.parts:  # another part began to be only after the backup
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            self._archive.add(name, file, size=size)


async def _copied(ledger: Path, copy: Path) -> LedgerFacts:
    """Copy a ledger over an earlier copy, and say what it holds."""
    await asyncio.to_thread(copy_ledger, ledger, copy)
    return await read_ledger(copy)


def _recordings(chain: Path, running: Iterable[str], opened: ExitStack) -> list[Opened]:
    """The files of these jobs' recordings, in whichever stage they are, open."""
    found: list[Opened] = []
    for address in running:
        for stage in STAGES:
            path = chain / RECORDINGS / f"{address}{stage}"
            with suppress(FileNotFoundError):
                found.append((path, opened.enter_context(path.open("rb"))))
    return found


def _runs_still(running: Iterable[str], before: LedgerFacts, after: LedgerFacts) -> bool:
    """Whether these jobs have neither ended nor begun anew between two looks."""
    return all(
        (job := after.jobs.get(address)) is not None
        and job.phase is Phase.RUNNING
        and job.position >= before.jobs[address].position
        for address in running
    )


def _needed(facts: LedgerFacts) -> set[str]:
    """The CIDs without which the jobs and orders of a ledger can't go on."""
    results = {job.result for job in facts.jobs.values() if job.result}
    return {*facts.ordered, *results, *(job.liability.objective for job in facts.jobs.values())}
