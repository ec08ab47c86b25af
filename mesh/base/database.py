"""Files that must outlive a crash: SQLite, synced once for all that was written before.

A write takes tens of microseconds and runs where it is called. A process that is killed takes none back; a machine that
loses power takes those back that were not synced.

`RoleLedger` syncs a write, and with it all earlier ones, unless it says that it can wait for the next one: a power loss
then takes it back, but never an earlier write without the later ones. What can be read from the chain again can wait,
as the cursor of the reader is written after it.
"""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Any, Final, Self

from mesh.base.private_files import make_private_database, make_private_folder, sync_directory, sync_file
from mesh.errors import ClosedError, ConfigurationError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Iterator
    from pathlib import Path

VERSION: Final = 1
"""The format of all these files, which each of them states as its `user_version`. Raise it when an older version could
not go on with what this one writes."""
DISK_ERRORS: Final = (OSError, sqlite3.Error)
"""What the methods of a `SyncedDatabase` raise when the disk refuses, or the file is no database."""


class SyncedDatabase:
    """The database in the file at `path` with the tables of `schema`, between `open` and `close`.

    Without a path nothing is kept, and everything counts as written. Use it in one event loop; without `sync`, in any
    threads that take turns. A write waits up to `patience` seconds for that of another process. What another process
    has written may not be on the disk yet: `sync` before you act on it.
    """

    def __init__(self, path: Path | None, schema: str, *, patience: float = 2.0) -> None:
        self.path = path
        self.written = self.synced = self.foreign = 0
        """The number of the last write, of the last one that no power failure takes back, and of the last of another
        process that was read."""
        self._version = 0
        self._schema = schema
        self._patience = patience
        self._database: sqlite3.Connection | None = None
        self._syncing = asyncio.Lock()

    @property
    def is_open(self) -> bool:
        """Whether there is a file, and it is open."""
        return self._database is not None

    def open(self) -> None:
        """Open the file, or create it, and sync it: an earlier process may have been killed before it did.

        Raises `ConfigurationError` if a newer version wrote it.
        """
        if self.path is None:
            return
        make_private_folder(self.path.parent)
        make_private_database(self.path)
        opened = sqlite3.connect(self.path, timeout=self._patience, isolation_level=None, check_same_thread=False)
        try:
            found = check_format(self.path, opened)
            opened.executescript("PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL;")
            opened.executescript(self._schema)
            if found != VERSION:
                opened.execute(f"PRAGMA user_version = {VERSION}")
            self._version = _version(opened)
            self._sync(self.path)
            sync_directory(self.path.parent)
        except BaseException:
            opened.close()
            raise
        self._database = opened
        self.written += 1  # what earlier processes wrote
        self.synced = self.written

    def close(self) -> None:
        """Close the file if it is open."""
        if self._database is not None:
            self._database.close()
            self._database = None

    def rows(self, statement: str, values: tuple[Any, ...] = ()) -> list[Any]:
        """The rows that a statement returns."""
        if self._database is None:
            return []
        rows = self._database.execute(statement, values).fetchall()
        if (version := _version(self._database)) != self._version:
            self._version = version
            self.foreign = self.written = self.written + 1
        return rows

    def write(self, *statements: tuple[str, Iterable[tuple[object, ...]]]) -> int:
        """Run each statement with each of its rows of values: all of them have an effect or, if one fails, none.

        Returns how many rows of the database were changed.
        """
        if self.path is None:
            self.written += 1
            return 0
        with self.transaction() as database:
            before = database.total_changes
            for statement, rows in statements:
                database.executemany(statement, rows)
            return database.total_changes - before

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """A transaction for the body, which is taken back if that fails."""
        if self._database is None:
            raise OSError("it is not open")
        self._database.execute("BEGIN IMMEDIATE")
        try:
            yield self._database
            self._database.execute("COMMIT")
        except BaseException:
            if self._database.in_transaction:
                self._database.execute("ROLLBACK")
            raise
        self.written += 1

    async def sync(self) -> None:
        """Wait until all that was written so far is on the disk, also after a power failure."""
        number = self.written
        async with self._syncing:
            if self.synced < number:
                number = self.written
                if self.path is not None:
                    await asyncio.to_thread(self._sync, self.path)
                self.synced = number

    def _sync(self, path: Path) -> None:
        """What was committed is in SQLite's log, or was synced when it left that."""
        sync_file(path.with_name(f"{path.name}-wal"))


def check_format(path: Path, database: sqlite3.Connection) -> int:
    """The format of an open file. Raises `ConfigurationError` if a newer version wrote it."""
    version = int(database.execute("PRAGMA user_version").fetchone()[0])
    if version > VERSION:
        raise ConfigurationError(
            f"{path} was written by a newer version (format {version}, this one knows {VERSION})",
            hint="upgrade aira-mesh",
            code="state-too-new",
        )
    return version


def _version(database: sqlite3.Connection) -> int:
    """A number that changes when another connection has written."""
    return int(database.execute("PRAGMA data_version").fetchone()[0])


def transactions_not_kept(place: Path | None, error: Exception) -> ConfigurationError:
    """The error of a disk that refuses sent transactions, or the orders in them."""
    return ConfigurationError(
        f"can't keep sent transactions in {place}: {getattr(error, 'strerror', None) or error}",
        hint="make room on that disk, let this user write there, or name another folder with --data-dir",
        code="transactions-not-kept",
    )


class LedgerUnusable(ConfigurationError, code="ledger-unusable"):
    """The ledger can't be read or written: the disk is full, the folder belongs to another user, or it is no ledger."""

    def __init__(self, path: Path, why: object) -> None:
        hint = "free space on the disk, let this user write there, or give another folder with --data-dir"
        super().__init__(f"can't use the ledger {path}: {why}", hint=hint)
        self.path = path
        self.why = str(why)


class RoleLedger:
    """What a role keeps, in the file at `path`, which is created if it is missing: `async with` opens it.

    It has the tables of `schema`, and how far the role has handled the chain. A file belongs to one role of one
    account. Calls run in order. Each raises `LedgerUnusable`, and `ClosedError` outside of `async with`; entering also
    `ConfigurationError` if a newer version wrote the file.
    """

    schema: str
    """The tables of a subclass."""

    def __init__(self, path: Path) -> None:
        cursor = "CREATE TABLE IF NOT EXISTS cursor (row INTEGER PRIMARY KEY CHECK (row = 0), block INTEGER NOT NULL, "
        self._path = path
        self._file = SyncedDatabase(path, f"{self.schema} {cursor} history BLOB NOT NULL);")
        self._using = asyncio.Lock()
        self._needed = 0
        """The number of the last write that must not be lost."""

    async def __aenter__(self) -> Self:
        if self._file.is_open:
            raise ClosedError("this ledger is open already")
        try:
            self._file.open()
        except DISK_ERRORS as error:
            raise LedgerUnusable(self._path, getattr(error, "strerror", None) or error) from None
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        async with self._using:  # after the calls that have begun
            self._file.close()

    async def cursor(self) -> tuple[int | None, bytes]:
        """The last block that the role has handled (None: it never handled one), and its encoded chain history."""
        rows = await self._rows("SELECT block, history FROM cursor")
        return rows[0] if rows else (None, b"")

    async def set_cursor(self, block: int, *, history: bytes = b"") -> None:
        """Save that the role has handled all of `block`, with its encoded chain history."""
        statement = "INSERT OR REPLACE INTO cursor (row, block, history) VALUES (0, ?, ?)"
        await self._run(statement, (block, history), sync=False)

    async def _run(self, statement: str, values: tuple[Any, ...] = (), *, sync: bool = True) -> bool:
        """Run one statement, and sync it to the disk. Returns whether it changed any rows."""
        return await self._run_together((statement, values), sync=sync)

    async def _run_together(self, *statements: tuple[str, tuple[Any, ...]], sync: bool = True) -> bool:
        """Run all statements in one transaction. All of them have an effect or, if it fails, none."""
        async with self._usable() as file:
            changed = file.write(*((statement, [values]) for statement, values in statements))
            if sync:
                self._needed = file.written
                await file.sync()
        return changed > 0

    async def _rows(self, statement: str, values: tuple[Any, ...] = ()) -> list[Any]:
        """The rows that a statement returns: nothing that a power loss might still take back, and should not."""
        async with self._usable() as file:
            rows = file.rows(statement, values)
            if file.synced < max(self._needed, file.foreign):
                await file.sync()
            return rows

    @asynccontextmanager
    async def _usable(self) -> AsyncIterator[SyncedDatabase]:
        """The open file, for one call at a time. Raises `LedgerUnusable` for errors of the disk."""
        async with self._using:
            if not self._file.is_open:
                raise ClosedError("the ledger is not open", hint="use it inside `async with`")
            try:
                yield self._file
            except (OSError, sqlite3.OperationalError) as error:
                raise LedgerUnusable(self._path, getattr(error, "strerror", None) or error) from None
