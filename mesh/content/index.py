"""The index of a store, one SQLite file: where each block of each file is, the file's size and when it was last used.

The bytes of a block (dag-pb) are not stored a second time: a block is a range of its file between a few bytes of
framing. An inner block has no bytes of the file, so its framing is the whole block. This costs 0.06 % of a file's size
and also works for files that were chunked with other settings than ours.

Several processes may use one index: every change is one short transaction.
"""

from __future__ import annotations

import sqlite3
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

from mesh.content.errors import StoreDamaged, StoreFull
from mesh.errors import ClosedError
from mesh.private_files import make_private_database
from schemas.cid import parse_cid
from schemas.unixfs import blocks_of_stream, parse_block

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

_VERSION: Final = 2
_BUSY_SECONDS: Final = 60.0
_BATCH: Final = 128
"""Blocks added in one transaction: 32 MiB of a file, so that a file of any size takes constant memory."""
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
        """The bytes of the block, given its data."""
        return self.head + data + self.tail


class IndexedFile(NamedTuple):
    """A file of the index: its name in the directory, its bytes, and when it was last used (Unix time, nanoseconds)."""

    name: str
    size: int
    used_ns: int


class BlockIndex:
    """The index of one directory.

    The constructor raises `sqlite3.DatabaseError` if the file is not an index of this version: delete it and open it
    again. All calls raise `StoreFull` if the disk is full, and `StoreDamaged` if the index can no longer be used.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        make_private_database(path)
        self._connection = sqlite3.connect(path, timeout=_BUSY_SECONDS, isolation_level=None, check_same_thread=False)
        try:
            self._prepare()
        except sqlite3.DatabaseError:
            self._connection.close()
            raise

    def _prepare(self) -> None:
        self._connection.execute("PRAGMA journal_mode = WAL")
        self._connection.execute("PRAGMA synchronous = NORMAL")
        with self._transaction():
            (version,) = self._connection.execute("PRAGMA user_version").fetchone()
            if version not in (0, _VERSION):
                raise sqlite3.DatabaseError(f"the index has version {version}, not {_VERSION}")
            if version == 0:
                for statement in _SCHEMA.split(";"):
                    self._connection.execute(statement)
                self._connection.execute(f"PRAGMA user_version = {_VERSION}")

    def close(self) -> None:
        """Close the file. Safe to call twice."""
        with self._lock:
            self._connection.close()

    def files(self) -> list[IndexedFile]:
        """All files of the index, temporary ones included, the least recently used first."""
        with self._reading() as connection:
            return [
                IndexedFile(*row) for row in connection.execute("SELECT name, size, used FROM file ORDER BY used, id")
            ]

    def add(self, name: str, spans: Iterable[BlockSpan], *, size: int | None = None) -> None:
        """Add blocks of a file, and its size if it is known. Of a block that occurs twice, the first is kept."""
        with self._writing() as connection:
            connection.execute("INSERT OR IGNORE INTO file (name, used) VALUES (?, ?)", (name, time.time_ns()))
            (file,) = connection.execute("SELECT id FROM file WHERE name = ?", (name,)).fetchone()
            rows = ((span.digest, file, span.offset, span.length, span.head, span.tail) for span in spans)
            connection.executemany("INSERT OR IGNORE INTO block VALUES (?, ?, ?, ?, ?, ?)", rows)
            if size is not None:
                connection.execute("UPDATE file SET size = ? WHERE id = ?", (size, file))

    def add_stream(self, name: str, stream: BinaryIO) -> tuple[str, int]:
        """Add all blocks of `stream`, chunked with our settings, as those of a file. Returns its CID and size."""
        offset, spans, cid = 0, [], ""
        for block in blocks_of_stream(stream):
            data = parse_block(block.data).data
            spans.append(BlockSpan.of(parse_cid(block.cid)[2:], block.data, data=data, offset=offset))
            offset, cid = offset + len(data), block.cid
            if len(spans) >= _BATCH:
                self.add(name, spans)
                spans.clear()
        self.add(name, spans)
        return cid, offset

    def reserve(self, name: str, size: int, *, quota: int | None) -> int:
        """Set the size of a file to `size` bytes if all files together then stay within `quota`, and return 0.

        Otherwise change nothing, and return the bytes by which they would exceed it.
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
        """Set when a file was last used (Unix time, nanoseconds)."""
        with self._writing() as connection:
            connection.execute("UPDATE file SET used = ? WHERE name = ?", (used_ns, name))

    def rename(self, name: str, new: str) -> None:
        """Give a file its final name, replacing any entry of that name."""
        with self._writing() as connection:
            _forget(connection, new)
            connection.execute("UPDATE file SET name = ?, used = ? WHERE name = ?", (new, time.time_ns(), name))

    def drop_blocks(self, name: str, new: str) -> None:
        """Rename a file and drop its blocks: it still counts towards the quota, as the least recently used one."""
        with self._writing() as connection:
            _forget(connection, new)
            connection.execute("DELETE FROM block WHERE file = (SELECT id FROM file WHERE name = ?)", (name,))
            connection.execute("UPDATE file SET name = ?, used = 0 WHERE name = ?", (new, name))

    def forget(self, name: str) -> None:
        """Drop a file and its blocks, if the index has it."""
        with self._writing() as connection:
            _forget(connection, name)

    def find(self, digest: bytes) -> list[tuple[str, BlockSpan]]:
        """Every file that has the block with this sha2-256 digest, and where in it."""
        query = "SELECT name, offset, length, head, tail FROM block JOIN file ON file.id = file WHERE digest = ?"
        with self._reading() as connection:
            rows = connection.execute(query, (digest,)).fetchall()
        return [(name, BlockSpan(digest, *where)) for name, *where in rows]

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        with self._lock, self._store_errors():
            yield self._connection

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        with self._lock, self._store_errors(), self._transaction():
            yield self._connection

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
            raise
        self._connection.execute("COMMIT")

    @contextmanager
    def _store_errors(self) -> Iterator[None]:
        """Raise the store's own errors instead of SQLite's."""
        try:
            yield
        except sqlite3.ProgrammingError as error:
            raise ClosedError(f"the store {self._path.parent} is closed") from error
        except sqlite3.DatabaseError as error:
            if getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL:
                raise StoreFull(self._path.parent) from error
            raise StoreDamaged(self._path.parent, f"its index {self._path.name} failed: {error}") from error


def _forget(connection: sqlite3.Connection, name: str) -> None:
    connection.execute("DELETE FROM block WHERE file = (SELECT id FROM file WHERE name = ?)", (name,))
    connection.execute("DELETE FROM file WHERE name = ?", (name,))
