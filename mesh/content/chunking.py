"""From a stream to the index of its blocks, copying it on the way. Constant memory."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, BinaryIO, Final, Protocol

from mesh.content.errors import ContentTooLarge
from mesh.content.index import Span
from schemas.cid import parse_cid
from schemas.unixfs import blocks_of_stream, parse_block

if TYPE_CHECKING:
    from mesh.content.files import TemporaryFile
    from mesh.content.index import BlockIndex

_BATCH: Final = 128
"""Blocks entered in the index at once: 32 MiB of a file, so that a file of any size takes constant memory."""


class Readable(Protocol):
    """Anything to read bytes from; an empty read is its end."""

    def read(self, size: int, /) -> bytes:
        """The next bytes, `size` of them at most."""


class CopiedStream(io.RawIOBase):
    """A stream that writes what is read of it to a file, and raises `ContentTooLarge` over `limit` bytes."""

    def __init__(self, stream: Readable, copy: TemporaryFile, *, limit: int) -> None:
        self._stream = stream
        self._copy = copy
        self._limit = limit
        self._done = 0

    def readable(self) -> bool:
        """Always."""
        return True

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        """Fill the buffer with what the stream beneath gives, once that is in the file."""
        data = self._stream.read(len(buffer))
        if self._done + len(data) > self._limit:
            raise ContentTooLarge("", size=self._done + len(data), limit=self._limit)
        self._copy.write(data, offset=self._done)
        buffer[: len(data)] = data
        self._done += len(data)
        return len(data)


def enter_blocks(stream: BinaryIO, index: BlockIndex, name: str) -> tuple[str, int]:
    """Enter all blocks of a stream in the index as those of the file `name`; the CID and the bytes of the whole."""
    offset, spans, cid = 0, [], ""
    for block in blocks_of_stream(stream):
        data = parse_block(block.data).data
        spans.append(Span.of(parse_cid(block.cid)[2:], block.data, data=data, offset=offset))
        offset, cid = offset + len(data), block.cid
        if len(spans) >= _BATCH:
            index.add(name, spans)
            spans.clear()
    index.add(name, spans)
    return cid, offset
