"""The records of an MCAP file, one after the other, believing no length that they claim.

Source: the MCAP specification, version 0. The records are read here rather than by the `mcap` package because that one
allocates what a length field asks for, and takes a text that is shorter than it says.
"""

from __future__ import annotations

import zlib
from struct import Struct
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

from mcap.opcode import Opcode

from mesh.recording.cursor import Cursor
from mesh.recording.errors import CorruptRecording, NotARecording, RecordingTooLarge
from mesh.recording.source import Attachment, Block, Channel, Record, RecordingStatistics
from schemas.payloads import PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.recording.limits import Limits

MAGIC: Final = b"\x89MCAP0\r\n"

_PREFIX: Final = Struct("<BQ")
_MESSAGE: Final = Struct("<HIQQ")
_CHUNK_HEAD: Final = 40
"""Bytes of a chunk record before its compression's name and the length of its data."""
_LONGEST_COMPRESSION: Final = 32
_ATTACHMENT_HEAD: Final = 64 << 10
"""Bytes of an attachment in which its names and times must lie."""
_PIECE: Final = 1 << 20


class Frame(NamedTuple):
    """A record of a file: its opcode, and where its `length` bytes begin."""

    opcode: int
    offset: int
    length: int


class ChunkHead(NamedTuple):
    """A chunk before its data is looked at."""

    block: Block
    crc: int


def frames(path: Path, file: BinaryIO, size: int) -> Iterator[Frame]:
    """The records of a file of `size` bytes up to its footer. Raises `CorruptRecording` where it is cut or mutated."""
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise NotARecording(path, "it does not begin as an MCAP file does")
    position = len(MAGIC)
    while True:
        file.seek(position)
        prefix = file.read(_PREFIX.size)
        if len(prefix) < _PREFIX.size:
            raise CorruptRecording(path, "it is cut off")
        opcode, length = _PREFIX.unpack(prefix)
        position += _PREFIX.size
        if length > size - position:
            raise CorruptRecording(path, f"a record at byte {position} goes beyond the end of the file")
        if not opcode:
            raise CorruptRecording(path, f"a record at byte {position} is of no kind")
        yield Frame(opcode, position, length)
        position += length
        if opcode == Opcode.FOOTER:
            break
    file.seek(position)
    if position + len(MAGIC) != size or file.read() != MAGIC:
        raise CorruptRecording(path, "it does not end as an MCAP file does")


def content(path: Path, file: BinaryIO, frame: Frame, *, limits: Limits) -> bytes:
    """The bytes of a record. Raises `RecordingTooLarge` over `limits.record`."""
    check_record_size(path, frame.length, limits)
    file.seek(frame.offset)
    return file.read(frame.length)


def check_record_size(path: Path, size: int, limits: Limits) -> None:
    """Raise `RecordingTooLarge` if a record of `size` bytes is over `limits.record`."""
    if size > limits.record:
        raise RecordingTooLarge(path, f"a record of {size} bytes, more than the {limits.record} allowed")


def chunk_head(path: Path, file: BinaryIO, frame: Frame, *, limits: Limits) -> ChunkHead:
    """Where the data of a chunk is. Raises `RecordingTooLarge` if it or what it expands to is over `limits.record`."""
    file.seek(frame.offset)
    head = Cursor(path, file.read(min(frame.length, _CHUNK_HEAD + _LONGEST_COMPRESSION)))
    head.take(16)
    size, crc, compression, stored = head.u64(), head.u32(), head.text(), head.u64()
    begin = frame.length - stored
    if begin != _CHUNK_HEAD + len(compression.encode()):
        raise CorruptRecording(path, f"a chunk of {frame.length} bytes can't hold {stored} bytes of data")
    check_record_size(path, max(size, stored), limits)
    return ChunkHead(Block(frame.offset + begin, stored, size, compression), crc)


def entries(path: Path, data: bytes) -> Iterator[Frame]:
    """The records in the decompressed data of a chunk, with their place in it. Raises `CorruptRecording`."""
    position, end = 0, len(data)
    while position < end:
        if end - position < _PREFIX.size:
            raise CorruptRecording(path, "a chunk ends within a record")
        opcode, length = _PREFIX.unpack_from(data, position)
        position += _PREFIX.size
        if length > end - position:
            raise CorruptRecording(path, "a record goes beyond the end of its chunk")
        yield Frame(opcode, position, length)
        position += length


def record_of(path: Path, data: bytes, frame: Frame) -> Record:
    """The message of that frame of a chunk's data."""
    if frame.length < _MESSAGE.size:
        raise CorruptRecording(path, f"a message of {frame.length} bytes")
    channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, frame.offset)
    payload = data[frame.offset + _MESSAGE.size : frame.offset + frame.length]
    return Record(channel, sequence, log_time, publish_time, payload)


def schema_of(path: Path, data: bytes) -> tuple[int, tuple[str, str, bytes]]:
    """The id of a schema record, and its name, encoding and data. The data is never looked into."""
    cursor = Cursor(path, data)
    return cursor.u16(), (cursor.text(), cursor.text(), cursor.data())


def channel_of(path: Path, data: bytes, schemas: dict[int, tuple[str, str, bytes]]) -> tuple[int, Channel]:
    """The id of a channel record and the channel. Raises `CorruptRecording` if its schema was not seen before."""
    cursor = Cursor(path, data)
    number, schema, topic, encoding, metadata = cursor.u16(), cursor.u16(), cursor.text(), cursor.text(), cursor.pairs()
    if schema and schema not in schemas:
        raise CorruptRecording(path, f"channel {number} has a schema that is not there")
    described = schemas[schema] if schema else ("", "", b"")
    return number, Channel(topic, PayloadType(encoding, *described), metadata)


def metadata_of(path: Path, data: bytes) -> tuple[str, dict[str, str]]:
    """The name and the content of a metadata record."""
    cursor = Cursor(path, data)
    return cursor.text(), cursor.pairs()


def statistics_of(path: Path, data: bytes) -> RecordingStatistics:
    """What a statistics record says."""
    cursor = Cursor(path, data)
    messages, _schemas, channels = cursor.u64(), cursor.u16(), cursor.u32()
    attachments, _metadata, chunks, start, end = cursor.u32(), cursor.u32(), cursor.u32(), cursor.u64(), cursor.u64()
    counts = Cursor(path, cursor.data())
    by_channel = {}
    while counts.left:
        number = counts.u16()
        by_channel[number] = counts.u64()
    return RecordingStatistics(messages, channels, attachments, chunks, start, end, by_channel)


def attachment_of(path: Path, file: BinaryIO, frame: Frame) -> Attachment:
    """The attachment of that frame, its checksum compared and its data not kept."""
    file.seek(frame.offset)
    head = Cursor(path, file.read(min(frame.length, _ATTACHMENT_HEAD)))
    before = head.left
    log_time, create_time, name, media_type, size = head.u64(), head.u64(), head.text(), head.text(), head.u64()
    begin = before - head.left
    if begin + size + 4 != frame.length:
        raise CorruptRecording(path, f"an attachment of {frame.length} bytes can't hold {size} bytes of data")
    end = frame.offset + begin + size
    file.seek(end)
    check_stretch(path, file, start=frame.offset, end=end, crc=Cursor(path, file.read(4)).u32())
    return Attachment(name, media_type, log_time, create_time, frame.offset + begin, size)


def check_crc(path: Path, data: bytes, crc: int) -> None:
    """Raise `CorruptRecording` if the data of a chunk has another CRC-32; 0 means that its writer made none."""
    if crc and zlib.crc32(data) != crc:
        raise CorruptRecording(path, "the checksum of a chunk is wrong")


def check_stretch(path: Path, file: BinaryIO, *, start: int, end: int, crc: int) -> None:
    """Raise `CorruptRecording` if the bytes of the file from `start` to `end` have another CRC-32; 0 means none."""
    if not crc:
        return
    found, left = 0, end - start
    file.seek(min(start, end))
    while left > 0:
        piece = file.read(min(left, _PIECE))
        if not piece:
            break
        found, left = zlib.crc32(piece, found), left - len(piece)
    if found != crc:
        raise CorruptRecording(path, "a checksum is wrong")
