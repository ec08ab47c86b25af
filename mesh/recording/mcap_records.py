"""The records of an MCAP file: parsing them, trusting none of the lengths, and their bytes.

Source: the MCAP specification, version 0. The `mcap` package can't be used here: it allocates what a length field asks
for, and accepts a text that is shorter than stated.
"""

from __future__ import annotations

import zlib
from struct import Struct
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from mesh.recording.decoding import Cursor
from mesh.recording.errors import CorruptRecording, NotARecording, RecordingTooLarge
from mesh.recording.source import Attachment, RecordedMessage, RecordingBlock, RecordingChannel, RecordingStatistics
from schemas.payloads import PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.recording.limits import Limits

MAGIC: Final = b"\x89MCAP0\r\n"
LIBRARY: Final = "aira-mesh"

_PREFIX: Final = Struct("<BQ")
_MESSAGE: Final = Struct("<HIQQ")
_CHUNK_HEAD: Final = 40
"""Bytes of a chunk record, without the name of its compression and its data."""
_LONGEST_COMPRESSION: Final = 32
_ATTACHMENT_HEAD: Final = 64 << 10
"""Bytes at the start of an attachment that must contain its names and times."""
_PIECE: Final = 1 << 20


class McapRecordHeader(NamedTuple):
    """The header of a record: its opcode, and the offset and length of its content."""

    opcode: int
    offset: int
    length: int


class ChunkHeader(NamedTuple):
    """The header of a chunk: where its data is, and the data's checksum."""

    block: RecordingBlock
    crc: int


def mcap_records(path: Path, file: BinaryIO, size: int) -> Iterator[McapRecordHeader]:
    """The headers of all records of a file of `size` bytes. Raises `CorruptRecording` if the file is cut or mutated."""
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
            raise CorruptRecording(path, f"a record at byte {position} has no opcode")
        yield McapRecordHeader(opcode, position, length)
        position += length
        if opcode == Opcode.FOOTER:
            break
    file.seek(position)
    if position + len(MAGIC) != size or file.read() != MAGIC:
        raise CorruptRecording(path, "it does not end as an MCAP file does")


def read_record(path: Path, file: BinaryIO, header: McapRecordHeader, *, limits: Limits) -> bytes:
    """The content of a record. Raises `RecordingTooLarge` over `limits.record`."""
    check_record_size(path, header.length, limits)
    file.seek(header.offset)
    return file.read(header.length)


def check_record_size(path: Path, size: int, limits: Limits) -> None:
    """Raise `RecordingTooLarge` if a record of `size` bytes is over `limits.record`."""
    if size > limits.record:
        raise RecordingTooLarge(
            path, f"a record of {size} bytes, more than the {limits.record} allowed", limit="record"
        )


def chunk_header(path: Path, file: BinaryIO, header: McapRecordHeader, *, limits: Limits) -> ChunkHeader:
    """The header of a chunk. Raises `RecordingTooLarge` if its data, compressed or not, is over `limits.record`."""
    file.seek(header.offset)
    fields = Cursor(path, file.read(min(header.length, _CHUNK_HEAD + _LONGEST_COMPRESSION)))
    fields.take(16)
    size, crc, compression, stored = fields.u64(), fields.u32(), fields.text(), fields.u64()
    begin = header.length - stored
    if begin != _CHUNK_HEAD + len(compression.encode()):
        raise CorruptRecording(path, f"a chunk of {header.length} bytes can't hold {stored} bytes of data")
    check_record_size(path, max(size, stored), limits)
    return ChunkHeader(RecordingBlock(header.offset + begin, stored, size, compression), crc)


def records_in_chunk(path: Path, data: bytes) -> Iterator[McapRecordHeader]:
    """The headers of the records in the decompressed data of a chunk. Raises `CorruptRecording`."""
    position, end = 0, len(data)
    while position < end:
        if end - position < _PREFIX.size:
            raise CorruptRecording(path, "a chunk ends within a record")
        opcode, length = _PREFIX.unpack_from(data, position)
        position += _PREFIX.size
        if length > end - position:
            raise CorruptRecording(path, "a record goes beyond the end of its chunk")
        yield McapRecordHeader(opcode, position, length)
        position += length


def message_of(path: Path, data: bytes, header: McapRecordHeader) -> RecordedMessage:
    """The message with that header in the data of a chunk."""
    if header.length < _MESSAGE.size:
        raise CorruptRecording(path, f"a message of {header.length} bytes")
    channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, header.offset)
    payload = data[header.offset + _MESSAGE.size : header.offset + header.length]
    return RecordedMessage(channel, sequence, log_time, publish_time, payload)


def schema_of(path: Path, data: bytes) -> tuple[int, tuple[str, str, bytes]]:
    """The number of a schema record, and its name, encoding and data. The data is never parsed."""
    cursor = Cursor(path, data)
    return cursor.u16(), (cursor.text(), cursor.text(), cursor.data())


def channel_of(path: Path, data: bytes, schemas: dict[int, tuple[str, str, bytes]]) -> tuple[int, RecordingChannel]:
    """The number of a channel record, and the channel. Raises `CorruptRecording` if its schema is not in `schemas`."""
    cursor = Cursor(path, data)
    number, schema, topic, encoding, metadata = cursor.u16(), cursor.u16(), cursor.text(), cursor.text(), cursor.pairs()
    if schema and schema not in schemas:
        raise CorruptRecording(path, f"channel {number} has an undefined schema")
    described = schemas[schema] if schema else ("", "", b"")
    return number, RecordingChannel(topic, PayloadType(encoding, *described), metadata)


def metadata_of(path: Path, data: bytes) -> tuple[str, dict[str, str]]:
    """The name and the content of a metadata record."""
    cursor = Cursor(path, data)
    return cursor.text(), cursor.pairs()


def statistics_of(path: Path, data: bytes) -> RecordingStatistics:
    """The content of a statistics record."""
    cursor = Cursor(path, data)
    messages, _schemas, channels = cursor.u64(), cursor.u16(), cursor.u32()
    attachments, _metadata, chunks, start, end = cursor.u32(), cursor.u32(), cursor.u32(), cursor.u64(), cursor.u64()
    counts = Cursor(path, cursor.data())
    by_channel = {}
    while counts.left:
        number = counts.u16()
        by_channel[number] = counts.u64()
    return RecordingStatistics(messages, channels, attachments, chunks, start, end, by_channel)


def attachment_of(path: Path, file: BinaryIO, header: McapRecordHeader) -> Attachment:
    """The attachment with that header. Its checksum is verified, its data is not kept."""
    file.seek(header.offset)
    fields = Cursor(path, file.read(min(header.length, _ATTACHMENT_HEAD)))
    before = fields.left
    log_time, create_time, name, media_type, size = (
        fields.u64(),
        fields.u64(),
        fields.text(),
        fields.text(),
        fields.u64(),
    )
    begin = before - fields.left
    if begin + size + 4 != header.length:
        raise CorruptRecording(path, f"an attachment of {header.length} bytes can't hold {size} bytes of data")
    end = header.offset + begin + size
    file.seek(end)
    check_range_crc(path, file, start=header.offset, end=end, crc=Cursor(path, file.read(4)).u32())
    return Attachment(name, media_type, log_time, create_time, header.offset + begin, size)


def check_crc(path: Path, data: bytes, crc: int) -> None:
    """Raise `CorruptRecording` unless the data of a chunk has this CRC-32; 0 means that its writer computed none."""
    if crc and zlib.crc32(data) != crc:
        raise CorruptRecording(path, "the checksum of a chunk is wrong")


def check_range_crc(path: Path, file: BinaryIO, *, start: int, end: int, crc: int) -> None:
    """Raise `CorruptRecording` unless the bytes from `start` to `end` have this CRC-32; 0 means that there is none."""
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


def header_of(profile: str, *, room: int = 0) -> bytes:
    """The header record, with room for a profile of so many characters: readers skip what follows its fields."""
    header = bytes_of(records.Header(profile, LIBRARY)) + bytes(max(room - len(profile), 0))
    return _PREFIX.pack(Opcode.HEADER, len(header) - _PREFIX.size) + header[_PREFIX.size :]


def bytes_of(*members: records.McapRecord) -> bytes:
    """Records as they are in a file."""
    builder = RecordBuilder()
    for record in members:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
