"""Decompressing a chunk to the size that it claims, and not a byte more."""

from __future__ import annotations

import bz2
import io
from typing import TYPE_CHECKING, Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from mesh.recording.errors import CorruptRecording

if TYPE_CHECKING:
    from pathlib import Path

_ZSTD_WINDOW: Final = 128 << 20
"""Bytes of memory that a zstd frame may ask for: the most that any of its ordinary levels does."""


def expand(path: Path, data: bytes, *, compression: str, size: int) -> bytes:
    """The `size` bytes that a chunk of `path` holds; `compression` is as MCAP and bags write it.

    No more than `size` and a byte are ever produced. Raises `CorruptRecording`.
    """
    try:
        expanded = _expand(data, compression, size + 1)
    except (OSError, RuntimeError, EOFError, ValueError, zstandard.ZstdError, MemoryError) as error:
        raise CorruptRecording(path, f"a {compression} chunk can't be decompressed: {error}") from None
    if len(expanded) != size:
        raise CorruptRecording(path, f"a chunk says that it holds {size} bytes, which is not so")
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
            raise ValueError("nobody here knows this compression")


def _ended(expanded: bytes, complete: bool) -> bytes:
    """What was decompressed, if the compressed data was whole (and so its checksum, if any, was compared)."""
    if not complete:
        raise ValueError("it does not end where it should")
    return expanded
