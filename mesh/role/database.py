"""The SQLite files of roles. Calls write one at a time.

A write is synced to the disk, and with it all earlier ones, unless it says that it can wait for the next one: a power
loss then takes it back, but never an earlier write without the later ones. What can be read from the chain again can
wait, as the cursor of the reader is written after it.
"""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Self

from mesh.base.database import DISK_ERRORS, SyncedDatabase
from mesh.errors import ClosedError, ConfigurationError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path


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
