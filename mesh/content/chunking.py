"""From a stream to the index of its blocks, copying it on the way. Constant memory."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, BinaryIO, Final, Protocol, cast

from mesh.content.errors import ContentTooLarge
from mesh.content.index import BlockSpan
from schemas.cid import parse_cid
from schemas.unixfs import blocks_of_stream, parse_block

if TYPE_CHECKING:
    from mesh.content.files import TemporaryFile
    from mesh.content.holdings import Progress
    from mesh.content.index import BlockIndex
    from mesh.content.quota import Room

_BATCH: Final = 128
"""Blocks entered in the index at once: 32 MiB of a file, so that a file of any size takes constant memory."""


class Readable(Protocol):
    """Anything to read bytes from; an empty read is its end."""

    def read(self, size: int, /) -> bytes:
        """The next bytes, `size` of them at most."""


class CopiedStream(io.RawIOBase):
    """A stream that writes what is read of it to a file for which there is room.

    Raises `ContentTooLarge` over `limit` bytes, `QuotaReached` and `StoreFull`; before any of the bytes is written
    that are too many.
    """

    def __init__(self, stream: Readable, copy: TemporaryFile, room: Room, *, limit: int) -> None:
        self._stream = stream
        self._copy = copy
        self._room = room
        self._limit = limit
        self._reserved = 0
        self._done = 0

    def expect(self, size: int) -> None:
        """Have room for `size` bytes before any is read. Raises as reading does."""
        if size > self._limit:
            raise ContentTooLarge("", size=size, limit=self._limit)
        self._room.reserve(self._copy.path.name, size)
        self._reserved = size

    def readable(self) -> bool:
        """Always."""
        return True

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        """Fill the buffer with what the stream beneath gives, once that is in the file."""
        data = self._stream.read(len(buffer))
        done = self._done + len(data)
        if done > self._limit:
            raise ContentTooLarge("", size=done, limit=self._limit)
        if done > self._reserved:
            self._reserved = self._room.reserve_ahead(self._copy.path.name, done)
        self._copy.write(data, offset=self._done)
        buffer[: len(data)] = data
        self._done = done
        return len(data)


class ToldStream:
    """A stream that tells, after each read, how many bytes of `total` were read."""

    def __init__(self, stream: Readable, progress: Progress, *, total: int | None) -> None:
        self._stream = stream
        self._progress = progress
        self._total = total
        self._done = 0

    def read(self, size: int, /) -> bytes:
        """The next bytes, `size` of them at most."""
        data = self._stream.read(size)
        self._done += len(data)
        self._progress(self._done, self._total)
        return data


def told(stream: BinaryIO, progress: Progress | None, *, total: int | None) -> BinaryIO:
    """The same stream, to be read only, telling `progress` if there is one."""
    return stream if progress is None else cast("BinaryIO", ToldStream(stream, progress, total=total))


def enter_blocks(stream: BinaryIO, index: BlockIndex, name: str) -> tuple[str, int]:
    """Enter all blocks of a stream in the index as those of the file `name`; the CID and the bytes of the whole."""
    offset, spans, cid = 0, [], ""
    for block in blocks_of_stream(stream):
        data = parse_block(block.data).data
        spans.append(BlockSpan.of(parse_cid(block.cid)[2:], block.data, data=data, offset=offset))
        offset, cid = offset + len(data), block.cid
        if len(spans) >= _BATCH:
            index.add(name, spans)
            spans.clear()
    index.add(name, spans)
    return cid, offset
