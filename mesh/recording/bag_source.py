"""Reading ROS 1 bags, version 2.0, of unknown origin: closed or cut between two records, indexed or not.

Records are read front to back and their index is not used, since it may say anything. A bag has no checksums of its
own. Source: the ROS bag format, version 2.0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from struct import Struct
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

from mesh.recording.cursor import Cursor, text_of
from mesh.recording.errors import CorruptRecording, NotARecording, RecordingTooLarge
from mesh.recording.source import Block, Channel, Record, Segment, Source, check_window, load, survey
from schemas.payloads import PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.recording.limits import Limits

MAGIC: Final = b"#ROSBAG V2.0\n"

_LENGTH: Final = Struct("<I")
_TIME: Final = Struct("<II")
_HEADER: Final = 64 << 10
"""Bytes of the longest record header taken; what is long is in the data of a record."""
_SECOND: Final = 10**9


class _Op(IntEnum):
    """The kinds of records."""

    MESSAGE = 2
    BAG = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


_CONNECTION: Final = bytes([_Op.CONNECTION])
_IN_CHUNKS: Final = frozenset({_CONNECTION, bytes([_Op.MESSAGE])})


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


def open_bag(path: Path, size: int, limits: Limits) -> Source:
    """Check the whole of a bag of `size` bytes.

    Raises `CorruptRecording`, `RecordingTooLarge`, and `NotARecording` if it is no bag, or an encrypted one.
    """
    with path.open("rb") as file:
        expanded = 0
        for number, part in enumerate(parts(path, file, size)):
            if number > 2 * limits.messages:
                raise RecordingTooLarge(path, f"more than {2 * limits.messages} records")
            if part.opcode == _Op.CHUNK:
                expanded += _chunk_block(path, part, limits).size
            if expanded > limits.expanded:
                raise RecordingTooLarge(path, f"its chunks expand to more than the {limits.expanded} bytes allowed")
        reading = _Reading(path, file, limits)
        for part in parts(path, file, size):
            reading.take(part)
    check_window(path, reading.segments, limits)
    records = partial(_records_in, path)
    return Source(path, "bag", size, reading.channels, tuple(reading.segments), {}, records)


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
    """The fields of a record header, or of a connection: each `name=value` after its length."""
    position, end, fields = 0, len(header), {}
    while position < end:
        length = int.from_bytes(header[position : position + 4], "little")
        position += 4 + length
        if position > end:
            raise CorruptRecording(path, f"a field of {length} bytes goes beyond the end of its record")
        name, equals, value = header[position - length : position].partition(b"=")
        if not equals:
            raise CorruptRecording(path, "a field of a record has no name")
        fields[name] = value
    return fields


@dataclass
class _Reading:
    path: Path
    file: BinaryIO
    limits: Limits
    channels: dict[int, Channel] = field(default_factory=dict)
    segments: list[Segment] = field(default_factory=list)
    _defined: int = 0
    _messages: int = 0
    _blocks: int = 0
    _connections: int = 0
    _said: dict[int, tuple[dict[bytes, bytes], bytes]] = field(default_factory=dict)

    def take(self, part: Part) -> None:
        """Read one record of the file. Messages are checked and counted, and their places kept."""
        match part.opcode:
            case _Op.CHUNK:
                block = _chunk_block(self.path, part, self.limits)
                self._take_block(block)
            case _Op.MESSAGE:
                whole = part.offset + part.length - part.begin
                if whole > self.limits.record:
                    raise RecordingTooLarge(self.path, f"a message of {whole} bytes")
                self._take_block(Block(part.begin, whole, whole))
            case _Op.CONNECTION:
                self.file.seek(part.offset)
                self._connect(part, self.file.read(min(part.length, self.limits.definitions + 1)))
            case _Op.BAG | _Op.INDEX | _Op.CHUNK_INFO:
                pass
            case opcode:
                raise CorruptRecording(self.path, f"a record of the unknown kind {opcode}")

    def _take_block(self, block: Block) -> None:
        data = load(self.path, self.file, block)
        segment = survey(self.path, self._blocks, block, records=self._checked(data))
        self._blocks += 1
        if segment is None:
            return
        self.segments.append(segment)
        self._messages += segment.count
        if self._messages > self.limits.messages:
            raise RecordingTooLarge(self.path, f"more than {self.limits.messages} messages")

    def _checked(self, data: bytes) -> Iterator[Record]:
        for part in _parts_in(self.path, data):
            if part.fields[b"op"] == _CONNECTION:
                self._connect(part, data[part.offset : part.offset + part.length])
                continue
            record = _record_of(self.path, part, data)
            if record.channel not in self.channels:
                raise CorruptRecording(self.path, f"a message of connection {record.channel}, which is not there")
            yield record

    def _connect(self, part: Part, data: bytes) -> None:
        self._connections += 1
        if self._connections > self.limits.messages:
            raise RecordingTooLarge(self.path, f"more than {self.limits.messages} records besides its messages")
        number = _number(self.path, part, b"conn")
        if self._said.get(number) == (part.fields, data):
            return
        self._said[number] = part.fields, data
        channel = _channel_of(self.path, part, fields_of(self.path, data))
        if self.channels.setdefault(number, channel) is not channel:
            if self.channels[number] != channel:
                raise CorruptRecording(self.path, f"two different connections have the number {number}")
            return
        self._defined += len(data)
        if self._defined > self.limits.definitions or len(self.channels) > self.limits.channels:
            raise RecordingTooLarge(
                self.path, f"{len(self.channels)} connections, {self._defined} bytes of definitions"
            )


def _parts_in(path: Path, data: bytes) -> Iterator[Part]:
    """The records in the decompressed data of a chunk."""
    position, end = 0, len(data)
    while position < end:
        header = position + 4
        offset = header + int.from_bytes(data[position:header], "little") + 4
        if offset > end:
            raise CorruptRecording(path, "it is cut off in a chunk")
        fields = fields_of(path, data[header : offset - 4])
        length = int.from_bytes(data[offset - 4 : offset], "little")
        if length > end - offset or fields.get(b"op") not in _IN_CHUNKS:
            raise CorruptRecording(path, "a chunk holds what is neither a whole message nor a connection")
        yield Part(fields, position, offset, length)
        position = offset + length


def _records_in(path: Path, data: bytes) -> Iterator[Record]:
    for part in _parts_in(path, data):
        if part.fields[b"op"] != _CONNECTION:
            yield _record_of(path, part, data)


def _record_of(path: Path, part: Part, data: bytes) -> Record:
    """The message of a record; bags hold one time for it, and no sequence number."""
    time = part.fields.get(b"time", b"")
    if len(time) != _TIME.size:
        raise CorruptRecording(path, "a message without a time")
    seconds, nanoseconds = _TIME.unpack(time)
    when = seconds * _SECOND + nanoseconds
    payload = data[part.offset : part.offset + part.length]
    return Record(_number(path, part, b"conn"), 0, when, when, payload)


def _channel_of(path: Path, part: Part, connection: dict[bytes, bytes]) -> Channel:
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


def _chunk_block(path: Path, part: Part, limits: Limits) -> Block:
    size = _number(path, part, b"size")
    if max(size, part.length) > limits.record:
        raise RecordingTooLarge(path, f"a chunk expands to {size} bytes, more than the {limits.record} allowed")
    compression = text_of(path, part.fields.get(b"compression", b""))
    return Block(part.offset, part.length, size, compression)


def _check_first(path: Path, part: Part, size: int) -> None:
    if part.begin != len(MAGIC):
        return
    if part.opcode != _Op.BAG:
        raise CorruptRecording(path, "its first record is not that of a bag")
    if part.fields.get(b"encryptor"):
        raise NotARecording(path, "it is encrypted")
    if Cursor(path, part.fields.get(b"index_pos", b"")).u64() > size:
        raise CorruptRecording(path, "it is cut off before its index")


def _number(path: Path, part: Part, name: bytes) -> int:
    value = part.fields.get(name, b"")
    if len(value) != 4:
        raise CorruptRecording(path, f"a record without its field {name.decode()}")
    return int.from_bytes(value, "little")


def _length(path: Path, data: bytes) -> int:
    if len(data) != _LENGTH.size:
        raise CorruptRecording(path, "it is cut off")
    return int.from_bytes(data, "little")
