"""Where every block of every held file is, in one SQLite file beside them.

A block (dag-pb bytes) is not kept: it is its file's data at an offset, between a few bytes of framing. An inner block
has no data of the file, so its framing is the whole of it. That costs 0.06 % of a file's size, and holds for files
that were chunked with other settings than ours, too.

Several processes may use one index: every change is one short transaction.
"""

from __future__ import annotations

import sqlite3
import threading
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

_VERSION: Final = 1
_BUSY_SECONDS: Final = 60.0
_SCHEMA: Final = """
CREATE TABLE file (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE);
CREATE TABLE block (
    digest BLOB NOT NULL, file INTEGER NOT NULL, offset INTEGER NOT NULL, length INTEGER NOT NULL,
    head BLOB NOT NULL, tail BLOB NOT NULL, PRIMARY KEY (digest, file)
) WITHOUT ROWID;
CREATE INDEX block_by_file ON block (file);
"""


@dataclass(frozen=True, slots=True)
class Span:
    """One block of a file: `head`, then `length` bytes of the file from `offset`, then `tail`."""

    digest: bytes
    offset: int
    length: int
    head: bytes
    tail: bytes

    @classmethod
    def of(cls, digest: bytes, block: bytes, *, data: bytes, offset: int) -> Span:
        """The span of `block`, which holds `data`, the bytes of the file from `offset`."""
        start = block.find(data)
        return cls(digest, offset, len(data), block[:start], block[start + len(data) :])

    def block(self, data: bytes) -> bytes:
        """The bytes of the block around its data."""
        return self.head + data + self.tail


class BlockIndex:
    """The index of one directory. Raises `sqlite3.DatabaseError` when the file is no index: delete it, open again."""

    def __init__(self, path: Path) -> None:
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
        with self._transaction() as connection:
            (version,) = connection.execute("PRAGMA user_version").fetchone()
            if version not in (0, _VERSION):
                raise sqlite3.DatabaseError(f"the index is of version {version}, not {_VERSION}")
            if version == 0:
                for statement in _SCHEMA.split(";"):
                    connection.execute(statement)
                connection.execute(f"PRAGMA user_version = {_VERSION}")

    def close(self) -> None:
        """Close the file. Safe to call twice."""
        with self._lock:
            self._connection.close()

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
            except BaseException:
                self._connection.execute("ROLLBACK")
                raise
            self._connection.execute("COMMIT")

    def names(self) -> frozenset[str]:
        """The names of all files in the index, the temporary ones too."""
        with self._lock:
            return frozenset(name for (name,) in self._connection.execute("SELECT name FROM file"))

    def add(self, name: str, spans: Iterable[Span]) -> None:
        """Enter more blocks of a file. A block that occurs twice in it is kept where it was first."""
        with self._transaction() as connection:
            connection.execute("INSERT OR IGNORE INTO file (name) VALUES (?)", (name,))
            (file,) = connection.execute("SELECT id FROM file WHERE name = ?", (name,)).fetchone()
            rows = ((span.digest, file, span.offset, span.length, span.head, span.tail) for span in spans)
            connection.executemany("INSERT OR IGNORE INTO block VALUES (?, ?, ?, ?, ?, ?)", rows)

    def rename(self, name: str, new: str) -> None:
        """Give a file its final name; what was known under that name is forgotten."""
        with self._transaction() as connection:
            _forget(connection, new)
            connection.execute("UPDATE file SET name = ? WHERE name = ?", (new, name))

    def forget(self, name: str) -> None:
        """Drop a file and its blocks; nothing happens when it is not there."""
        with self._transaction() as connection:
            _forget(connection, name)

    def find(self, digest: bytes) -> list[tuple[str, Span]]:
        """Every file that holds the block with this sha2-256 digest, with where it is."""
        query = "SELECT name, offset, length, head, tail FROM block JOIN file ON file.id = file WHERE digest = ?"
        with self._lock:
            rows = self._connection.execute(query, (digest,)).fetchall()
        return [(name, Span(digest, *where)) for name, *where in rows]


def _forget(connection: sqlite3.Connection, name: str) -> None:
    connection.execute("DELETE FROM block WHERE file = (SELECT id FROM file WHERE name = ?)", (name,))
    connection.execute("DELETE FROM file WHERE name = ?", (name,))
