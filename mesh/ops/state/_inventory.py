"""What a data folder or a backup contains: its ledgers (as files that agents may be using), content, transactions."""

from __future__ import annotations

import asyncio
import os
import sqlite3
import tempfile
from collections import Counter
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

import msgspec

from mesh.agent.ledger import UNFINISHED, Ledger
from mesh.base.database import LedgerUnusable, check_format
from mesh.content import Store
from mesh.content.store import is_in_use
from mesh.ops.state._archive import (
    CONTENT,
    LEDGER,
    PINS,
    PROVIDER,
    RECORDINGS,
    VERDICTS,
    account_folders,
    chains_in,
    in_use,
    parts_in,
    provider_files_in,
    read_archive,
    transactions_in,
)
from mesh.validator.ledger import VerdictLedger
from schemas import Demand, Offer, decode

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from mesh.agent.ledger import JobRecord
    from mesh.content.store import Usage
    from mesh.ops.state._archive import ArchiveInfo

_KINDS: Final = {
    LEDGER: "ledgers",
    VERDICTS: "verdicts",
    PROVIDER: "providers",
    "mcap": "recordings",
    "transactions.sqlite": "transactions",
}
ACTIVE: Final = (
    "SELECT CASE type WHEN 'table' THEN 'virtual table' ELSE type END FROM sqlite_master"
    " WHERE type IN ('view', 'trigger') OR sql LIKE 'CREATE VIRTUAL%'"
)
"""Finds what would run code when an untrusted ledger is read or written."""


@dataclass(frozen=True, kw_only=True)
class LedgerFacts:
    """The content of a ledger at one moment. `block` is the last one handled, None before the first."""

    jobs: Mapping[str, JobRecord] = field(default_factory=dict)
    """Jobs that are not finalized, by the address of their liability."""
    phases: Mapping[str, int] = field(default_factory=dict)
    block: int | None = None
    waiting: int = 0
    """Messages in the outbox."""
    ordered: frozenset[str] = frozenset()
    """CIDs of the objectives of the orders in the outbox."""


class ChainState(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """An account's state on one chain. `block` is the last one handled, None before the first; `waiting` messages are
    in the outbox, and `recordings` are being written. `verdicts` are a validator's, by stage; `provides` are the
    lighthouses that it is a provider of."""

    chain: str
    block: int | None
    jobs: dict[str, int]
    waiting: int
    recordings: int
    verdicts: dict[str, int] = {}
    provides: tuple[str, ...] = ()


class AccountState(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """An account's state, with the number of its content files, their bytes, and the bytes of pinned ones."""

    address: str
    in_use: bool
    chains: tuple[ChainState, ...]
    files: int
    bytes: int
    pinned_bytes: int


class Inventory(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """A data folder. `transactions` counts the pending transactions of all accounts."""

    folder: str
    accounts: tuple[AccountState, ...]
    transactions: int


class ArchiveContents(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """A complete backup: its description, the number of files of each kind, and their bytes."""

    made: str
    software: str
    content: str
    parts: tuple[str, ...]
    files: dict[str, int]
    bytes: int


def copy_ledger(ledger: Path, copy: Path) -> None:
    """Copy a ledger as it is at this moment, even while an agent writes it. Replaces an earlier copy.

    Raises `LedgerUnusable`, and `ConfigurationError` if a newer version wrote it.
    """
    try:
        with closing(sqlite3.connect(f"{ledger.resolve().as_uri()}?mode=ro", uri=True)) as source:
            check_format(ledger, source)
            copy.unlink(missing_ok=True)
            with closing(sqlite3.connect(copy)) as target:
                source.backup(target)
                target.execute("PRAGMA journal_mode = DELETE")  # a single file, without a separate log
    except sqlite3.Error as error:
        raise LedgerUnusable(ledger, error) from None


def check_ledger(ledger: Path) -> None:
    """Raise `LedgerUnusable` for a ledger that is damaged or has more than tables, `ConfigurationError` if a newer
    version wrote it."""
    try:
        with closing(sqlite3.connect(ledger)) as database:
            (found,) = database.execute("PRAGMA integrity_check(1)").fetchone()
            if found != "ok":
                raise LedgerUnusable(ledger, found)
            check_format(ledger, database)
            if (kind := database.execute(ACTIVE).fetchone()) is not None:
                raise LedgerUnusable(ledger, f"it contains a {kind[0]}, which ledgers never have")
    except sqlite3.Error as error:
        raise LedgerUnusable(ledger, error) from None


async def read_ledger(copy: Path) -> LedgerFacts:
    """Read a copy of a ledger."""
    async with Ledger(copy) as ledger:
        waiting = [decode(one.payload) for one in await ledger.outbox(head=0)]
        return LedgerFacts(
            jobs={job.liability.address: job for job in await ledger.jobs(UNFINISHED)},
            phases=await ledger.jobs_by_phase(),
            block=(await ledger.cursor())[0],
            waiting=len(waiting),
            ordered=frozenset(order.objective for order in waiting if isinstance(order, Demand | Offer)),
        )


@contextmanager
def locked_ledger(ledger: Path) -> Iterator[None]:
    """Lock a ledger, so that no agent can open it. Raises `ConfigurationError` if one has it
    open, `LedgerUnusable`."""
    with closing(sqlite3.connect(ledger, timeout=0, isolation_level=None)) as database:
        try:
            database.execute("PRAGMA locking_mode = EXCLUSIVE")
            database.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            if getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_BUSY:
                raise in_use(ledger) from None
            raise LedgerUnusable(ledger, error) from None
        except sqlite3.DatabaseError:
            pass  # not a ledger, or a damaged one, which no agent uses
        yield


def _pending(table: Path) -> int:
    """How many transactions are pending."""
    try:
        with closing(sqlite3.connect(f"{table.resolve().as_uri()}?mode=ro", uri=True)) as database:
            (found,) = database.execute("SELECT COUNT(*) FROM transactions").fetchone()
            return int(found)
    except sqlite3.Error as error:
        raise LedgerUnusable(table, error) from None


async def take_inventory(folder: Path) -> Inventory:
    """List what a data folder contains; its agents may run.

    Raises `ConfigurationError`, `LedgerUnusable`, `AiraError` (`store-damaged`).
    """
    parts_in(folder)  # raises if there are none
    return Inventory(
        folder=str(folder),
        accounts=tuple([await _account(home) for home in account_folders(folder)]),
        transactions=sum(map(_pending, transactions_in(folder))),
    )


def examine_archive(path: Path) -> ArchiveContents:
    """Read a whole backup and compare it with its checksums. Raises `InputError`."""
    kinds: Counter[str] = Counter()
    size = 0

    @contextmanager
    def count(name: str, length: int) -> Iterator[BinaryIO]:
        nonlocal size
        kinds[_kind(name)] += 1
        size += length
        with open(os.devnull, "wb") as nowhere:
            yield nowhere

    about: ArchiveInfo = read_archive(path, count)
    return ArchiveContents(
        made=about.made,
        software=about.software,
        content=about.content,
        parts=about.parts,
        files=dict(sorted(kinds.items())),
        bytes=size,
    )


def _kind(name: str) -> str:
    """The kind of a file of a state."""
    path = Path(name)
    if PINS in path.parts:
        return "pins"
    return next((kind for ending, kind in _KINDS.items() if ending in path.name), "content")


async def _account(home: Path) -> AccountState:
    content = home / CONTENT
    chains = tuple([await _chain(folder) for folder in chains_in(home)])
    usage = await asyncio.to_thread(_usage, content) if content.is_dir() else None
    return AccountState(
        address=home.name,
        in_use=usage is not None and is_in_use(content),
        chains=chains,
        files=0 if usage is None else usage.files,
        bytes=0 if usage is None else usage.bytes,
        pinned_bytes=0 if usage is None else usage.pinned_bytes,
    )


async def _chain(folder: Path) -> ChainState:
    facts, verdicts, judged = LedgerFacts(), {}, None
    with tempfile.TemporaryDirectory(prefix="aira-state-") as scratch:
        if (folder / LEDGER).is_file():
            copy = Path(scratch) / LEDGER
            await asyncio.to_thread(copy_ledger, folder / LEDGER, copy)
            facts = await read_ledger(copy)
        if (folder / VERDICTS).is_file():
            copy = Path(scratch) / VERDICTS
            await asyncio.to_thread(copy_ledger, folder / VERDICTS, copy)
            async with VerdictLedger(copy) as ledger:
                verdicts = {stage: count for stage, count in (await ledger.stages()).items() if count}
                judged, _ = await ledger.cursor()
    return ChainState(
        chain=folder.name,
        block=judged if facts.block is None else facts.block,
        jobs=dict(facts.phases),
        waiting=facts.waiting,
        recordings=len(list((folder / RECORDINGS).glob("*.mcap*"))),
        verdicts=verdicts,
        provides=tuple(path.stem.removeprefix(PROVIDER) for path in provider_files_in(folder)),
    )


def _usage(content: Path) -> Usage:
    with Store(content) as store:
        return store.usage()
