"""The records of a ROS 1 bag, one after the other, believing no length that they claim.

Source: the ROS bag format, version 2.0.
"""

from __future__ import annotations

from enum import IntEnum
from struct import Struct
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

from mesh.recording.cursor import Cursor, text_of
from mesh.recording.errors import CorruptRecording, NotARecording
from mesh.recording.source import Channel, Record
from schemas.payloads import PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

MAGIC: Final = b"#ROSBAG V2.0\n"

_LENGTH: Final = Struct("<I")
_TIME: Final = Struct("<II")
_HEADER: Final = 64 << 10
"""Bytes of the longest record header taken; what is long is in the data of a record."""
_SECOND: Final = 10**9
_FIELDS: Final = 12
"""Fields of a header or a connection that are taken: twice as many as any that the format names has."""


class Op(IntEnum):
    """The kinds of records."""

    MESSAGE = 2
    BAG = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


CONNECTION: Final = bytes([Op.CONNECTION])
_IN_CHUNKS: Final = frozenset({CONNECTION, bytes([Op.MESSAGE])})


class Part(NamedTuple):
    """A record: the fields of its header, where it begins, and where its data is."""

    fields: dict[bytes, bytes]
    begin: int
    offset: int
    length: int

    @property
    def opcode(self) -> int:
        """What kind of record it is; -1 if it does not say."""
        value = self.fields.get(b"op", b"")
        return value[0] if len(value) == 1 else -1


def parts(path: Path, file: BinaryIO, size: int) -> Iterator[Part]:
    """The records of a bag, front to back; their data is not read. Raises `CorruptRecording` where it is cut."""
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
        part = Part(fields, position, offset, _length(path, file.read(_LENGTH.size)))
        if part.length > size - offset:
            raise CorruptRecording(path, f"it is cut off: a record at byte {position} goes beyond the end")
        _check_first(path, part, size)
        yield part
        position = offset + part.length


def fields_of(path: Path, header: bytes) -> dict[bytes, bytes]:
    """The fields of a record header, or of a connection: each `name=value` after its length.

    Raises `CorruptRecording`.
    """
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


def parts_in(path: Path, data: bytes) -> Iterator[Part]:
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
            raise CorruptRecording(path, "a chunk holds what is neither a whole message nor a connection")
        yield Part(fields, position, offset, length)
        position = offset + length


def record_of(path: Path, part: Part, data: bytes) -> Record:
    """The message of a record of a chunk's data; bags hold one time for it, and no sequence number."""
    time = part.fields.get(b"time", b"")
    if len(time) != _TIME.size:
        raise CorruptRecording(path, "a message without a time")
    seconds, nanoseconds = _TIME.unpack(time)
    when = seconds * _SECOND + nanoseconds
    payload = data[part.offset : part.offset + part.length]
    return Record(number_of(path, part, b"conn"), 0, when, when, payload)


def channel_of(path: Path, part: Part, connection: dict[bytes, bytes]) -> Channel:
    """The channel that a connection is: a record, and the fields of its data."""
    kind = text_of(path, connection.get(b"type", b""))
    definition = connection.get(b"message_definition", b"")
    topic = part.fields.get(b"topic") or connection.get(b"topic", b"")
    if not topic or not kind:
        raise CorruptRecording(path, "a connection without topic or type")
    metadata = {
        text_of(path, name): text_of(path, value)
        for name, value in connection.items()
        if name not in (b"type", b"message_definition")
    }
    return Channel(text_of(path, topic), PayloadType("ros1", kind, "ros1msg", definition), metadata)


def _check_first(path: Path, part: Part, size: int) -> None:
    if part.begin != len(MAGIC):
        return
    if part.opcode != Op.BAG:
        raise CorruptRecording(path, "its first record is not that of a bag")
    if part.fields.get(b"encryptor"):
        raise NotARecording(path, "it is encrypted")
    if Cursor(path, part.fields.get(b"index_pos", b"")).u64() > size:
        raise CorruptRecording(path, "it is cut off before its index")


def number_of(path: Path, part: Part, name: bytes) -> int:
    """A field of four bytes as a number. Raises `CorruptRecording` if it is not there."""
    value = part.fields.get(name, b"")
    if len(value) != 4:
        raise CorruptRecording(path, f"a record without its field {name.decode()}")
    return int.from_bytes(value, "little")


def _length(path: Path, data: bytes) -> int:
    if len(data) != _LENGTH.size:
        raise CorruptRecording(path, "it is cut off")
    return int.from_bytes(data, "little")
