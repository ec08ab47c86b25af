"""Reading a held file block by block, each checked by its hash against the tree that its CID names."""

from __future__ import annotations

import errno
import hashlib
import io
import os
from typing import TYPE_CHECKING, Final

from mesh.content.dag import MAX_BLOCKS, BlockRef, children_of, node_at
from mesh.content.errors import ContentCorrupt
from schemas.cid import parse_cid

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from mesh.content.index import BlockSpan
    from schemas.unixfs import UnixfsNode

    SpanOf = Callable[[bytes], BlockSpan | None]
    """Where the block of a digest is in the file that is read, and what is around it."""


class CheckedFile(io.RawIOBase):
    """The file at `path` for reading and seeking. Raises `ContentCorrupt` where a block is not what its name says.

    `damaged` is called before that. Nothing is hashed before it is read, so any file opens at once.
    """

    def __init__(self, path: Path, cid: str, span_of: SpanOf, *, damaged: Callable[[], None]) -> None:
        self._file: Final = path.open("rb", buffering=0)
        self._cid = cid
        self._span_of = span_of
        self._damaged = damaged
        self._position = 0
        self._path: list[tuple[BlockRef, UnixfsNode]] = []
        """The nodes from the root to the one that was read last."""
        try:
            self._size = self._node(BlockRef(cid), 0).file_size
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file beneath."""
        self._file.close()
        super().close()

    def readable(self) -> bool:
        """Always."""
        return True

    def seekable(self) -> bool:
        """Always."""
        return True

    def tell(self) -> int:
        """The position in bytes."""
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Go to a position; see `io.IOBase.seek`. Raises `ValueError` before the start."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        if base + offset < 0:
            raise ValueError(f"position {base + offset} is before the start")
        self._position = base + offset
        return self._position

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        """Fill the buffer with as much as the block at the position has."""
        if self._position >= self._size or not buffer:
            return 0
        start, data = self._data_at(self._position)
        data = data[self._position - start :][: len(buffer)]
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)

    def _data_at(self, position: int) -> tuple[int, bytes]:
        """The bytes of the block that has the byte at `position`, and where they begin."""
        place, depth = BlockRef(self._cid), 0
        while True:
            node = self._node(place, depth)
            if position < place.offset + len(node.data):
                return place.offset, node.data
            below = [child for child in children_of(place, node) if child.offset <= position]
            place, depth = below[-1], depth + 1

    def _node(self, place: BlockRef, depth: int) -> UnixfsNode:
        if depth < len(self._path) and self._path[depth][0] == place:
            return self._path[depth][1]
        try:
            node = node_at(place, read_block(self._file, place, self._span_of))
        except ContentCorrupt as error:
            self._damaged()
            raise ContentCorrupt(self._cid, f"in block {place.cid}: {error.why}") from None
        self._path[depth:] = [(place, node)]
        return node


def read_block(file: io.FileIO, place: BlockRef, span_of: SpanOf) -> bytes:
    """The block of a place, from the open file. Raises `ContentCorrupt` when the disk has other bytes, or none."""
    digest = parse_cid(place.cid)[2:]
    span = span_of(digest)
    if span is None:
        raise ContentCorrupt(place.cid, "the index does not know it")
    block = span.block(read_or_nothing(file.fileno(), span.length, place.offset))
    if hashlib.sha256(block).digest() != digest:
        raise ContentCorrupt(place.cid, "the bytes on the disk are others")
    return block


def read_or_nothing(descriptor: int, length: int, offset: int) -> bytes:
    """The bytes at `offset`, or none where the disk can't read them any more."""
    try:
        return os.pread(descriptor, length, offset)
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        return b""


def is_tree(path: Path, cid: str, span_of: SpanOf) -> bool:
    """Whether a file is the one of its name by the tree in the index, with whatever settings it was chunked."""
    waiting, seen = [BlockRef(cid, size=path.stat().st_size)], 0
    with path.open("rb", buffering=0) as file:
        while waiting and seen < MAX_BLOCKS:
            place, seen = waiting.pop(), seen + 1
            try:
                waiting.extend(children_of(place, node_at(place, read_block(file, place, span_of))))
            except ContentCorrupt:
                return False
    return not waiting
