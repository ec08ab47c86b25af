"""Files kept under their CID in one directory.

All calls are synchronous and may wait for the disk: from an event loop, use a thread. One `Store` may be used from
several threads, and one directory by several processes; a file is there whole or not at all, whatever happens.
"""

from __future__ import annotations

import errno
import hashlib
import io
import logging
import os
import stat
import threading
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, cast

from mesh.content.assembly import Assembly
from mesh.content.chunking import CopiedStream, enter_blocks, told
from mesh.content.directory import Shelf
from mesh.content.errors import ContentCorrupt, ContentUnavailable, StoreFull
from mesh.content.files import PUT_PREFIX, TemporaryFile, directory_lock, stamp, sync_directory
from mesh.content.holdings import IntegrityReport
from mesh.content.pins import check_label
from mesh.content.reading import CheckedFile, is_tree, read_or_nothing
from mesh.content.recovery import DAMAGED_SUFFIX, is_cid, set_aside
from mesh.errors import ContentError
from schemas.cid import parse_cid
from schemas.unixfs import CHUNK_SIZE, cid_of_stream

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.content.chunking import Readable
    from mesh.content.holdings import Progress
    from mesh.content.index import BlockSpan

log = logging.getLogger(__name__)

DEFAULT_LIMIT: Final = 1 << 30
"""Bytes of the largest file that a store takes unless told otherwise."""

_TOUCH_NS: Final = 10**9
"""Reads of one file less than this apart count as one use of it."""


class Store(Shelf):
    """The files of one directory, each under its CIDv0.

    `limit` is the size in bytes of the largest file taken. `quota` is the bytes of all files together: when a new one
    would be over it, the least recently used that nobody has pinned are deleted first. Without it, the disk decides.

    The directory is made if it is not there; what a crash left behind is cleared, and files that the index does not
    know are hashed and entered, before the call returns. Raises `ConfigurationError` when the directory can't be used,
    and `StoreDamaged`.
    """

    def __init__(self, path: str | Path, *, limit: int = DEFAULT_LIMIT, quota: int | None = None) -> None:
        super().__init__(path, quota=quota)
        self.limit: Final = limit
        self._lock = threading.Lock()
        self._checked: dict[str, tuple[int, ...]] = {}
        self._touched = ("", 0)

    def put_stream(self, stream: Readable, *, pin: str | None = None, progress: Progress | None = None) -> str:
        """Keep what `stream` gives, to its end, and return its CID. Constant memory.

        With a `pin`, a label, the file is pinned before it is there. Raises `ContentTooLarge` over the store's limit,
        `QuotaReached` and `StoreFull`; then nothing is kept. Errors of the stream pass through.
        """
        return self._put(stream, 0, pin, progress)

    def put_file(self, path: str | Path, *, pin: str | None = None, progress: Progress | None = None) -> str:
        """Keep a copy of the file at `path`; see `put_stream`. Raises `OSError` when it can't be read."""
        with Path(path).open("rb") as stream:
            status = os.fstat(stream.fileno())
            return self._put(stream, status.st_size if stat.S_ISREG(status.st_mode) else 0, pin, progress)

    def put_bytes(self, data: bytes, *, pin: str | None = None) -> str:
        """Keep `data`; see `put_stream`."""
        return self._put(io.BytesIO(data), len(data), pin, None)

    def checked(self, cid: str) -> Path | None:
        """Where the file is, its bytes hashed when first asked for by this process, and whenever it changed since.

        A file that has rotted is set aside and not held any more: None. One that is not pinned may be deleted to make
        room at any time. Raises `InvalidCid`.
        """
        try:
            path = self.verify(cid) if self._changed(cid) else self._path(cid)
        except ContentError:
            return None
        self._touch(cid)
        return path

    def verify(self, cid: str, *, progress: Progress | None = None) -> Path:
        """Hash the whole file now, and return where it is.

        Raises `ContentUnavailable` when it is not held, `ContentCorrupt` when its bytes are not those of its name; it
        is then set aside, as `CID.corrupt`, so that it can be had again from elsewhere.
        """
        path = self._path(cid)
        while True:
            try:
                seen = stamp(path)
                good = _is_chunked(path, cid, progress) or is_tree(path, cid, partial(self._span, cid))
            except FileNotFoundError:
                raise ContentUnavailable(cid, "it is not in this store") from None
            if good:
                with self._lock:
                    self._checked[cid] = seen
                return path
            with directory_lock(self.directory):
                done = set_aside(path, self._index, seen=seen)
            if done:
                log.warning("%s has rotted on the disk and was set aside", path)
                raise ContentCorrupt(cid, "the bytes on the disk are others")

    def check(self, *, progress: Progress | None = None) -> IntegrityReport:
        """Hash the whole store now. Damaged files are named and set aside; those that are gone meanwhile are left out.

        `progress` is told the bytes hashed, of all.
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
        """The file, opened for reading. Every block is checked when it is read: a read raises `ContentCorrupt` where
        the file has rotted, and it is set aside. Raises `InvalidCid` and `ContentUnavailable`."""
        path = self._path(cid)
        try:
            raw = CheckedFile(path, cid, partial(self._span, cid), damaged=partial(self._suspect, cid))
        except FileNotFoundError:
            raise ContentUnavailable(cid, "it is not in this store") from None
        self._touch(cid)
        return cast("BinaryIO", io.BufferedReader(raw, CHUNK_SIZE))

    def copy(self, cid: str, target: str | Path, *, progress: Progress | None = None) -> Path:
        """Write the file to `target`, which it replaces once every block is checked and on the disk.

        Raises `InvalidCid`, `ContentUnavailable`, `ContentCorrupt`, `StoreFull` and `OSError`; then `target` is as it
        was before.
        """
        final = Path(target)
        with self.open(cid) as stream, TemporaryFile.create(final.parent, PUT_PREFIX) as temporary:
            size = stream.seek(0, os.SEEK_END)
            stream.seek(0)
            source = told(stream, progress, total=size)
            offset = 0
            while data := source.read(CHUNK_SIZE):
                temporary.write(data, offset=offset)
                offset += len(data)
            temporary.finish(size, mode=0o644)
            temporary.rename(final)
        sync_directory(final.parent)
        return final

    def get_block(self, cid: str) -> bytes | None:
        """The block of that name, of any file held or being fetched, its hash checked; None when none has it.

        A file whose block has rotted is set aside. Raises `InvalidCid`.
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
        """Begin a file that comes block by block; see `Assembly`. `size_limit` (bytes) is the store's own at most."""
        limit = self.limit if size_limit is None else min(size_limit, self.limit)
        return Assembly(self, cid, index=self._index, room=self._room, size_limit=limit)

    def settle(
        self, temporary: TemporaryFile, cid: str, *, size: int, spans: Iterable[BlockSpan] = (), pin: str | None = None
    ) -> Path:
        """Give a written file its CID, and enter the blocks that are not in the index yet. It counts as checked."""
        path, name = self._path(cid), temporary.path.name
        aside = path.with_name(f"{cid}{DAMAGED_SUFFIX}")
        self._index.add(name, spans, size=size)
        temporary.finish(size)
        with directory_lock(self.directory):
            if pin is not None:
                self._pins.add(cid, pin)
            self._index.rename(name, cid)
            temporary.rename(path)
            aside.unlink(missing_ok=True)
            self._index.forget(aside.name)
            seen = stamp(path)
        sync_directory(self.directory)
        with self._lock:
            self._checked[cid] = seen
        return path

    def _put(self, stream: Readable, size: int, pin: str | None, progress: Progress | None) -> str:
        """Keep the stream; `size` bytes are expected, 0 where nobody knows."""
        if pin is not None:
            check_label(pin)
        with TemporaryFile.create(self.directory, PUT_PREFIX) as temporary:
            try:
                copied = CopiedStream(stream, temporary, self._room, limit=self.limit)
                copied.expect(size)
                source = told(cast("BinaryIO", io.BufferedReader(copied, CHUNK_SIZE)), progress, total=size or None)
                cid, size = enter_blocks(source, self._index, temporary.path.name)
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
        """Look into a file of which a block is not what it should be."""
        with suppress(ContentError):
            self.verify(cid)
            log.error("%s is whole, but the index has it otherwise: delete the index while nobody uses it", cid)

    def _touch(self, name: str) -> None:
        now = time.time_ns()
        with self._lock:
            last, when = self._touched
            if last == name and 0 <= now - when < _TOUCH_NS:
                return
            self._touched = (name, now)
        with suppress(StoreFull):  # a full disk is no reason not to read: only the order of use is less exact
            self._index.touch(name, used_ns=now)


def _is_chunked(path: Path, cid: str, progress: Progress | None) -> bool:
    """Whether a file is the one of its name with our own chunking; not if the disk can't read it any more."""
    with path.open("rb") as stream:
        try:
            return cid_of_stream(told(stream, progress, total=os.fstat(stream.fileno()).st_size)) == cid
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return False


def _read_span(path: Path, span: BlockSpan) -> bytes:
    with path.open("rb", buffering=0) as file:
        return span.block(read_or_nothing(file.fileno(), span.length, span.offset))


def _shifted(progress: Progress, before: int, total: int) -> Progress:
    return lambda done, _: progress(before + done, total)
