"""The orders whose transactions may still be mined, on disk: a provider that is restarted knows them."""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from mesh.private_files import make_private_folder
from mesh.threads import finish_in_thread

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

_TABLE: Final = """
    PRAGMA journal_mode=WAL; PRAGMA synchronous=FULL;
    CREATE TABLE IF NOT EXISTS sent (identity BLOB PRIMARY KEY, lasting TEXT, signer TEXT) WITHOUT ROWID;
"""


class SentOrder(NamedTuple):
    """An order (`order_id`) with what its versions share (`lasting_hash`, signer)."""

    identity: bytes
    lasting: str
    signer: str


class SentOrders:
    """The file of sent orders: `with SentOrders(path) as sent`; without `path` nothing is kept.

    Raises `TransactionsNotKept` if the file can't be read or written.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.left: tuple[SentOrder, ...] = ()
        """What an earlier process has left."""
        self._path = path
        self._kept: set[bytes] = set()
        self._lock = asyncio.Lock()
        self._database: sqlite3.Connection | None = None

    def __enter__(self) -> Self:
        if self._path is None:
            return self
        with self._on_disk(), ExitStack() as stack:
            make_private_folder(self._path.parent)
            database = sqlite3.connect(self._path, isolation_level=None, check_same_thread=False)
            stack.callback(database.close)
            self._path.chmod(0o600)
            database.executescript(_TABLE)
            rows = database.execute("SELECT identity, lasting, signer FROM sent").fetchall()
            stack.pop_all()
        self._database = database
        self.left = tuple(SentOrder(*row) for row in rows)
        self._kept = {one.identity for one in self.left}
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._database is not None:
            self._database.close()

    async def add(self, orders: Sequence[SentOrder]) -> None:
        """Keep orders, before their transaction is sent."""
        if new := [order for order in orders if order.identity not in self._kept]:
            await self._write("INSERT OR REPLACE INTO sent VALUES (?, ?, ?)", new)
            self._kept.update(order.identity for order in new)

    async def remove(self, identities: Sequence[bytes]) -> None:
        """Forget orders whose transactions can't be mined any more."""
        if identities:
            self._kept.difference_update(identities)  # first, so that one that is sent again meanwhile is written again
            await self._write("DELETE FROM sent WHERE identity = ?", [(identity,) for identity in identities])

    async def _write(self, statement: str, rows: Sequence[tuple[object, ...]]) -> None:
        async with self._lock:
            if self._database is not None:
                await finish_in_thread(partial(self._run, self._database, statement, rows))

    def _run(self, database: sqlite3.Connection, statement: str, rows: Sequence[tuple[object, ...]]) -> None:
        with self._on_disk():
            database.execute("BEGIN")
            try:
                database.executemany(statement, rows)
                database.execute("COMMIT")
            except sqlite3.Error:
                if database.in_transaction:
                    database.execute("ROLLBACK")
                raise

    @contextmanager
    def _on_disk(self) -> Iterator[None]:
        try:
            yield
        except (OSError, sqlite3.Error) as error:
            from mesh.chain.errors import TransactionsNotKept  # needs the extra `chain`; agents load this module

            assert self._path is not None
            raise TransactionsNotKept(self._path, str(error)) from error
