"""Decoding bytes of unknown origin: no field is read past the end, no chunk expands beyond its stated size."""

from __future__ import annotations

import bz2
import io
from struct import Struct
from typing import TYPE_CHECKING, Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from mesh.recording.errors import CorruptRecording

if TYPE_CHECKING:
    from pathlib import Path

_U16: Final = Struct("<H")
_U32: Final = Struct("<I")
_U64: Final = Struct("<Q")
_ZSTD_WINDOW: Final = 128 << 20
"""Bytes of memory that a zstd frame may ask for: the most that its ordinary levels use."""


class Cursor:
    """Reads fields of bytes one after the other, little-endian as in MCAP and bags.

    All calls raise `CorruptRecording` (of `path`) if the bytes end too early.
    """

    def __init__(self, path: Path, data: bytes) -> None:
        self._path = path
        self._data = data
        self._position = 0

    @property
    def left(self) -> int:
        """Bytes not read yet."""
        return len(self._data) - self._position

    def take(self, length: int) -> bytes:
        """The next `length` bytes."""
        if length > self.left:
            raise CorruptRecording(self._path, f"a field of {length} bytes, but only {self.left} are left")
        taken = self._data[self._position : self._position + length]
        self._position += length
        return taken

    def u16(self) -> int:
        """The next two bytes as a number."""
        return int(_U16.unpack(self.take(2))[0])

    def u32(self) -> int:
        """The next four bytes as a number."""
        return int(_U32.unpack(self.take(4))[0])

    def u64(self) -> int:
        """The next eight bytes as a number."""
        return int(_U64.unpack(self.take(8))[0])

    def data(self) -> bytes:
        """Bytes after their length, a u32."""
        return self.take(self.u32())

    def text(self) -> str:
        """A UTF-8 text after its length, a u32."""
        return text_of(self._path, self.data())

    def pairs(self) -> dict[str, str]:
        """A map of texts after its length, a u32."""
        inner = Cursor(self._path, self.data())
        found = {}
        while inner.left:
            key = inner.text()
            found[key] = inner.text()
        return found


def text_of(path: Path, data: bytes) -> str:
    """`data` as UTF-8. Raises `CorruptRecording`."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise CorruptRecording(path, f"{data[:40]!r} is not UTF-8") from None


def expand(path: Path, data: bytes, *, compression: str, size: int) -> bytes:
    """The `size` bytes that a chunk of `path` contains; `compression` is its name in MCAP and bags.

    Never produces more than `size` + 1 bytes. Raises `CorruptRecording`.
    """
    try:
        expanded = _expand(data, compression, size + 1)
    except (OSError, RuntimeError, EOFError, ValueError, zstandard.ZstdError, MemoryError) as error:
        raise CorruptRecording(path, f"a {compression} chunk can't be decompressed: {error}") from None
    if len(expanded) != size:
        raise CorruptRecording(path, f"a chunk states a size of {size} bytes, and has another")
    return expanded


def _expand(data: bytes, compression: str, most: int) -> bytes:
    match compression:
        case "" | "none":
            return data
        case "zstd":
            reader = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW).stream_reader(io.BytesIO(data))
            return bytes(reader.read(most))
        case "lz4":
            frame = lz4.frame.LZ4FrameDecompressor()
            return _ended(frame.decompress(data, max_length=most), frame.eof)
        case "bz2":
            stream = bz2.BZ2Decompressor()
            return _ended(stream.decompress(data, max_length=most), stream.eof)
        case _:
            raise ValueError("unknown compression")


def _ended(expanded: bytes, complete: bool) -> bytes:
    """The decompressed bytes. Raises `ValueError` if the input was incomplete (its checksum is then unchecked)."""
    if not complete:
        raise ValueError("it is incomplete")
    return expanded
