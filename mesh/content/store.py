"""Files kept under their CID in one directory.

All calls are synchronous and may wait for the disk: from an event loop, use a thread. One `Store` may be used from
several threads, and one directory by several processes; a file is there whole or not at all, whatever happens.
"""

from __future__ import annotations

import hashlib
import io
import logging
import os
import threading
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, Self

from mesh.content.assembly import Assembly
from mesh.content.chunking import CopiedStream, enter_blocks
from mesh.content.dag import MAX_BLOCKS, Place, children_of, node_at
from mesh.content.errors import ContentCorrupt, ContentUnavailable
from mesh.content.files import PUT_PREFIX, TemporaryFile, stamp
from mesh.content.opening import held_in, move_aside, open_directory
from mesh.errors import ConfigurationError
from schemas.cid import parse_cid
from schemas.unixfs import CHUNK_SIZE, cid_of_file

if TYPE_CHECKING:
    from collections.abc import Iterable
    from types import TracebackType

    from mesh.content.chunking import Readable
    from mesh.content.index import Span

log = logging.getLogger(__name__)

DEFAULT_LIMIT: Final = 1 << 30
"""Bytes of the largest file that a store takes unless told otherwise."""


class Store:
    """The files of one directory, each under its CIDv0.

    `limit` is the size in bytes of the largest file taken. The directory is made if it is not there; what a crash
    left behind is cleared, and files that the index does not know are hashed and entered, before the call returns.
    Raises `ConfigurationError` when the directory can't be used.
    """

    def __init__(self, path: str | Path, *, limit: int = DEFAULT_LIMIT) -> None:
        self.directory: Final = Path(path)
        self.limit: Final = limit
        self._lock = threading.Lock()
        self._checked: dict[str, tuple[int, ...]] = {}
        try:
            self._index = open_directory(self.directory)
        except OSError as error:
            raise ConfigurationError(
                f"can't keep files in {self.directory}: {error.strerror}", hint="name a directory that can be written"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the index. Safe to call twice; paths and open files stay good."""
        self._index.close()

    def put_stream(self, stream: Readable) -> str:
        """Keep what `stream` gives, to its end, and return its CID. Constant memory.

        Raises `ContentTooLarge` over the store's limit and `StoreFull`; then nothing is kept.
        """
        with TemporaryFile.create(self.directory, PUT_PREFIX) as temporary:
            try:
                copied = io.BufferedReader(CopiedStream(stream, temporary, limit=self.limit), CHUNK_SIZE)
                cid, size = enter_blocks(copied, self._index, temporary.path.name)
                self.settle(temporary, cid, size=size)
            except BaseException:
                self._index.forget(temporary.path.name)
                raise
        return cid

    def put_file(self, path: str | Path) -> str:
        """Keep a copy of the file at `path`; see `put_stream`. Raises `OSError` when it can't be read."""
        with Path(path).open("rb") as stream:
            return self.put_stream(stream)

    def put_bytes(self, data: bytes) -> str:
        """Keep `data`; see `put_stream`."""
        return self.put_stream(io.BytesIO(data))

    def has(self, cid: str) -> bool:
        """Whether the file is held (unchecked). Raises `InvalidCid`."""
        return self.path(cid) is not None

    def path(self, cid: str) -> Path | None:
        """Where the file is, if it is held. Its bytes are not checked: see `checked`. Raises `InvalidCid`."""
        path = self._path(cid)
        return path if path.is_file() else None

    def list(self) -> tuple[str, ...]:
        """The CIDs of all files held, sorted."""
        return held_in(self.directory)

    def checked(self, cid: str) -> Path | None:
        """Where the file is, its bytes hashed when first asked for by this process, and whenever it changed since.

        A file that has rotted is moved aside and not held any more: None. Raises `InvalidCid`.
        """
        try:
            return self.verify(cid) if self._changed(cid) else self._path(cid)
        except ContentUnavailable:
            return None
        except ContentCorrupt as error:
            log.warning("%s", error)
            return None

    def verify(self, cid: str) -> Path:
        """Hash the whole file now, and return where it is.

        Raises `ContentUnavailable` when it is not held, `ContentCorrupt` when its bytes are not those of its name; it
        is then moved aside, to `CID.corrupt`, so that it can be had again from elsewhere.
        """
        path = self._path(cid)
        try:
            before = stamp(path)
            good = cid_of_file(path) == cid or self._matches_index(path, cid)
        except FileNotFoundError:
            raise ContentUnavailable(cid, "it is not in this store") from None
        if not good:
            move_aside(path, self._index)
            raise ContentCorrupt(cid, "the bytes on the disk are others")
        with self._lock:
            self._checked[cid] = before
        return path

    def open(self, cid: str) -> BinaryIO:
        """The file, opened for reading, checked as by `checked`. Raises `ContentUnavailable`."""
        path = self.checked(cid)
        if path is None:
            raise ContentUnavailable(cid, "it is not in this store")
        return path.open("rb")

    def get_block(self, cid: str) -> bytes | None:
        """The block of that name, of any file held, its hash checked; None when no file held has it.

        Raises `InvalidCid`.
        """
        digest = parse_cid(cid)[2:]
        for name, span in self._index.find(digest):
            try:
                block = _read_block(self.directory / name, span, span.offset)
            except FileNotFoundError:
                continue
            if hashlib.sha256(block).digest() == digest:
                return block
            log.warning("%s has rotted on the disk at byte %d", name, span.offset)
            with self._lock:
                self._checked.pop(name, None)
        return None

    def assemble(self, cid: str, *, size_limit: int | None = None) -> Assembly:
        """Begin a file that comes block by block; see `Assembly`. `size_limit` (bytes) is the store's own at most."""
        limit = self.limit if size_limit is None else min(size_limit, self.limit)
        return Assembly(self, cid, size_limit=limit)

    def settle(self, temporary: TemporaryFile, cid: str, *, size: int, spans: Iterable[Span] = ()) -> Path:
        """Give a written file its CID, and enter the blocks that are not in the index yet. It counts as checked."""
        path = self._path(cid)
        self._index.add(temporary.path.name, spans)
        self._index.rename(temporary.path.name, cid)
        temporary.settle(path, size=size)
        with self._lock:
            self._checked[cid] = stamp(path)
        return path

    def _path(self, cid: str) -> Path:
        parse_cid(cid)
        return self.directory / cid

    def _changed(self, cid: str) -> bool:
        path = self._path(cid)
        with self._lock:
            known = self._checked.get(cid)
        try:
            return known != stamp(path)
        except FileNotFoundError:
            return True

    def _matches_index(self, path: Path, cid: str) -> bool:
        """Whether the file is the one of its name by the tree in the index: of a file chunked with other settings."""
        waiting, seen = [Place(cid, size=path.stat().st_size)], 0
        while waiting and seen < MAX_BLOCKS:
            place, seen = waiting.pop(), seen + 1
            digest = parse_cid(place.cid)[2:]
            span = next((span for name, span in self._index.find(digest) if name == cid), None)
            block = _read_block(path, span, place.offset) if span else b""
            if hashlib.sha256(block).digest() != digest:
                return False
            try:
                waiting.extend(children_of(place, node_at(place, block)))
            except ContentCorrupt:
                return False
        return not waiting


def _read_block(path: Path, span: Span, offset: int) -> bytes:
    with path.open("rb", buffering=0) as file:
        return span.block(os.pread(file.fileno(), span.length, offset))
