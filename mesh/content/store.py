"""Files kept under their CID in one directory, with an index of their blocks, pins, and a quota.

All calls are synchronous and may wait for the disk: from an event loop, use a thread. One `Store` may be used from
several threads, and one directory by several processes. A file is held whole or not at all, whatever happens. One that
was not synced may be damaged after a power loss: reading finds that, and then it is not held. Opening deletes what a
crash left behind, and makes the index agree with the files.

The index is one SQLite file: where each block of each file is, the file's size and when it was last used. The bytes of
a block (dag-pb) are not stored a second time: a block is a range of its file between a few bytes of framing. An inner
block has no bytes of the file, so its framing is the whole block. This costs 0.06 % of a file's size and also works for
files that were chunked with other settings than ours. Every change is one short transaction.

A file may arrive block by block (`Assembly`), in any order and from untrusted sources, each block checked by its hash.
Above the quota the least recently used files are evicted first, pinned ones never.
"""

from __future__ import annotations

import errno
import hashlib
import io
import logging
import os
import re
import sqlite3
import stat
import threading
import time
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple, Self, cast

from mesh.base.database import SyncedDatabase
from mesh.base.log_context import log_event
from mesh.base.private_files import (
    PRIVATE_FILE,
    PRIVATE_FOLDER,
    is_locked,
    lock_shared,
    make_private_folder,
    open_private,
    sync_directory,
    try_lock,
)
from mesh.content._blocks import (
    BlockRef,
    BlockSpan,
    CheckedFile,
    ContentCorrupt,
    children_of,
    is_block,
    matches_tree,
    most_blocks,
    parse_node,
)
from mesh.content.files import (
    PART_PREFIX,
    PUT_PREFIX,
    StoreFull,
    TemporaryFile,
    directory_lock,
    read_or_nothing,
    stamp,
    with_progress,
)
from mesh.errors import AiraError, ClosedError, ConfigurationError, ContentError, InputError, InvalidCid
from schemas.cid import CID_LENGTH, parse_cid
from schemas.unixfs import CHUNK_SIZE, blocks_of_stream, cid_of_stream, parse_block

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from types import TracebackType

    from mesh.content.files import Progress, Readable
    from mesh.settings.groups import ContentSettings


_BATCH: Final = 128
"""Blocks added in one transaction: 32 MiB of a file, so that a file of any size takes constant memory."""
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS file (
    id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, size INTEGER NOT NULL DEFAULT 0, used INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE IF NOT EXISTS block (
    digest BLOB NOT NULL, file INTEGER NOT NULL, offset INTEGER NOT NULL, length INTEGER NOT NULL,
    head BLOB NOT NULL, tail BLOB NOT NULL, PRIMARY KEY (digest, file)
) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS block_by_file ON block (file);
"""


class ContentUnavailable(ContentError, code="content-unavailable"):
    """None of the sources asked has the file, or one of its blocks."""

    def __init__(self, cid: str, why: str) -> None:
        super().__init__(
            f"{cid} is not available: {why}", hint="check the CID, and that a machine with the file is on the network"
        )
        self.cid = cid
        self.why = why


class ContentTooLarge(ContentError, code="content-too-large"):
    """A file is larger than the caller, or the store, allows. Sizes are in bytes."""

    def __init__(self, cid: str, *, size: int, limit: int) -> None:
        super().__init__(
            f"{cid or 'the file'} is at least {size} bytes, more than the {limit} allowed",
            hint="raise the limit, or use a smaller file",
        )
        self.cid = cid
        self.size = size
        self.limit = limit


class IndexedFile(NamedTuple):
    """A file of the index: its name in the directory, its bytes, and when it was last used (Unix time, nanoseconds)."""

    name: str
    size: int
    used_ns: int


class BlockIndex:
    """The index of one directory.

    The constructor raises `sqlite3.DatabaseError` if the file is no database: delete it and open it again. All calls
    raise `StoreFull` if the disk is full, and `AiraError` (`store-damaged`) if the index can no longer be used.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._database = SyncedDatabase(path, _SCHEMA, patience=60.0)
        self._database.open()

    def close(self) -> None:
        """Close the file. Safe to call twice."""
        with self._lock:
            self._database.close()

    def files(self) -> list[IndexedFile]:
        """All files of the index, temporary ones included, the least recently used first."""
        return [IndexedFile(*row) for row in self._rows("SELECT name, size, used FROM file ORDER BY used, id")]

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
        return [(name, BlockSpan(digest, *where)) for name, *where in self._rows(query, digest)]

    def _rows(self, query: str, *values: object) -> list[Any]:
        with self._lock, self._store_errors():
            return self._database.rows(query, values)

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        with self._lock, self._store_errors(), self._database.transaction() as connection:
            yield connection

    @contextmanager
    def _store_errors(self) -> Iterator[None]:
        """Raise the store's own errors instead of SQLite's."""
        if not self._database.is_open:
            raise ClosedError(f"the store {self._path.parent} is closed")
        try:
            yield
        except sqlite3.DatabaseError as error:
            if getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL:
                raise StoreFull(self._path.parent) from error
            raise _damaged(self._path, f"failed: {error}") from error


def _forget(connection: sqlite3.Connection, name: str) -> None:
    connection.execute("DELETE FROM block WHERE file = (SELECT id FROM file WHERE name = ?)", (name,))
    connection.execute("DELETE FROM file WHERE name = ?", (name,))


def _damaged(index: Path, why: str) -> AiraError:
    return AiraError(
        f"the store {index.parent} is damaged: its index {index.name} {why}",
        hint="stop all programs that use it, then open it again: the index will be rebuilt",
        code="store-damaged",
    )


log = logging.getLogger(__name__)

USER: Final = "user"
"""Label of the pins that people set."""
DEFAULT_LIMIT: Final = 1 << 30
"""Bytes of the largest file that a store accepts by default."""
DAMAGED_SUFFIX: Final = ".corrupt"
"""Suffix of a file that was set aside because its bytes do not match its CID."""
_LABEL: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_INDEX: Final = ".blocks.sqlite"
_IN_USE: Final = ".open"


@dataclass(frozen=True, kw_only=True)
class StoreEntry:
    """A file of a store. `used` is when it was last read, served or put (Unix time, seconds)."""

    cid: str
    size: int
    used: float
    pins: frozenset[str]
    """The labels of its pins."""


@dataclass(frozen=True, kw_only=True)
class Usage:
    """How much a store holds. `bytes` includes what is being written or fetched, or was set aside as damaged."""

    files: int
    bytes: int
    pinned_bytes: int
    quota: int | None
    """None if there is no limit."""


@dataclass(frozen=True, kw_only=True)
class EvictionReport:
    """What was deleted to free space: the files, and all bytes (which include the remains of broken fetches)."""

    cids: tuple[str, ...]
    bytes: int


@dataclass(frozen=True, kw_only=True)
class IntegrityReport:
    """The outcome of hashing the whole store: how much was hashed, and the CIDs of the files that do not match."""

    files: int
    bytes: int
    damaged: tuple[str, ...]


def check_label(label: str) -> str:
    """The same label. Raises `InputError` unless it is 1 to 64 letters, digits, `_` and `-`."""
    if not _LABEL.fullmatch(label):
        raise InputError(f"{label[:80]!r} is not a label for a pin: use 1 to 64 letters, digits, _ and -")
    return label


class Store:
    """The files of one directory, each under its CIDv0.

    `limit` is the size in bytes of the largest file accepted. `quota` is the limit for all files together: the least
    recently used files without a pin are evicted to stay within it. A file that is being written counts from the moment
    its size is reserved, so that several writers (and processes) together stay within the quota. Without a quota, the
    disk is the limit.

    Creates the directory if it does not exist, deletes what a crash left behind, and hashes files that the index does
    not know; processes open a directory one at a time. Raises `ConfigurationError` if the directory can't be used, and
    `AiraError` (`store-damaged`).
    """

    def __init__(self, path: str | Path, *, limit: int = DEFAULT_LIMIT, quota: int | None = None) -> None:
        self.directory: Final = Path(path)
        self.limit: Final = limit
        self.quota: Final = quota
        self._pins: Final = self.directory / ".pins"
        """The folder of the pins: each is an empty file, so that it survives the loss of the index, and any crash."""
        self._lock = threading.Lock()
        self._checked: dict[str, tuple[int, ...]] = {}
        """The stamps of files whose bytes were hashed, or written, by this process."""
        self._touched = ("", 0)
        with ExitStack() as opened:
            try:
                make_private_folder(self.directory)
                self._pins.mkdir(mode=PRIVATE_FOLDER, exist_ok=True)
                sync_directory(self.directory)
                opened.enter_context(directory_lock(self.directory))
                in_use = open_private(self.directory / _IN_USE, os.O_RDWR | os.O_CREAT)
                failed = opened.enter_context(ExitStack())
                failed.callback(os.close, in_use)
                lock_shared(in_use)
                self._index = self._open_index(in_use)
                failed.callback(self._index.close)
                self._delete_leftovers()
                self._reconcile()
            except OSError as error:
                raise ConfigurationError(
                    f"can't keep files in {self.directory}: {error.strerror}", hint="choose a writable directory"
                ) from error
            self._opened = failed.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the index. Safe to call twice; paths and open files stay valid."""
        self._opened.close()

    def has(self, cid: str) -> bool:
        """Whether the file is held (unchecked). Raises `InvalidCid`."""
        return self.path(cid) is not None

    def path(self, cid: str) -> Path | None:
        """Where the file is, if it is held. Its bytes are not checked: see `Store.checked`. Raises `InvalidCid`."""
        path = self._path(cid)
        return path if path.is_file() else None

    def list(self) -> tuple[str, ...]:
        """The CIDs of all files held, sorted."""
        return tuple(sorted(name for name in os.listdir(self.directory) if is_cid(name)))

    def entries(self) -> tuple[StoreEntry, ...]:
        """All files held, in the order of eviction: the least recently used first."""
        held, pins = frozenset(self.list()), self.pins()
        return tuple(
            StoreEntry(cid=file.name, size=file.size, used=file.used_ns / 1e9, pins=pins.get(file.name, frozenset()))
            for file in self._index.files()
            if file.name in held
        )

    def usage(self) -> Usage:
        """How much is held, and the quota."""
        pins, files = self.pins(), self._index.files()
        return Usage(
            files=sum(is_cid(file.name) for file in files),
            bytes=sum(file.size for file in files),
            pinned_bytes=sum(file.size for file in files if file.name in pins),
            quota=self.quota,
        )

    def damaged(self) -> tuple[str, ...]:
        """The CIDs of files that were set aside as damaged and have not been replaced yet, sorted."""
        names = os.listdir(self.directory)
        cids = (name.removesuffix(DAMAGED_SUFFIX) for name in names if name.endswith(DAMAGED_SUFFIX))
        return tuple(sorted(cid for cid in cids if is_cid(cid)))

    def pin(self, cid: str, label: str = USER, *, sync: bool = True) -> None:
        """Protect the file from eviction, now or once it is held, until the pin of that label is removed.

        Without `sync`, a power loss may remove the pin. Raises `InvalidCid`, and `InputError` unless the label is 1 to
        64 letters, digits, `_` and `-`.
        """
        with directory_lock(self.directory):
            self._add_pin(cid, label, sync=sync)

    def unpin(self, cid: str, label: str = USER) -> None:
        """Remove the pin of one label, if there is one; a power loss may bring it back. Raises as `pin` does."""
        self._pin(cid, label).unlink(missing_ok=True)

    def release(self, label: str) -> None:
        """Remove all pins of a label, whatever file they protect; a power loss may bring them back.

        Raises `InputError` if it is not a valid label.
        """
        check_label(label)
        for cid, labels in self.pins().items():
            if label in labels:
                self._pin(cid, label).unlink(missing_ok=True)

    def pins(self) -> Mapping[str, frozenset[str]]:
        """All pinned CIDs, held or not, each with the labels of its pins."""
        found: dict[str, set[str]] = {}
        for name in os.listdir(self._pins):
            found.setdefault(name[:CID_LENGTH], set()).add(name[CID_LENGTH + 1 :])
        return {cid: frozenset(labels) for cid, labels in sorted(found.items())}

    def remove(self, cid: str) -> None:
        """Delete a file, and any damaged one that was set aside under its name.

        Raises `InvalidCid`, `ContentUnavailable` if it is not held, `AiraError` (`content-pinned`).
        """
        path = self._path(cid)
        aside = path.with_name(f"{cid}{DAMAGED_SUFFIX}")
        with directory_lock(self.directory):
            labels = self.pins().get(cid)
            if labels:
                raise AiraError(
                    f"{cid} is pinned ({', '.join(sorted(labels))})", hint="unpin it first", code="content-pinned"
                )
            found = [name for name in (path, aside) if name.exists()]
            for name in found:
                name.unlink()
                self._index.forget(name.name)
        if not found:
            raise ContentUnavailable(cid, "it is not in this store")

    def put_stream(self, stream: Readable, *, pin: str | None = None, progress: Progress | None = None) -> str:
        """Store everything that `stream` gives, and return its CID. Constant memory.

        With a `pin`, a label, the file is pinned before it can be evicted. Raises `ContentTooLarge` over the store's
        limit, `StoreFull`; then nothing is kept. Errors of the stream pass through.
        """
        return self._put(stream, 0, pin, progress)

    def put_file(self, path: str | Path, *, pin: str | None = None, progress: Progress | None = None) -> str:
        """Store a copy of the file at `path`; see `put_stream`. Raises `OSError` if it can't be read."""
        with Path(path).open("rb") as stream:
            status = os.fstat(stream.fileno())
            return self._put(stream, status.st_size if stat.S_ISREG(status.st_mode) else 0, pin, progress)

    def put_bytes(self, data: bytes, *, pin: str | None = None) -> str:
        """Store `data`; see `put_stream`."""
        return self._put(io.BytesIO(data), len(data), pin, None)

    def checked(self, cid: str) -> Path | None:
        """Where the file is. Its bytes are hashed on the first call of a process, and again after they changed.

        Returns None if the file is not held, or was damaged; a damaged one is set aside. A file without a pin may be
        evicted at any time. Raises `InvalidCid`.
        """
        try:
            path = self.verify(cid) if self._changed(cid) else self._path(cid)
        except ContentError:
            return None
        self._touch(cid)
        return path

    def verify(self, cid: str, *, progress: Progress | None = None) -> Path:
        """Hash the whole file now, and return where it is.

        Raises `ContentUnavailable` if it is not held, and `ContentCorrupt` if its bytes do not match its CID. It is
        then set aside as `CID.corrupt`, so that it can be fetched again.
        """
        path = self._path(cid)
        while True:
            try:
                seen = stamp(path)
                good = _is_chunked(path, cid, progress) or matches_tree(path, cid, partial(self._span, cid))
            except FileNotFoundError:
                raise ContentUnavailable(cid, "it is not in this store") from None
            if good:
                with self._lock:
                    self._checked[cid] = seen
                return path
            with directory_lock(self.directory):
                done = self._set_aside(path, seen=seen)
            if done:
                event = log_event("content-damaged", cid=cid)
                log.warning("%s was damaged on the disk and set aside", path, extra=event)
                raise ContentCorrupt(cid, "the bytes on the disk have another hash")

    def check(self, *, progress: Progress | None = None) -> IntegrityReport:
        """Hash the whole store now. Damaged files are reported and set aside; files that vanish meanwhile are skipped.

        `progress` gets the bytes hashed, of all.
        """
        sizes = {cid: path.stat().st_size for cid in self.list() if (path := self.path(cid))}
        total, done, files, damaged = sum(sizes.values()), 0, 0, []

        def advance(read: int, _: int | None) -> None:
            if progress is not None:
                progress(done + read, total)

        for cid, size in sizes.items():
            try:
                self.verify(cid, progress=advance)
            except ContentCorrupt:
                damaged.append(cid)
            except ContentUnavailable:
                continue
            files, done = files + 1, done + size
        return IntegrityReport(files=files, bytes=done, damaged=tuple(damaged))

    def open(self, cid: str) -> BinaryIO:
        """The file, opened for reading. Raises `InvalidCid` and `ContentUnavailable`.

        Each block is checked when it is read: reading a damaged one raises `ContentCorrupt`, and sets the file aside.
        """
        path = self._path(cid)
        try:
            raw = CheckedFile(path, cid, partial(self._span, cid), on_damage=partial(self._suspect, cid))
        except FileNotFoundError:
            raise ContentUnavailable(cid, "it is not in this store") from None
        self._touch(cid)
        return cast("BinaryIO", io.BufferedReader(raw, CHUNK_SIZE))

    def copy(self, cid: str, target: str | Path, *, progress: Progress | None = None) -> Path:
        """Write the file to `target`, replacing it once every block is checked and on the disk.

        Raises `InvalidCid`, `ContentUnavailable`, `ContentCorrupt`, `StoreFull` and `OSError`; then `target` is
        unchanged.
        """
        final = Path(target)
        with self.open(cid) as stream, TemporaryFile.create(final.parent, PUT_PREFIX) as temporary:
            size = stream.seek(0, os.SEEK_END)
            stream.seek(0)
            source = with_progress(stream, progress, total=size)
            offset = 0
            while data := source.read(CHUNK_SIZE):
                temporary.write(data, offset=offset)
                offset += len(data)
            temporary.finish(size, mode=0o644)
            temporary.rename(final)
        sync_directory(final.parent)
        return final

    def get_block(self, cid: str) -> bytes | None:
        """The block with that CID, checked by its hash, from any file held or being fetched; None if none has it.

        A file whose block is damaged is set aside. Raises `InvalidCid`.
        """
        digest = parse_cid(cid)[2:]
        for name, span in self._index.find(digest):
            try:
                with (self.directory / name).open("rb", buffering=0) as file:
                    block = span.block(read_or_nothing(file.fileno(), span.length, span.offset))
            except FileNotFoundError:
                continue
            if hashlib.sha256(block).digest() == digest:
                self._touch(name)
                return block
            if is_cid(name):
                self._suspect(name)
        return None

    def assemble(self, cid: str, *, size_limit: int | None = None) -> Assembly:
        """Start a file that arrives block by block; see `Assembly`. `size_limit` (bytes) can only lower the store's."""
        limit = self.limit if size_limit is None else min(size_limit, self.limit)
        return Assembly(self, cid, size_limit=limit)

    def reserve(self, name: str, size: int) -> None:
        """Reserve `size` bytes in all for the file that is being written under `name`, evicting others if necessary.

        Raises `StoreFull` if evicting everything that may be evicted would not suffice; then nothing is evicted.
        """
        if not self._index.reserve(name, size, quota=self.quota):
            return
        with directory_lock(self.directory):
            self._delete_leftovers()
            while missing := self._index.reserve(name, size, quota=self.quota):
                self._delete(self._candidates_for(missing))

    def collect(self, quota: int | None = None) -> EvictionReport:
        """Evict until all files together are within `quota` bytes; without one, the store's own.

        Damaged files go first, then the least recently used; pinned ones stay. With neither quota, nothing is evicted.
        """
        limit = self.quota if quota is None else quota
        if limit is None:
            return EvictionReport(cids=(), bytes=0)
        with directory_lock(self.directory):
            self._delete_leftovers()
            excess = sum(file.size for file in self._index.files()) - limit
            chosen: list[IndexedFile] = []
            for file in self._candidates():
                if excess <= 0:
                    break
                chosen.append(file)
                excess -= file.size
            self._delete(chosen)
        cids = tuple(file.name for file in chosen if not _is_leftover(file.name))
        return EvictionReport(cids=cids, bytes=sum(file.size for file in chosen))

    def settle(
        self,
        temporary: TemporaryFile,
        cid: str,
        *,
        size: int,
        spans: Iterable[BlockSpan] = (),
        pin: str | None = None,
        sync: bool = True,
    ) -> Path:
        """Rename a complete file to its CID, and index the blocks that are not yet indexed. It counts as checked."""
        path, name = self._path(cid), temporary.path.name
        aside = path.with_name(f"{cid}{DAMAGED_SUFFIX}")
        self._index.add(name, spans, size=size)
        temporary.finish(size, sync=sync)
        with directory_lock(self.directory):
            if pin is not None:
                self._add_pin(cid, pin)
            self._index.rename(name, cid)
            temporary.rename(path)
            aside.unlink(missing_ok=True)
            self._index.forget(aside.name)
            seen = stamp(path)
        if sync:
            sync_directory(self.directory)
        with self._lock:
            self._checked[cid] = seen
        return path

    def _path(self, cid: str) -> Path:
        parse_cid(cid)
        return self.directory / cid

    def _pin(self, cid: str, label: str) -> Path:
        parse_cid(cid)
        return self._pins / f"{cid}.{check_label(label)}"

    def _add_pin(self, cid: str, label: str, *, sync: bool = True) -> None:
        """The caller must hold the directory's lock, as who deletes files does."""
        self._pin(cid, label).touch(mode=PRIVATE_FILE)
        if sync:
            sync_directory(self._pins)

    def _put(self, stream: Readable, size: int, pin: str | None, progress: Progress | None) -> str:
        """Store the stream. `size` is the expected number of bytes, 0 if unknown."""
        if pin is not None:
            check_label(pin)
        with TemporaryFile.create(self.directory, PUT_PREFIX) as temporary:
            try:
                copied = CopyingStream(stream, temporary, self)
                copied.expect(size)
                source = with_progress(
                    cast("BinaryIO", io.BufferedReader(copied, CHUNK_SIZE)), progress, total=size or None
                )
                cid, size = self._index.add_stream(temporary.path.name, source)
                self.settle(temporary, cid, size=size, pin=pin)
            except BaseException:
                self._index.forget(temporary.path.name)
                raise
        return cid

    def reserve_ahead(self, name: str, size: int) -> int:
        """Reserve `size` bytes, and some more if that evicts nothing. Returns how many were reserved."""
        more = size + (8 << 20)
        if not self._index.reserve(name, more, quota=self.quota):
            return more
        self.reserve(name, size)
        return size

    def _candidates_for(self, missing: int) -> Sequence[IndexedFile]:
        """Enough files to free `missing` bytes. Raises `StoreFull` (`quota-reached`)."""
        chosen: list[IndexedFile] = []
        for file in self._candidates():
            chosen.append(file)
            missing -= file.size
            if missing <= 0:
                return chosen
        kept = sum(file.size for file in self._index.files()) - sum(file.size for file in chosen)
        raise StoreFull(
            self.directory,
            why=f"the store {self.directory} is full: {missing} bytes exceed its quota of {self.quota}, "
            f"of which {kept} are in use",
            hint="raise content_limit, or unpin or remove files",
            code="quota-reached",
        )

    def _candidates(self) -> Iterator[IndexedFile]:
        """The files that may be evicted, in the order of eviction: damaged ones, then the least recently used."""
        pinned = self.pins()
        for file in sorted(self._index.files(), key=lambda file: not file.name.endswith(DAMAGED_SUFFIX)):
            if file.name.startswith(PUT_PREFIX) or file.name.removeprefix(PART_PREFIX) in pinned:
                continue
            if not (file.name.startswith(PART_PREFIX) and is_locked(self.directory / file.name)):
                yield file

    def _delete(self, files: Iterable[IndexedFile]) -> None:
        for file in files:
            path = self.directory / file.name
            if file.name.startswith(PART_PREFIX):
                if not self._delete_unless_locked(path):
                    continue
            else:
                path.unlink(missing_ok=True)
                self._index.forget(file.name)
            event = log_event("content-evicted", name=file.name, bytes=file.size)
            log.info("evicted %s, %d bytes, to free space", file.name, file.size, extra=event)

    def _open_index(self, in_use: int) -> BlockIndex:
        """The index, made anew if it is unusable and no other process uses it; `in_use` is locked for this one."""
        path = self.directory / _INDEX
        try:
            return BlockIndex(path)
        except sqlite3.OperationalError as error:  # locked, read-only, or no disk: a new index would not help
            raise _damaged(path, f"can't be opened: {error}") from error
        except sqlite3.DatabaseError as error:
            event = log_event("content-index-rebuilt", path=path, error=error)
            log.warning("the block index %s is unusable (%s) and will be rebuilt", path, error, extra=event)
        if not try_lock(in_use):
            raise _damaged(path, "is unusable, and other processes use it")
        for suffix in ("", "-wal", "-shm"):
            path.with_name(path.name + suffix).unlink(missing_ok=True)
        lock_shared(in_use)
        return BlockIndex(path)

    def _delete_leftovers(self) -> None:
        """Delete the files of writers that are gone, and unfinished fetches that were not continued for a week.

        The caller must hold the directory's lock.
        """
        for path in self.directory.glob(f"{PUT_PREFIX}*"):
            self._delete_unless_locked(path)
        for path in self.directory.glob(f"{PART_PREFIX}*"):
            with suppress(FileNotFoundError):
                held = (self.directory / path.name.removeprefix(PART_PREFIX)).exists()
                if held or time.time() - path.stat().st_mtime > 7 * 24 * 3600:
                    self._delete_unless_locked(path)

    def _delete_unless_locked(self, path: Path) -> bool:
        leftover = TemporaryFile.take(path)
        if leftover is not None:
            with leftover:
                self._index.forget(path.name)
        return leftover is not None

    def _reconcile(self) -> None:
        """Add files that the index does not know, and drop those that no longer exist."""
        names = frozenset(os.listdir(self.directory))
        known = frozenset(file.name for file in self._index.files())
        for name in known - names:
            self._index.forget(name)
        for name in names - known:
            if is_cid(name):
                self._index_file(self.directory / name)
            elif _is_leftover(name):
                self._index.add(name, (), size=(self.directory / name).stat().st_size)

    def _index_file(self, path: Path) -> None:
        event = log_event("content-reindexed", cid=path.name)
        log.info("hashing %s, which the block index does not have", path, extra=event)
        name, seen = f"{PUT_PREFIX}{path.name}", stamp(path)
        with path.open("rb") as stream:
            cid, size = self._index.add_stream(name, stream)
        self._index.add(name, (), size=size)
        if cid == path.name:
            self._index.rename(name, cid)
            return
        event = log_event("content-set-aside", cid=path.name, found=cid)
        log.warning("%s does not match its name, or was chunked with other settings: set aside", path, extra=event)
        self._index.forget(name)
        self._index.add(path.name, (), size=size)
        self._set_aside(path, seen=seen)

    def _set_aside(self, path: Path, *, seen: tuple[int, ...]) -> bool:
        """Rename a file that does not match its CID to `CID.corrupt`, and drop its blocks from the index.

        Returns False, and does nothing, if the file's stamp is no longer `seen`: then it was replaced. The caller must
        hold the directory's lock.
        """
        damaged = path.with_name(f"{path.name}{DAMAGED_SUFFIX}")
        with suppress(FileNotFoundError):
            if stamp(path) != seen:
                return False
            path.rename(damaged)
            sync_directory(path.parent)
        self._index.drop_blocks(path.name, damaged.name)
        return True

    def _changed(self, cid: str) -> bool:
        path = self._path(cid)
        with self._lock:
            known = self._checked.get(cid)
        try:
            return known != stamp(path)
        except FileNotFoundError:
            return True

    def _span(self, name: str, digest: bytes) -> BlockSpan | None:
        return next((span for found, span in self._index.find(digest) if found == name), None)

    def _suspect(self, cid: str) -> None:
        """Verify a file that has a wrong block."""
        with suppress(ContentError):
            self.verify(cid)
            event = log_event("content-index-wrong", cid=cid)
            log.error("%s is whole, but its index entry is wrong: delete the index of the store", cid, extra=event)

    def _touch(self, name: str) -> None:
        """Remember a use of a file; reads less than a second apart count as one."""
        now = time.time_ns()
        with self._lock:
            last, when = self._touched
            if last == name and 0 <= now - when < 1_000_000_000:
                return
            self._touched = (name, now)
        with suppress(StoreFull):  # on a full disk, reading still works: only the eviction order is less exact
            self._index.touch(name, used_ns=now)


class CopyingStream(io.RawIOBase):
    """A stream whose bytes are written to `copy` as they are read, within the store's limit and quota.

    Reading raises `ContentTooLarge` and `StoreFull`, before it writes any of the bytes that are too many.
    """

    def __init__(self, stream: Readable, copy: TemporaryFile, store: Store) -> None:
        self._stream = stream
        self._copy = copy
        self._store = store
        self._reserved = 0
        self._done = 0

    def expect(self, size: int) -> None:
        """Reserve `size` bytes before any is read. Raises as reading does."""
        if size > self._store.limit:
            raise ContentTooLarge("", size=size, limit=self._store.limit)
        self._store.reserve(self._copy.path.name, size)
        self._reserved = size

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        """Fill the buffer from the underlying stream, after writing the same bytes to the file."""
        data = self._stream.read(len(buffer))
        done = self._done + len(data)
        if done > self._store.limit:
            raise ContentTooLarge("", size=done, limit=self._store.limit)
        if done > self._reserved:
            self._reserved = self._store.reserve_ahead(self._copy.path.name, done)
        self._copy.write(data, offset=self._done)
        buffer[: len(data)] = data
        self._done = done
        return len(data)


class Assembly:
    """A file on its way into a store: `with store.assemble(cid) as assembly`.

    Start with `root`. For each reference, get the block (first try `local`), pass it to `put`, and continue with the
    references it returns. When none is left, call `finish`. May be used from several threads at once.

    Leaving the `with` block unfinished keeps the blocks received so far, unless they can never become the file; so
    does a crash. The next assembly of the same CID finds them with `local`, and the store serves them to others.
    """

    def __init__(self, store: Store, cid: str, *, size_limit: int) -> None:
        parse_cid(cid)
        self.cid: Final = cid
        self.root: Final = BlockRef(cid)
        self._store = store
        self._index = store._index
        self._limit = size_limit
        self._lock = threading.Lock()
        self._spans: dict[bytes, BlockSpan] = {}
        self._placed = 0
        self._size = 0
        self._have = 0
        self._settled = False
        self._file = _part_file(store.directory, cid)
        self._left_size = self._file.size
        """Bytes that an earlier attempt left in the file."""
        self._damaged = _damaged_file(store.directory, cid)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._damaged is not None:
            self._damaged.close()
        with self._file:
            if self._settled:
                return
            if isinstance(error, ContentCorrupt | ContentTooLarge | StoreFull) or not self._file.size:
                self._file.is_kept = False
            if self._file.is_kept:
                with suppress(StoreFull):
                    self._index_blocks()
            else:
                self._index.forget(self._file.path.name)

    def local(self, ref: BlockRef) -> bytes | None:
        """The block, if it is on this disk: in this file, in another one, or left by an earlier attempt.

        Its hash is checked.
        """
        digest = parse_cid(ref.cid)[2:]
        with self._lock:
            span = self._spans.get(digest)
        if span is not None:
            return span.block(self._file.read(span.length, offset=span.offset))
        return self._store.get_block(ref.cid) or self._left_over(ref)

    def put(self, ref: BlockRef, block: bytes) -> list[BlockRef]:
        """Add a block, and return references to the blocks that it links to.

        Raises `ContentCorrupt` if the bytes do not have the hash (`is_block` checks that alone), or if they have it
        but the tree can't be a file's; `ContentTooLarge` and `StoreFull`.
        """
        if not is_block(ref.cid, block):
            raise ContentCorrupt(self.cid, f"the bytes of block {ref.cid} have another hash")
        return self.put_checked(ref, block)

    def put_checked(self, ref: BlockRef, block: bytes) -> list[BlockRef]:
        """The same for a block whose hash is known to be right, by `local` or `is_block`."""
        try:
            node = parse_node(ref, block)
        except ContentCorrupt as error:
            raise ContentCorrupt(self.cid, f"in block {ref.cid}: {error.why}", reason=error.reason) from None
        if ref.size is None:
            self._reserve(node.file_size)
        span = BlockSpan.of(parse_cid(ref.cid)[2:], block, data=node.data, offset=ref.offset)
        self._file.write(node.data, offset=ref.offset)
        with self._lock:
            self._spans.setdefault(span.digest, span)
            self._placed += 1
            self._have += len(node.data)
            if self._placed + len(node.links) > most_blocks(self._size):
                raise ContentCorrupt(
                    self.cid, f"its tree has more than {most_blocks(self._size)} blocks", reason="too-many-blocks"
                )
        if node.links or len(self._spans) >= _BATCH:  # after a crash, the positions of the parts are worth most
            self._index_blocks()
        return children_of(ref, node)

    def progress(self) -> tuple[int, int]:
        """Bytes of the file that were added, and its size (0 before the root was added)."""
        with self._lock:
            return self._have, self._size

    def finish(self, *, sync: bool = True) -> Path:
        """Move the complete file to its CID, atomically, and return its path. Call it once every block was added.

        Without `sync`, a power loss may damage the file; then it counts as not held.
        """
        path = self._store.settle(self._file, self.cid, size=self._size, spans=self._spans.values(), sync=sync)
        self._settled = True
        return path

    def _reserve(self, size: int) -> None:
        """Reserve the size that the root states."""
        if size > self._limit:
            raise ContentTooLarge(self.cid, size=size, limit=self._limit)
        self._store.reserve(self._file.path.name, size)
        with self._lock:
            self._size = size

    def _index_blocks(self) -> None:
        """Add the new blocks to the index."""
        with self._lock:
            spans, self._spans = self._spans, {}
        self._index.add(self._file.path.name, spans.values())

    def _left_over(self, ref: BlockRef) -> bytes | None:
        """A leaf of our own chunking, at its offset: from an earlier attempt, or from a damaged file."""
        if ref.size is None or ref.size > CHUNK_SIZE:
            return None
        data = b""
        if ref.offset + ref.size <= self._left_size:
            data = self._file.read(ref.size, offset=ref.offset)
        block = _leaf_of(data, ref)
        if block is None and self._damaged is not None:
            block = _leaf_of(read_or_nothing(self._damaged.fileno(), ref.size, ref.offset), ref)
        return block


def _leaf_of(data: bytes, ref: BlockRef) -> bytes | None:
    """The leaf with these bytes of the file, if its hash is that of `ref`."""
    if len(data) != ref.size:
        return None
    block = next(iter(blocks_of_stream(io.BytesIO(data))))
    return block.data if block.cid == ref.cid else None


def _part_file(directory: Path, cid: str) -> TemporaryFile:
    """The file of an earlier attempt at this CID or, if it is locked by another attempt, a new one."""
    part = TemporaryFile.take(directory / f"{PART_PREFIX}{cid}")
    if part is None:
        return TemporaryFile.create(directory, PUT_PREFIX)
    part.is_kept = True
    return part


def _damaged_file(directory: Path, cid: str) -> BinaryIO | None:
    """The file that was set aside as damaged under this CID, if any: most of its blocks may be good."""
    try:
        return (directory / f"{cid}{DAMAGED_SUFFIX}").open("rb", buffering=0)
    except FileNotFoundError:
        return None


def make_store(settings: ContentSettings, folder: Path, *, limit: int) -> Store:
    """The files by CID in a folder. `limit` is the largest file, bytes. It blocks on the disk, as the store does."""
    return Store(folder, limit=limit, quota=settings.content_limit)


def is_in_use(directory: Path) -> bool:
    """Whether a store has the directory open, in this process or another."""
    return is_locked(directory / _IN_USE)


def is_cid(name: str) -> bool:
    """Whether a file's name is a CIDv0."""
    try:
        parse_cid(name)
    except InvalidCid:
        return False
    return True


def _is_leftover(name: str) -> bool:
    return name.startswith(PART_PREFIX) or name.endswith(DAMAGED_SUFFIX)


def _is_chunked(path: Path, cid: str, progress: Progress | None) -> bool:
    """Whether a file matches its CID with our own chunking. False if the disk fails to read it."""
    with path.open("rb") as stream:
        try:
            return cid_of_stream(with_progress(stream, progress, total=os.fstat(stream.fileno()).st_size)) == cid
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return False
