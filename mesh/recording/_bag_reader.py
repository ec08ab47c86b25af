"""Reading ROS 1 bags, version 2.0, of unknown origin: closed or cut between two records, indexed or not.

Records are read in file order, and no length in them is trusted. Bags have no checksums. What the end of the bag says
(`read_index`) is used for damaged bags only, since it may contain anything. Source: the ROS bag format, version 2.0.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import IntEnum
from struct import Struct
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

from mesh.recording._source import (
    RUN,
    ChunkReader,
    CorruptRecording,
    Cursor,
    ExpansionCounter,
    NotARecording,
    RecordedMessage,
    RecordingBlock,
    RecordingChannel,
    RecordingSource,
    check_window,
    load_block,
    text_of,
)
from schemas.payloads import PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording._source import Limits, OnMessage


MAGIC: Final = b"#ROSBAG V2.0\n"

_LENGTH: Final = Struct("<I")
_TIME: Final = Struct("<II")
_COUNT: Final = Struct("<II")
_HEADER: Final = 64 << 10
"""Bytes of the longest record header accepted."""


class BagOp(IntEnum):
    MESSAGE = 2
    BAG = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


_CONNECTION: Final = bytes([BagOp.CONNECTION])
_IN_CHUNKS: Final = frozenset({_CONNECTION, bytes([BagOp.MESSAGE])})


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


def is_bag(path: Path) -> bool:
    """Whether a file is a ROS 1 bag by its first bytes; what is no file (`-` for standard input) never is."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(9) == MAGIC[:9]  # of any version


def bag_records(file: BinaryIO, size: int, *, begin: int = 0, cut: bool = False) -> Iterator[BagRecord]:
    """The records of a bag in file order, without their data. Raises `CorruptRecording` if the bag is cut off.

    `begin` and `size` are where a part of it begins and ends, at records. With `cut`, a chunk that goes beyond the end
    is yielded before the error, as one that ends there.
    """
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise NotARecording("it does not begin as a bag does")
    position = begin or len(MAGIC)
    while position < size:
        file.seek(position)
        length = _length(file.read(_LENGTH.size))
        if length > min(_HEADER, size - position):
            raise CorruptRecording(f"a record header of {length} bytes at byte {position}")
        fields = fields_of(file.read(length))
        offset = position + length + 2 * _LENGTH.size
        record = BagRecord(fields, position, offset, _length(file.read(_LENGTH.size)))
        if record.length > size - offset:
            if cut and record.opcode == BagOp.CHUNK:
                yield record._replace(length=size - offset)
            raise CorruptRecording(f"it is cut off: a record at byte {position} goes beyond the end")
        _check_first(record)
        yield record
        position = offset + record.length


def fields_of(header: bytes) -> dict[bytes, bytes]:
    """The fields of a record header, or of a connection: at most twelve, twice as many as the format uses.

    Raises `CorruptRecording`.
    """
    position, end, fields = 0, len(header), dict[bytes, bytes]()
    while position < end:
        begin = position + _LENGTH.size
        if begin > end:
            raise CorruptRecording("it is cut off in a field of a record")
        position = begin + _LENGTH.unpack_from(header, position)[0]
        name, equals, value = header[begin:position].partition(b"=")
        if position > end or not equals or name in fields or len(fields) == 12:
            raise CorruptRecording("a field of a record goes beyond its end, has no name, or is one too many")
        fields[name] = value
    return fields


def channel_of(record: BagRecord, connection: dict[bytes, bytes]) -> RecordingChannel:
    """The channel for a connection, which is a record and the fields of its data."""
    kind = text_of(connection.get(b"type", b""))
    definition = connection.get(b"message_definition", b"")
    topic = record.fields.get(b"topic") or connection.get(b"topic", b"")
    if not topic or not kind:
        raise CorruptRecording("a connection without topic or type")
    metadata = {
        text_of(name): text_of(value)
        for name, value in connection.items()
        if name not in (b"type", b"message_definition")
    }
    return RecordingChannel(text_of(topic), PayloadType("ros1", kind, "ros1msg", definition), metadata)


def _check_first(record: BagRecord) -> None:
    if record.begin != len(MAGIC):
        return
    if record.opcode != BagOp.BAG:
        raise CorruptRecording("its first record is not that of a bag")
    if record.fields.get(b"encryptor"):
        raise NotARecording("it is encrypted")


def index_position(record: BagRecord, size: int) -> int:
    """Where the index of a bag of `size` bytes begins, by its first record; 0 if it was not closed.

    Raises `CorruptRecording` if that is beyond the end.
    """
    position = Cursor(record.fields.get(b"index_pos", b"")).u64()
    if position > size:
        raise CorruptRecording("it is cut off before its index")
    return position


def number_of(record: BagRecord, name: bytes) -> int:
    """A field of four bytes as a number. Raises `CorruptRecording` if the record does not have it."""
    value = record.fields.get(name, b"")
    if len(value) != 4:
        raise CorruptRecording(f"a record without its field {name.decode()}")
    return int.from_bytes(value, "little")


def _length(data: bytes) -> int:
    if len(data) != _LENGTH.size:
        raise CorruptRecording("it is cut off")
    return int.from_bytes(data, "little")


@dataclass
class BagIndex:
    """The index of a bag, as far as it is readable. `messages` and `chunks` are as many as it states."""

    connections: list[BagRecord] = field(default_factory=list)
    positions: set[int] = field(default_factory=set)
    """Where its chunks are in the file, as far as they are there."""
    messages: int = 0
    chunks: int = 0
    is_closed: bool = False
    """Whether the bag was closed, so that it has an index."""


def read_index(file: BinaryIO, size: int) -> BagIndex:
    """The index of a bag of `size` bytes. Raises `NotARecording` if it does not begin as one."""
    index, begin = BagIndex(), 0
    with suppress(CorruptRecording, StopIteration):
        first = next(bag_records(file, size))
        begin = index_position(first, size)
        index.is_closed = begin > 0
        index.chunks = number_of(first, b"chunk_count") if index.is_closed else 0
    _read(file, size, begin, index)
    if begin and not index.positions:  # it is not where the bag says if data was lost
        _read(file, size, 0, index)
    return index


def _read(file: BinaryIO, size: int, begin: int, index: BagIndex) -> None:
    """Add what the records from `begin` on say. Chunks are not expanded."""
    with suppress(CorruptRecording):
        for record in bag_records(file, size, begin=begin):
            if record.opcode == BagOp.CONNECTION:
                index.connections.append(record)
            elif record.opcode == BagOp.CHUNK_INFO:
                file.seek(record.offset)
                index.messages += _messages_counted(file.read(record.length))
                position = Cursor(record.fields.get(b"chunk_pos", b"")).u64()
                if _is_chunk(file, size, position):
                    index.positions.add(position)


def _messages_counted(data: bytes) -> int:
    """How many messages a chunk has by its record in the index, of which `data` is the content."""
    if len(data) % _COUNT.size:
        raise CorruptRecording(f"an index of a chunk with {len(data)} bytes")
    return sum(count for _, count in _COUNT.iter_unpack(data))


def _is_chunk(file: BinaryIO, size: int, position: int) -> bool:
    """Whether a chunk begins there, if it is whole or not."""
    with suppress(CorruptRecording):
        return 0 < position < size and next(bag_records(file, size, begin=position, cut=True)).opcode == BagOp.CHUNK
    return False


def open_bag(
    path: Path, size: int, limits: Limits, *, on_message: OnMessage | None = None, progress: Progress | None = None
) -> RecordingSource:
    """Check the whole of a bag of `size` bytes. `on_message` is called for each message, `progress` with bytes.

    Raises `RecordingError`: `NotARecording` also for an encrypted one.
    """
    with path.open("rb") as file:
        reader = BagReader(path, file, size, limits, on_message)
        for part in _outline(file, size, limits):
            if isinstance(part, RecordingBlock):
                reader.read_block(part)
            else:
                reader.read(part)
            if progress is not None:
                progress(part.offset, size)
    check_window(reader.segments, limits)
    return reader.source()


def _outline(file: BinaryIO, size: int, limits: Limits) -> list[RecordingBlock | BagRecord]:
    """The blocks of messages and the connections of a bag in file order. Raises `RecordingError`.

    Adjacent messages outside chunks become one block.
    """
    found: list[RecordingBlock | BagRecord] = []
    expansion, defined = ExpansionCounter(limits), 0
    for number, record in enumerate(bag_records(file, size)):
        limits.check(messages=2 * number, blocks=len(found))  # each takes as long as several in a chunk
        match record.opcode:
            case BagOp.CHUNK:
                block = _chunk_block(record, limits)
                expansion.add(block)
                found.append(block)
            case BagOp.MESSAGE:
                _add_message(found, record, limits)
            case BagOp.CONNECTION:
                defined += record.offset - record.begin
                limits.check(definitions=defined)
                found.append(record)
            case BagOp.BAG:
                index_position(record, size)
            case BagOp.INDEX | BagOp.CHUNK_INFO:
                pass
            case opcode:
                raise CorruptRecording(f"a record with the unknown opcode {opcode}")
    limits.check(blocks=len(found))
    return found


def _add_message(found: list[RecordingBlock | BagRecord], record: BagRecord, limits: Limits) -> None:
    """Add a message outside any chunk, to the last block if it is adjacent."""
    whole = record.offset + record.length - record.begin
    limits.check(record=whole)
    last = found[-1] if found else record
    adjacent = isinstance(last, RecordingBlock) and not last.compression and last.offset + last.stored == record.begin
    if isinstance(last, RecordingBlock) and adjacent and last.stored + whole <= RUN:
        found[-1] = RecordingBlock(last.offset, last.stored + whole, last.size + whole)
    else:
        found.append(RecordingBlock(record.begin, whole, whole))


@dataclass
class BagReader(ChunkReader):
    format = "bag"

    _connections_seen: dict[int, tuple[dict[bytes, bytes], bytes]] = field(default_factory=dict)

    def read(self, record: BagRecord) -> None:
        """Read a record of the bag, if it holds messages or a connection."""
        match record.opcode:
            case BagOp.CHUNK:
                self.read_block(_chunk_block(record, self.limits))
            case BagOp.MESSAGE:
                whole = record.offset + record.length - record.begin
                self.read_block(RecordingBlock(record.begin, whole, whole))
            case BagOp.BAG:
                index_position(record, self.size)
            case BagOp.CONNECTION:
                self.file.seek(record.offset)
                self._connect(record, self.file.read(min(record.length, self.limits.definitions + 1)))

    def read_block(self, block: RecordingBlock) -> None:
        """Read a block of messages, which are checked and counted."""
        self._read_block(block, load_block(self.file, block))

    def read_damaged_chunk(self, record: BagRecord) -> None:
        """Read the whole messages at the beginning of a chunk that is cut or damaged."""
        compression = text_of(record.fields.get(b"compression", b""))
        block = RecordingBlock(record.offset, record.length, 0, compression)
        self._read_beginning(block, load_block(self.file, replace(block, whole=self.limits.record)))

    @staticmethod
    def records_in(data: bytes) -> Iterator[BagRecord]:
        position, end = 0, len(data)
        while position < end:
            header = position + _LENGTH.size
            if header > end:
                raise CorruptRecording("it is cut off in a chunk")
            offset = header + _LENGTH.unpack_from(data, position)[0] + _LENGTH.size
            if offset > end or offset > header + _HEADER:
                raise CorruptRecording("it is cut off in a chunk")
            fields = fields_of(data[header : offset - 4])
            length = _LENGTH.unpack_from(data, offset - 4)[0]
            if length > end - offset or fields.get(b"op") not in _IN_CHUNKS:
                raise CorruptRecording("a chunk holds something else than whole messages and connections")
            yield BagRecord(fields, position, offset, length)
            position = offset + length

    @staticmethod
    def message_of(record: BagRecord, data: bytes) -> RecordedMessage | None:
        """See `ChunkReader`. Bags have one time for a message, and no sequence number."""
        if record.fields[b"op"] == _CONNECTION:
            return None
        time = record.fields.get(b"time", b"")
        if len(time) != _TIME.size:
            raise CorruptRecording("a message without a time")
        seconds, nanoseconds = _TIME.unpack(time)
        when = seconds * 1_000_000_000 + nanoseconds
        payload = data[record.offset : record.offset + record.length]
        return RecordedMessage(number_of(record, b"conn"), 0, when, when, payload)

    def _define(self, record: BagRecord, data: bytes) -> None:
        self._connect(record, data[record.offset : record.offset + record.length])

    def _connect(self, record: BagRecord, data: bytes) -> None:
        number = number_of(record, b"conn")
        if self._connections_seen.get(number) == (record.fields, data):  # each chunk may repeat them
            return
        self._count(record.offset - record.begin + len(data), channels=number not in self.channels)
        self._connections_seen[number] = record.fields, data
        channel = channel_of(record, fields_of(data))
        if self.channels.setdefault(number, channel) != channel:
            raise CorruptRecording(f"two different connections have the number {number}")


def _chunk_block(record: BagRecord, limits: Limits) -> RecordingBlock:
    size = number_of(record, b"size")
    limits.check(record=max(size, record.length))
    compression = text_of(record.fields.get(b"compression", b""))
    return RecordingBlock(record.offset, record.length, size, compression)
