"""Parsing the records of a ROS 1 bag, trusting none of the lengths in it.

Source: the ROS bag format, version 2.0.
"""

from __future__ import annotations

from enum import IntEnum
from struct import Struct
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

from mesh.recording.decoding import Cursor, text_of
from mesh.recording.errors import CorruptRecording, NotARecording
from mesh.recording.source import RecordedMessage, RecordingChannel
from schemas.payloads import PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

MAGIC: Final = b"#ROSBAG V2.0\n"

_LENGTH: Final = Struct("<I")
_TIME: Final = Struct("<II")
_HEADER: Final = 64 << 10
"""Bytes of the longest record header accepted."""
_SECOND: Final = 10**9
_FIELDS: Final = 12
"""The most fields of a header or connection accepted: twice as many as the format uses."""


class BagOp(IntEnum):
    """The kinds of records."""

    MESSAGE = 2
    BAG = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


CONNECTION: Final = bytes([BagOp.CONNECTION])
_IN_CHUNKS: Final = frozenset({CONNECTION, bytes([BagOp.MESSAGE])})


class BagRecord(NamedTuple):
    """A record: the fields of its header, where it begins, and the offset and length of its data."""

    fields: dict[bytes, bytes]
    begin: int
    offset: int
    length: int

    @property
    def opcode(self) -> int:
        """The kind of the record, a `BagOp`; -1 if it has none."""
        value = self.fields.get(b"op", b"")
        return value[0] if len(value) == 1 else -1


def bag_records(path: Path, file: BinaryIO, size: int) -> Iterator[BagRecord]:
    """The records of a bag in file order, without their data. Raises `CorruptRecording` if the bag is cut off."""
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise NotARecording(path, "it does not begin as a bag does")
    position = len(MAGIC)
    while position < size:
        file.seek(position)
        length = _length(path, file.read(_LENGTH.size))
        if length > min(_HEADER, size - position):
            raise CorruptRecording(path, f"a record header of {length} bytes at byte {position}")
        fields = fields_of(path, file.read(length))
        offset = position + length + 2 * _LENGTH.size
        record = BagRecord(fields, position, offset, _length(path, file.read(_LENGTH.size)))
        if record.length > size - offset:
            raise CorruptRecording(path, f"it is cut off: a record at byte {position} goes beyond the end")
        _check_first(path, record, size)
        yield record
        position = offset + record.length


def fields_of(path: Path, header: bytes) -> dict[bytes, bytes]:
    """The fields of a record header, or of a connection. Raises `CorruptRecording`."""
    position, end, fields = 0, len(header), dict[bytes, bytes]()
    while position < end:
        begin = position + _LENGTH.size
        if begin > end:
            raise CorruptRecording(path, "it is cut off in a field of a record")
        position = begin + _LENGTH.unpack_from(header, position)[0]
        name, equals, value = header[begin:position].partition(b"=")
        if position > end or not equals or name in fields or len(fields) == _FIELDS:
            raise CorruptRecording(path, "a field of a record goes beyond its end, has no name, or is one too many")
        fields[name] = value
    return fields


def records_in_chunk(path: Path, data: bytes) -> Iterator[BagRecord]:
    """The records in the decompressed data of a chunk. Raises `CorruptRecording`."""
    position, end = 0, len(data)
    while position < end:
        header = position + _LENGTH.size
        if header > end:
            raise CorruptRecording(path, "it is cut off in a chunk")
        offset = header + _LENGTH.unpack_from(data, position)[0] + _LENGTH.size
        if offset > end or offset > header + _HEADER:
            raise CorruptRecording(path, "it is cut off in a chunk")
        fields = fields_of(path, data[header : offset - 4])
        length = _LENGTH.unpack_from(data, offset - 4)[0]
        if length > end - offset or fields.get(b"op") not in _IN_CHUNKS:
            raise CorruptRecording(path, "a chunk holds something else than whole messages and connections")
        yield BagRecord(fields, position, offset, length)
        position = offset + length


def message_of(path: Path, record: BagRecord, data: bytes) -> RecordedMessage:
    """The message of a record in a chunk's data. Bags have one time for it, and no sequence number."""
    time = record.fields.get(b"time", b"")
    if len(time) != _TIME.size:
        raise CorruptRecording(path, "a message without a time")
    seconds, nanoseconds = _TIME.unpack(time)
    when = seconds * _SECOND + nanoseconds
    payload = data[record.offset : record.offset + record.length]
    return RecordedMessage(number_of(path, record, b"conn"), 0, when, when, payload)


def channel_of(path: Path, record: BagRecord, connection: dict[bytes, bytes]) -> RecordingChannel:
    """The channel for a connection, which is a record and the fields of its data."""
    kind = text_of(path, connection.get(b"type", b""))
    definition = connection.get(b"message_definition", b"")
    topic = record.fields.get(b"topic") or connection.get(b"topic", b"")
    if not topic or not kind:
        raise CorruptRecording(path, "a connection without topic or type")
    metadata = {
        text_of(path, name): text_of(path, value)
        for name, value in connection.items()
        if name not in (b"type", b"message_definition")
    }
    return RecordingChannel(text_of(path, topic), PayloadType("ros1", kind, "ros1msg", definition), metadata)


def _check_first(path: Path, record: BagRecord, size: int) -> None:
    if record.begin != len(MAGIC):
        return
    if record.opcode != BagOp.BAG:
        raise CorruptRecording(path, "its first record is not that of a bag")
    if record.fields.get(b"encryptor"):
        raise NotARecording(path, "it is encrypted")
    if Cursor(path, record.fields.get(b"index_pos", b"")).u64() > size:
        raise CorruptRecording(path, "it is cut off before its index")


def number_of(path: Path, record: BagRecord, name: bytes) -> int:
    """A field of four bytes as a number. Raises `CorruptRecording` if the record does not have it."""
    value = record.fields.get(name, b"")
    if len(value) != 4:
        raise CorruptRecording(path, f"a record without its field {name.decode()}")
    return int.from_bytes(value, "little")


def _length(path: Path, data: bytes) -> int:
    if len(data) != _LENGTH.size:
        raise CorruptRecording(path, "it is cut off")
    return int.from_bytes(data, "little")
