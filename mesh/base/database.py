"""A file that must outlive a crash: SQLite, synced once for all that was written before.

A write takes tens of microseconds and runs where it is called. A process that is killed takes none back; a machine that
loses power takes those back that were not synced.
"""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from mesh.base.private_files import make_private_database, make_private_folder, sync_directory, sync_file
from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
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
