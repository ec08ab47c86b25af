"""Where every block of every held file is, how long each file is and when it was last used: one SQLite file.

A block (dag-pb bytes) is not kept: it is its file's data at an offset, between a few bytes of framing. An inner block
has no data of the file, so its framing is the whole of it. That costs 0.06 % of a file's size, and holds for files
that were chunked with other settings than ours, too.

Several processes may use one index: every change is one short transaction.
"""

from __future__ import annotations

import sqlite3
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.content.errors import StoreDamaged, StoreFull
from mesh.errors import ClosedError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

_VERSION: Final = 2
_BUSY_SECONDS: Final = 60.0
_SCHEMA: Final = """
CREATE TABLE file (
    id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, size INTEGER NOT NULL DEFAULT 0, used INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE block (
    digest BLOB NOT NULL, file INTEGER NOT NULL, offset INTEGER NOT NULL, length INTEGER NOT NULL,
    head BLOB NOT NULL, tail BLOB NOT NULL, PRIMARY KEY (digest, file)
) WITHOUT ROWID;
CREATE INDEX block_by_file ON block (file);
"""


@dataclass(frozen=True, slots=True)
class BlockSpan:
    """One block of a file: `head`, then `length` bytes of the file from `offset`, then `tail`."""

    digest: bytes
    offset: int
    length: int
    head: bytes
    tail: bytes

    @classmethod
    def of(cls, digest: bytes, block: bytes, *, data: bytes, offset: int) -> BlockSpan:
        """The span of `block`, which holds `data`, the bytes of the file from `offset`."""
        start = block.find(data)
        return cls(digest, offset, len(data), block[:start], block[start + len(data) :])

    def block(self, data: bytes) -> bytes:
        """The bytes of the block around its data."""
        return self.head + data + self.tail


class IndexedFile(NamedTuple):
    """A file of the index: its name in the directory, its bytes, and when it was last used (Unix time, nanoseconds)."""

    name: str
    size: int
    used_ns: int


class BlockIndex:
    """The index of one directory.

    The constructor raises `sqlite3.DatabaseError` when the file is no index of ours: delete it, open again. All calls
    raise `StoreFull` when the disk is, and `StoreDamaged` when the index can't be used any more.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._connection = sqlite3.connect(path, timeout=_BUSY_SECONDS, isolation_level=None, check_same_thread=False)
        try:
            self._prepare()
        except sqlite3.DatabaseError:
            self._connection.close()
            raise

    def _prepare(self) -> None:
        self._connection.execute("PRAGMA journal_mode = WAL")
        self._connection.execute("PRAGMA synchronous = NORMAL")
        with self._begun():
            (version,) = self._connection.execute("PRAGMA user_version").fetchone()
            if version not in (0, _VERSION):
                raise sqlite3.DatabaseError(f"the index is of version {version}, not {_VERSION}")
            if version == 0:
                for statement in _SCHEMA.split(";"):
                    self._connection.execute(statement)
                self._connection.execute(f"PRAGMA user_version = {_VERSION}")

    def close(self) -> None:
        """Close the file. Safe to call twice."""
        with self._lock:
            self._connection.close()

    def files(self) -> list[IndexedFile]:
        """All files of the index, the temporary ones too, the least recently used first."""
        with self._reading() as connection:
            return [
                IndexedFile(*row) for row in connection.execute("SELECT name, size, used FROM file ORDER BY used, id")
            ]

    def add(self, name: str, spans: Iterable[BlockSpan], *, size: int | None = None) -> None:
        """Enter more blocks of a file, and its size if it is known. A block that occurs twice is kept where it was
        first."""
        with self._writing() as connection:
            connection.execute("INSERT OR IGNORE INTO file (name, used) VALUES (?, ?)", (name, time.time_ns()))
            (file,) = connection.execute("SELECT id FROM file WHERE name = ?", (name,)).fetchone()
            rows = ((span.digest, file, span.offset, span.length, span.head, span.tail) for span in spans)
            connection.executemany("INSERT OR IGNORE INTO block VALUES (?, ?, ?, ?, ?, ?)", rows)
            if size is not None:
                connection.execute("UPDATE file SET size = ? WHERE id = ?", (size, file))

    def reserve(self, name: str, size: int, *, quota: int | None) -> int:
        """Count a file as one of `size` bytes if all files together are within `quota` then: 0.

        Otherwise nothing is changed, and the bytes by which they would be over it are returned.
        """
        with self._writing() as connection:
            query = "SELECT COALESCE(SUM(size), 0) FROM file WHERE name != ?"
            (others,) = connection.execute(query, (name,)).fetchone()
            if quota is not None and others + size > quota:
                return int(others + size - quota)
            connection.execute("INSERT OR IGNORE INTO file (name, used) VALUES (?, ?)", (name, time.time_ns()))
            connection.execute("UPDATE file SET size = ? WHERE name = ?", (size, name))
            return 0

    def touch(self, name: str, *, used_ns: int) -> None:
        """Note when a file was last used (Unix time, nanoseconds)."""
        with self._writing() as connection:
            connection.execute("UPDATE file SET used = ? WHERE name = ?", (used_ns, name))

    def rename(self, name: str, new: str) -> None:
        """Give a file its final name; what was known under that name is forgotten."""
        with self._writing() as connection:
            _forget(connection, new)
            connection.execute("UPDATE file SET name = ?, used = ? WHERE name = ?", (new, time.time_ns(), name))

    def empty(self, name: str, new: str) -> None:
        """Give a file another name and forget its blocks: it counts by its bytes alone, as the one used longest ago."""
        with self._writing() as connection:
            _forget(connection, new)
            connection.execute("DELETE FROM block WHERE file = (SELECT id FROM file WHERE name = ?)", (name,))
            connection.execute("UPDATE file SET name = ?, used = 0 WHERE name = ?", (new, name))

    def forget(self, name: str) -> None:
        """Drop a file and its blocks; nothing happens when it is not there."""
        with self._writing() as connection:
            _forget(connection, name)

    def find(self, digest: bytes) -> list[tuple[str, BlockSpan]]:
        """Every file that holds the block with this sha2-256 digest, with where it is."""
        query = "SELECT name, offset, length, head, tail FROM block JOIN file ON file.id = file WHERE digest = ?"
        with self._reading() as connection:
            rows = connection.execute(query, (digest,)).fetchall()
        return [(name, BlockSpan(digest, *where)) for name, *where in rows]

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        with self._lock, self._told():
            yield self._connection

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        with self._lock, self._told(), self._begun():
            yield self._connection

    @contextmanager
    def _begun(self) -> Iterator[None]:
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
            raise
        self._connection.execute("COMMIT")

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Say what went wrong in the store's own terms."""
        try:
            yield
        except sqlite3.ProgrammingError as error:
            raise ClosedError(f"the store {self._path.parent} is closed") from error
        except sqlite3.DatabaseError as error:
            if getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL:
                raise StoreFull(self._path.parent) from error
            raise StoreDamaged(self._path.parent, f"its index {self._path.name} fails: {error}") from error


def _forget(connection: sqlite3.Connection, name: str) -> None:
    connection.execute("DELETE FROM block WHERE file = (SELECT id FROM file WHERE name = ?)", (name,))
    connection.execute("DELETE FROM file WHERE name = ?", (name,))
