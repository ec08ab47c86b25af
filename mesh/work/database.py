"""The SQLite file of a ledger. Calls write one at a time.

A write is synced to the disk, and with it all earlier ones, unless it says that it can wait for the next one: a power
loss then takes it back, but never an earlier write without the later ones. What can be read from the chain again can
wait, as the cursor of the reader is written after it.
"""

from __future__ import annotations

import asyncio
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

import aiosqlite

from mesh.errors import ClosedError, ConfigurationError
from mesh.private_files import make_private_database, make_private_folder

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

VERSION: Final = 1
SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS jobs (
    liability TEXT PRIMARY KEY,
    phase TEXT NOT NULL,
    record BLOB NOT NULL,
    success INTEGER,
    result TEXT,
    position INTEGER NOT NULL DEFAULT 0,
    note TEXT NOT NULL DEFAULT '',
    aside INTEGER NOT NULL DEFAULT 0,
    changed REAL NOT NULL,
    recorded INTEGER NOT NULL DEFAULT 0
);
CREATE INDEX IF NOT EXISTS jobs_by_phase ON jobs (phase, changed) WHERE NOT aside;
CREATE TABLE IF NOT EXISTS outbox (
    identity TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    payload BLOB NOT NULL,
    deadline INTEGER,
    posted REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS spent (
    identity TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    payload BLOB NOT NULL,
    deadline INTEGER,
    posted REAL NOT NULL,
    liability TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS withdrawn (
    identity TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    payload BLOB NOT NULL,
    deadline INTEGER,
    posted REAL NOT NULL,
    used_by TEXT NOT NULL DEFAULT ''
);
CREATE TABLE IF NOT EXISTS cursors (name TEXT PRIMARY KEY, block INTEGER NOT NULL, history BLOB NOT NULL DEFAULT x'');
"""


class LedgerUnusable(ConfigurationError, code="ledger-unusable"):
    """The ledger can't be read or written: the disk is full, the folder belongs to another user, or it is no ledger."""

    def __init__(self, path: Path, why: object) -> None:
        hint = "free space on the disk, let this user write there, or give another folder with --data-dir"
        super().__init__(f"can't use the ledger {path}: {why}", hint=hint)
        self.path = path
        self.why = str(why)


class LedgerTooNew(ConfigurationError, code="ledger-too-new"):
    """A newer version wrote the ledger. `found` and `known` are versions of its format."""

    def __init__(self, path: Path, *, found: int, known: int) -> None:
        super().__init__(
            f"the ledger {path} was written by a newer version (format {found}, this one knows {known})",
            hint="upgrade aira-mesh",
        )
        self.found = found
        self.known = known


class Database:
    """The database in the file at `path`, with the tables of `schema`. Calls run in order, in a thread of their own.

    Every call raises `LedgerUnusable`, and `ClosedError` before `open` and after `close`.
    """

    def __init__(self, path: Path, schema: str = SCHEMA) -> None:
        self._path = path
        self._schema = schema
        self._connection: aiosqlite.Connection | None = None
        self._using = asyncio.Lock()
        self._syncs: bool | None = None
        """Whether SQLite syncs each commit now; None before it was set."""

    async def open(self) -> None:
        """Open the file, or create it. Raises `LedgerTooNew` if a newer version wrote it."""
        if self._connection is not None:
            raise ClosedError("this ledger is open already")
        try:
            make_private_folder(self._path.parent)
            make_private_database(self._path)
            self._connection = await aiosqlite.connect(self._path, isolation_level=None)
            await self._prepare()
        except (OSError, aiosqlite.Error) as error:
            await self.close()
            raise LedgerUnusable(self._path, error.strerror if isinstance(error, OSError) else error) from None
        except BaseException:
            await self.close()
            raise

    async def close(self) -> None:
        """Close the file if it is open, after the call that is using it.

        An open connection keeps its thread, and so the interpreter, alive.
        """
        connection, self._connection = self._connection, None
        if connection is not None:
            async with self._using:
                await connection.close()

    async def run(self, statement: str, values: tuple[Any, ...] = (), *, sync: bool = True) -> bool:
        """Run one statement, and sync it to the disk. Returns whether it changed any rows."""
        async with self._using:
            with self._usable():
                await self._set_sync(sync)
                connection = self._opened()
                before = connection.total_changes
                await connection.execute_fetchall(statement, values)  # one call of the thread, not two
                return connection.total_changes > before

    async def run_together(self, *statements: tuple[str, tuple[Any, ...]], sync: bool = True) -> None:
        """Run all statements in one transaction. All of them have an effect or, if it fails, none."""
        async with self._using:
            connection = self._opened()
            try:
                with self._usable():
                    await self._set_sync(sync)
                    await connection.execute("BEGIN IMMEDIATE")
                    for statement, values in statements:
                        await connection.execute(statement, values)
                    await connection.commit()
            except BaseException:
                # A cancelled statement still runs: its transaction must not stay open.
                await connection.rollback()
                raise

    async def rows(self, statement: str, values: tuple[Any, ...] = ()) -> list[Any]:
        """The rows that a statement returns: what was committed, never what another task is still writing."""
        async with self._using:
            with self._usable():
                return list(await self._opened().execute_fetchall(statement, values))

    async def _prepare(self) -> None:
        await self.run("PRAGMA journal_mode = WAL")
        version = (await self.rows("PRAGMA user_version"))[0][0]
        if version > VERSION:
            raise LedgerTooNew(self._path, found=version, known=VERSION)
        await self._opened().executescript(self._schema)
        if self._schema is SCHEMA and "recorded" not in [row[1] for row in await self.rows("PRAGMA table_info (jobs)")]:
            await self.run("ALTER TABLE jobs ADD COLUMN recorded INTEGER NOT NULL DEFAULT 0")
        await self.run(f"PRAGMA user_version = {VERSION}")

    async def _set_sync(self, sync: bool) -> None:
        if sync != self._syncs:
            await self._opened().execute(f"PRAGMA synchronous = {'FULL' if sync else 'NORMAL'}")
            self._syncs = sync

    def _opened(self) -> aiosqlite.Connection:
        if self._connection is None:
            raise ClosedError("the ledger is not open", hint="use it inside `async with`")
        return self._connection

    @contextmanager
    def _usable(self) -> Iterator[None]:
        """Raise `LedgerUnusable` for errors of the disk."""
        try:
            yield
        except aiosqlite.OperationalError as error:
            raise LedgerUnusable(self._path, error) from None
