"""Files kept under their CID in one directory.

All calls are synchronous and may wait for the disk: from an event loop, use a thread. One `Store` may be used from
several threads, and one directory by several processes. A file is held whole or not at all, whatever happens. One that
was not synced may be damaged after a power loss: reading finds that, and then it is not held.
"""

from __future__ import annotations

import errno
import hashlib
import io
import logging
import os
import stat
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, cast

from mesh.content.assembly import Assembly
from mesh.content.dag import CheckedFile, matches_tree
from mesh.content.directory import StoreDirectory
from mesh.content.errors import ContentCorrupt, ContentUnavailable, StoreFull
from mesh.content.files import (
    PUT_PREFIX,
    TemporaryFile,
    directory_lock,
    read_or_nothing,
    stamp,
    sync_directory,
    with_progress,
)
from mesh.content.quota import CopyingStream, check_label
from mesh.content.recovery import is_cid, set_aside
from mesh.errors import ContentError
from mesh.log_context import log_event
from schemas.cid import parse_cid
from schemas.unixfs import CHUNK_SIZE, cid_of_stream

if TYPE_CHECKING:
    from mesh.content.files import Progress, Readable
    from mesh.content.index import BlockSpan

log = logging.getLogger(__name__)

DEFAULT_LIMIT: Final = 1 << 30
"""Bytes of the largest file that a store accepts by default."""

_TOUCH_NS: Final = 10**9
"""Reads of one file that are less than this apart count as one use."""


@dataclass(frozen=True, kw_only=True)
class IntegrityReport:
    """The outcome of hashing the whole store: how much was hashed, and the CIDs of the files that do not match."""

    files: int
    bytes: int
    damaged: tuple[str, ...]


class Store(StoreDirectory):
    """The files of one directory, each under its CIDv0.

    `limit` is the size in bytes of the largest file accepted. `quota` is the limit for all files together: the least
    recently used files without a pin are evicted to stay within it. Without a quota, the disk is the limit.

    Creates the directory if it does not exist, deletes what a crash left behind, and hashes files that the index does
    not know. Raises `ConfigurationError` if the directory can't be used, and `StoreDamaged`.
    """

    def __init__(self, path: str | Path, *, limit: int = DEFAULT_LIMIT, quota: int | None = None) -> None:
        super().__init__(path, quota=quota)
        self.limit: Final = limit
        self._touched = ("", 0)

    def put_stream(self, stream: Readable, *, pin: str | None = None, progress: Progress | None = None) -> str:
        """Store everything that `stream` gives, and return its CID. Constant memory.

        With a `pin`, a label, the file is pinned before it can be evicted. Raises `ContentTooLarge` over the store's
        limit, `QuotaReached` and `StoreFull`; then nothing is kept. Errors of the stream pass through.
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
                done = set_aside(path, self._index, seen=seen)
            if done:
                event = log_event("content-damaged", cid=cid)
                log.warning("%s was damaged on the disk and set aside", path, extra=event)
                raise ContentCorrupt(cid, "the bytes on the disk have another hash")

    def check(self, *, progress: Progress | None = None) -> IntegrityReport:
        """Hash the whole store now. Damaged files are reported and set aside; files that vanish meanwhile are skipped.

        `progress` gets the bytes hashed, of all.
        """
        sizes = {cid: path.stat().st_size for cid in self.list() if (path := self.path(cid))}
        done, files, damaged = 0, 0, []
        for cid, size in sizes.items():
            advance = None if progress is None else _shifted(progress, done, sum(sizes.values()))
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
                block = _read_span(self.directory / name, span)
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
        return Assembly(
            self, cid, index=self._index, quota=self._quota, get_stored_block=self.get_block, size_limit=limit
        )

    def _put(self, stream: Readable, size: int, pin: str | None, progress: Progress | None) -> str:
        """Store the stream. `size` is the expected number of bytes, 0 if unknown."""
        if pin is not None:
            check_label(pin)
        with TemporaryFile.create(self.directory, PUT_PREFIX) as temporary:
            try:
                copied = CopyingStream(stream, temporary, self._quota, limit=self.limit)
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
        now = time.time_ns()
        with self._lock:
            last, when = self._touched
            if last == name and 0 <= now - when < _TOUCH_NS:
                return
            self._touched = (name, now)
        with suppress(StoreFull):  # on a full disk, reading still works: only the eviction order is less exact
            self._index.touch(name, used_ns=now)


def _is_chunked(path: Path, cid: str, progress: Progress | None) -> bool:
    """Whether a file matches its CID with our own chunking. False if the disk fails to read it."""
    with path.open("rb") as stream:
        try:
            return cid_of_stream(with_progress(stream, progress, total=os.fstat(stream.fileno()).st_size)) == cid
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return False


def _read_span(path: Path, span: BlockSpan) -> bytes:
    with path.open("rb", buffering=0) as file:
        return span.block(read_or_nothing(file.fileno(), span.length, span.offset))


def _shifted(progress: Progress, before: int, total: int) -> Progress:
    return lambda done, _: progress(before + done, total)
