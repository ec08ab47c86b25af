"""MCAP files: reading those of unknown origin, and writing those that every viewer opens.

Reading: everything is checked before it is used, and no length in a file is trusted. A file is read twice: first only
the headers of its records, so that a file that is too large is refused before any of it is expanded; then completely,
chunk by chunk. What the end of the file says (`read_summary`) is used for damaged files only, since it may contain
anything. The `mcap` package's reader can't be used here: it allocates what a length field asks for, and accepts a text
that is shorter than stated.

Writing, fast enough for a busy device: the package's own writer packs each field of each message separately, twice.
Here a message is one packed header and its payload, and the index of a chunk is packed once per chunk; the package
packs all other records. What no record can hold is refused before anything of it is written.

Source: the MCAP specification, versions 0 and 1.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field, replace
from io import SEEK_END
from struct import Struct
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple, TypeVar

import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from mesh.recording._source import (
    RUN,
    Attachment,
    ChunkReader,
    CorruptRecording,
    Cursor,
    ExpansionCounter,
    NotARecording,
    RecordedMessage,
    RecordingBlock,
    RecordingChannel,
    RecordingSource,
    RecordingStatistics,
    Unrecordable,
    check_window,
    load_block,
)
from schemas.payloads import JSON, PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording._source import Limits, OnMessage

MAGIC: Final = b"\x89MCAP0\r\n"

_PREFIX: Final = Struct("<BQ")
_MESSAGE: Final = Struct("<HIQQ")
_CHUNK_HEAD: Final = 40
"""Bytes of a chunk record, without the name of its compression and its data."""


class McapRecordHeader(NamedTuple):
    """The header of a record: its opcode, and the offset and length of its content."""

    opcode: int
    offset: int
    length: int


def mcap_records(
    file: BinaryIO, size: int, *, begin: int = 0, end: int | None = None, cut: bool = False
) -> Iterator[McapRecordHeader]:
    """The headers of all records of a file of `size` bytes. Raises `CorruptRecording` if the file is cut or mutated.

    `begin` and `end` are where a part of it begins and ends, at records. With `cut`, a chunk that goes beyond the end
    is yielded before the error, as one that ends there.
    """
    position, last = begin or _check_magic(file), size if end is None else end
    while position != end:
        file.seek(position)
        prefix = file.read(min(_PREFIX.size, last - position))
        if len(prefix) < _PREFIX.size:
            raise CorruptRecording("it is cut off")
        opcode, length = _PREFIX.unpack(prefix)
        position += _PREFIX.size
        if length > last - position:
            if cut and opcode == Opcode.CHUNK:
                yield McapRecordHeader(opcode, position, last - position)
            where = "the end of the file" if end is None else "the beginning of a chunk"
            raise CorruptRecording(f"a record at byte {position} goes beyond {where}")
        if not opcode:
            raise CorruptRecording(f"a record at byte {position} has no opcode")
        yield McapRecordHeader(opcode, position, length)
        position += length
        if opcode == Opcode.FOOTER and end is None:
            break
    else:
        return
    file.seek(position)
    if file.read(len(MAGIC)) != MAGIC:
        raise CorruptRecording("it does not end as an MCAP file does")
    if rest := size - position - len(MAGIC):
        raise CorruptRecording(f"it ends at byte {size - rest}, and {rest} bytes follow")


def _check_magic(file: BinaryIO) -> int:
    """Where the first record is. Raises `NotARecording`."""
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise NotARecording("it does not begin as an MCAP file does")
    return len(MAGIC)


def read_record(file: BinaryIO, header: McapRecordHeader, *, limits: Limits) -> bytes:
    """The content of a record. Raises `RecordingError` over `limits.record`."""
    limits.check(record=header.length)
    file.seek(header.offset)
    return file.read(header.length)


def chunk_header(
    file: BinaryIO, header: McapRecordHeader, limits: Limits, *, cut: bool = False
) -> tuple[RecordingBlock, int]:
    """Where the data of a chunk is, and its checksum. Raises `RecordingError` if it is over `limits.record`.

    With `cut`, the data may be cut, and what the chunk says of it wrong.
    """
    file.seek(header.offset)
    fields = Cursor(file.read(min(header.length, _CHUNK_HEAD + 32)))  # the name has a few letters
    fields.take(16)
    size, crc, compression, stored = fields.u64(), fields.u32(), fields.text(), fields.u64()
    begin = _CHUNK_HEAD + len(compression.encode())
    room = header.length - begin
    if cut:
        stored = min(stored, room)
    elif stored > room:
        raise CorruptRecording(f"a chunk of {header.length} bytes can't hold {stored} bytes of data")
    else:
        limits.check(record=max(size, stored))
    return RecordingBlock(header.offset + begin, stored, size, compression), crc


def schema_of(data: bytes) -> tuple[int, tuple[str, str, bytes]]:
    """The number of a schema record, and its name, encoding and data. The data is never parsed."""
    cursor = Cursor(data)
    return cursor.u16(), (cursor.text(), cursor.text(), cursor.data())


def channel_of(data: bytes, schemas: dict[int, tuple[str, str, bytes]]) -> tuple[int, RecordingChannel]:
    """The number of a channel record, and the channel. Raises `CorruptRecording` if its schema is not in `schemas`."""
    cursor = Cursor(data)
    number, schema, topic, encoding, metadata = cursor.u16(), cursor.u16(), cursor.text(), cursor.text(), cursor.pairs()
    if schema and schema not in schemas:
        raise CorruptRecording(f"channel {number} has an undefined schema")
    described = schemas[schema] if schema else ("", "", b"")
    return number, RecordingChannel(topic, PayloadType(encoding, *described), metadata)


def statistics_of(data: bytes) -> RecordingStatistics:
    """The content of a statistics record."""
    cursor = Cursor(data)
    messages, _schemas, channels = cursor.u64(), cursor.u16(), cursor.u32()
    attachments, metadata, chunks, start, end = cursor.u32(), cursor.u32(), cursor.u32(), cursor.u64(), cursor.u64()
    counts = Cursor(cursor.data())
    by_channel = {}
    while counts.left:
        number = counts.u16()
        by_channel[number] = counts.u64()
    return RecordingStatistics(messages, channels, attachments, chunks, start, end, by_channel, metadata)


def attachment_of(file: BinaryIO, header: McapRecordHeader) -> Attachment:
    """The attachment with that header. Its checksum is verified, its data is not kept.

    Its first 64 KiB must contain its names and times.
    """
    file.seek(header.offset)
    fields = Cursor(file.read(min(header.length, 64 << 10)))
    before = fields.left
    log_time, create_time, name, media_type = fields.u64(), fields.u64(), fields.text(), fields.text()
    size = fields.u64()
    begin = before - fields.left
    if begin + size + 4 > header.length:
        raise CorruptRecording(f"an attachment of {header.length} bytes can't hold {size} bytes of data")
    end = header.offset + begin + size
    file.seek(end)
    check_range_crc(file, start=header.offset, end=end, crc=Cursor(file.read(4)).u32())
    return Attachment(name, media_type, log_time, create_time, header.offset + begin, size)


def check_crc(data: bytes, crc: int) -> None:
    """Raise `CorruptRecording` unless the data of a chunk has this CRC-32; 0 means that its writer computed none."""
    if crc and zlib.crc32(data) != crc:
        raise CorruptRecording("the checksum of a chunk is wrong")


def check_range_crc(file: BinaryIO, *, start: int, end: int, crc: int) -> None:
    """Raise `CorruptRecording` unless the bytes from `start` to `end` have this CRC-32; 0 means that there is none."""
    if not crc:
        return
    found, left = 0, end - start
    file.seek(min(start, end))
    while left > 0:
        piece = file.read(min(left, 1 << 20))
        if not piece:
            break
        found, left = zlib.crc32(piece, found), left - len(piece)
    if found != crc:
        raise CorruptRecording("a checksum is wrong")


_FOOTER: Final = Struct("<BQQQI")
_DATA_END: Final = _PREFIX.pack(Opcode.DATA_END, 4)
_DATA_END_SIZE: Final = len(_DATA_END) + 4
_TIMES: Final = Struct("<QQ")


class _IndexedChunk(NamedTuple):
    """An entry of the chunk index: where the chunk begins, and its first and last log time as they are in the chunk."""

    begin: int
    times: bytes


@dataclass(frozen=True)
class McapSummary:
    """The summary of a file; `definitions` are opcodes and contents of its schemas and channels."""

    definitions: list[tuple[int, bytes]] = field(default_factory=list)
    statistics: RecordingStatistics | None = None
    chunks: list[_IndexedChunk] = field(default_factory=list)

    def chunk_positions(self, file: BinaryIO) -> list[int]:
        """Where the chunks of its index are in the file, as far as they are there."""
        return sorted({chunk.begin for chunk in self.chunks if _is_at(file, chunk)})


def read_summary(file: BinaryIO, size: int, limits: Limits) -> McapSummary:
    """The summary of a file of `size` bytes; empty if it has none, or none that is whole."""
    footer = size - len(MAGIC) - _FOOTER.size
    file.seek(max(footer, 0))
    end = file.read(_FOOTER.size)
    if footer < 0 or len(end) < _FOOTER.size or file.read() != MAGIC:
        return McapSummary()
    opcode, length, stated, _, crc = _FOOTER.unpack(end)
    if opcode != Opcode.FOOTER or length != _FOOTER.size - _PREFIX.size or not stated:
        return McapSummary()
    for begin in _possible_beginnings(file, stated, footer, limits):
        try:
            check_range_crc(file, start=begin, end=footer + _FOOTER.size - 4, crc=crc)
            return _read(file, size, begin, limits)
        except CorruptRecording:
            continue
    return McapSummary()


def _possible_beginnings(file: BinaryIO, stated: int, footer: int, limits: Limits) -> Iterator[int]:
    """Where the summary may begin: behind an end of the data. It is not where the footer says if data was lost."""
    tail = max(footer - limits.definitions, len(MAGIC))
    file.seek(tail)
    data = file.read(footer - tail)
    before = stated - _DATA_END_SIZE - tail
    if before >= 0 and data.startswith(_DATA_END, before):
        yield stated
    found = len(data)
    while (found := data.rfind(_DATA_END, 0, found)) >= 0:
        yield tail + found + _DATA_END_SIZE


def _read(file: BinaryIO, size: int, begin: int, limits: Limits) -> McapSummary:
    definitions, chunks, statistics = [], [], None
    for header in mcap_records(file, size, begin=begin):
        match header.opcode:
            case Opcode.SCHEMA | Opcode.CHANNEL:
                definitions.append((header.opcode, read_record(file, header, limits=limits)))
            case Opcode.STATISTICS:
                statistics = statistics_of(read_record(file, header, limits=limits))
            case Opcode.CHUNK_INDEX:
                entry = Cursor(read_record(file, header, limits=limits))
                times = entry.take(_TIMES.size)
                chunks.append(_IndexedChunk(entry.u64(), times))
    return McapSummary(definitions, statistics, chunks)


def _is_at(file: BinaryIO, chunk: _IndexedChunk) -> bool:
    """Whether a chunk with the same times is where the index says."""
    if chunk.begin >= 1 << 63:
        return False
    file.seek(chunk.begin)
    found = file.read(_PREFIX.size + _TIMES.size)
    return found[:1] == bytes([Opcode.CHUNK]) and found[_PREFIX.size :] == chunk.times


T = TypeVar("T")

_DEFINITIONS: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA})


def open_mcap(
    path: Path, size: int, limits: Limits, *, on_message: OnMessage | None = None, progress: Progress | None = None
) -> RecordingSource:
    """Check the whole of an MCAP file of `size` bytes. `on_message` is called for each message, `progress` with bytes.

    Raises `RecordingError`.
    """
    with path.open("rb") as file:
        reader = McapReader(path, file, size, limits, on_message)
        reader.statistics, checked = _check_outline(file, size, limits)
        for header in _joined_messages(mcap_records(file, size)):
            if header.opcode == Opcode.DATA_END:
                break
            reader.read(header)
            if progress is not None:
                progress(header.offset + header.length, size)
    check_window(reader.segments, limits)
    if checked:
        reader.unchecked = 0
    return reader.source()


@dataclass
class McapReader(ChunkReader):
    format = "mcap"

    _schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    _definitions_seen: dict[tuple[int, bytes], bytes] = field(default_factory=dict)
    """The bytes of the last definition of each kind and number."""

    def read(self, header: McapRecordHeader) -> None:
        """Read one record of the file. Messages are checked and counted; only their position is kept."""
        match header.opcode:
            case Opcode.CHUNK:
                block, crc = chunk_header(self.file, header, self.limits)
                data = load_block(self.file, block)
                check_crc(data, crc)
                self.unchecked += not crc
                self._read_block(block, data)
            case Opcode.MESSAGE:
                size = header.length + _PREFIX.size
                block = RecordingBlock(header.offset - _PREFIX.size, size, size)
                self.limits.check(record=size)
                self.unchecked += 1
                self._read_block(block, load_block(self.file, block))
            case opcode if opcode in _DEFINITIONS:
                self.define(opcode, read_record(self.file, header, limits=self.limits))
            case Opcode.ATTACHMENT:
                attachment = attachment_of(self.file, header)
                self.attachments.append(attachment)
                self._blocks += 1
                self._count(len(attachment.name) + len(attachment.media_type))
                self._check_counts()

    def read_damaged_chunk(self, header: McapRecordHeader) -> None:
        """Read the whole records at the beginning of a chunk that is cut or damaged.

        Raises `CorruptRecording` if all of its data is there and has another checksum: any of it may be wrong.
        """
        block, crc = chunk_header(self.file, header, self.limits, cut=True)
        data = load_block(self.file, replace(block, whole=self.limits.record))
        if len(data) == block.size:
            check_crc(data, crc)
        self.unchecked += 1
        self._read_beginning(block, data)

    @staticmethod
    def records_in(data: bytes) -> Iterator[McapRecordHeader]:
        position, end = 0, len(data)
        while position < end:
            if end - position < _PREFIX.size:
                raise CorruptRecording("a chunk ends within a record")
            opcode, length = _PREFIX.unpack_from(data, position)
            position += _PREFIX.size
            if length > end - position:
                raise CorruptRecording("a record goes beyond the end of its chunk")
            yield McapRecordHeader(opcode, position, length)
            position += length

    @staticmethod
    def message_of(record: McapRecordHeader, data: bytes) -> RecordedMessage | None:
        opcode, offset, length = record
        if opcode != Opcode.MESSAGE:
            return None
        if length < _MESSAGE.size:
            raise CorruptRecording(f"a message of {length} bytes")
        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, offset)
        payload = data[offset + _MESSAGE.size : offset + length]
        return RecordedMessage(channel, sequence, log_time, publish_time, payload)

    def _define(self, record: McapRecordHeader, data: bytes) -> None:
        if record.opcode in _DEFINITIONS:
            self.define(record.opcode, data[record.offset : record.offset + record.length])
        elif record.opcode < 0x80:  # those from there on are for private use
            raise CorruptRecording(f"a chunk holds a record with opcode {record.opcode}")

    def define(self, opcode: int, data: bytes) -> None:
        """Read the content of a schema, a channel or a metadata record."""
        if opcode == Opcode.METADATA:
            self._count(len(data))
            cursor = Cursor(data)
            self.metadata.append((cursor.text(), cursor.pairs()))
            return
        definition = opcode, data[:2]
        if self._definitions_seen.get(definition) == data:  # each chunk may repeat them
            return
        self._count(len(data))
        self._definitions_seen[definition] = data
        if opcode == Opcode.SCHEMA:
            self._define_once(self._schemas, *schema_of(data))
        else:
            self._define_once(self.channels, *channel_of(data, self._schemas))
            self._count(0)

    def _define_once(self, known: dict[int, T], number: int, item: T) -> None:
        """Add a definition. Raises `CorruptRecording` if the number is already defined differently."""
        if known.setdefault(number, item) != item:
            raise CorruptRecording(f"two different definitions have the number {number}")


def _check_outline(file: BinaryIO, size: int, limits: Limits) -> tuple[RecordingStatistics | None, bool]:
    """Check sizes and the checksums of data and summary, without expanding anything.

    Returns the file's own statistics, and whether its data as a whole has a checksum.
    """
    expansion, data_end, footer, statistics = ExpansionCounter(limits), None, None, None
    for number, header in enumerate(mcap_records(file, size)):
        if number > 2 * limits.messages:
            limits.check(messages=number)
        if header.opcode == Opcode.CHUNK:
            expansion.add(chunk_header(file, header, limits)[0])
        elif header.opcode == Opcode.DATA_END and data_end is None:
            data_end = header
        elif header.opcode == Opcode.FOOTER:
            footer = header
        elif header.opcode == Opcode.STATISTICS:
            statistics = header
    if data_end is None or footer is None:
        raise CorruptRecording("its data has no end")
    data_crc = Cursor(read_record(file, data_end, limits=limits)).u32()
    check_range_crc(file, start=0, end=data_end.offset - _PREFIX.size, crc=data_crc)
    end = Cursor(read_record(file, footer, limits=limits))
    summary, _, crc = end.u64(), end.u64(), end.u32()
    check_range_crc(file, start=summary or footer.offset - _PREFIX.size, end=footer.offset + 16, crc=crc)
    if statistics is None:
        return None, bool(data_crc)
    limits.check(definitions=statistics.length)
    return statistics_of(read_record(file, statistics, limits=limits)), bool(data_crc)


def _joined_messages(found: Iterable[McapRecordHeader]) -> Iterator[McapRecordHeader]:
    """The same records, with adjacent messages outside chunks joined to one."""
    run: McapRecordHeader | None = None
    for header in found:
        if run and header.opcode == Opcode.MESSAGE and run.length + header.length + _PREFIX.size <= RUN:
            run = run._replace(length=run.length + header.length + _PREFIX.size)
            continue
        if run:
            yield run
        run = header if header.opcode == Opcode.MESSAGE else None
        if run is None:
            yield header
    if run:
        yield run


MAX_CHANNELS: Final = 0xFFFF
ROS2: Final = "ros2"
"""The profile without which readers of rosbag2 refuse a file."""
MAX_TIME: Final = (1 << 64) - 1


_MESSAGE_RECORD: Final = Struct("<BQHIQQ")
_MESSAGE_FIELDS: Final = _MESSAGE_RECORD.size - 9
_INDEX: Final = Struct("<BQHI")
_FOOTER_HEAD: Final = Struct("<BQQQ")


@dataclass
class WriterChannel:
    """A channel of the file: its number there, and the sequence number of its next message."""

    id: int
    sequence: int = 0


class McapWriter:
    """An MCAP file that is written to `stream`, in zstd chunks of about `chunk_size` bytes. For one thread.

    With the 1 MiB of the package mcap, writing a chunk stalls for 13 ms, and a crash loses more.
    Without `finish` the file has no index and no end; closing the stream is left to the caller. With the `profile` None
    a file of ROS 2 messages only gets the profile of ROS 2 at the end. All methods that write raise `OSError`.
    """

    def __init__(self, stream: BinaryIO, *, profile: str | None = "", chunk_size: int = 128 << 10) -> None:
        self._stream = stream
        self._chunk_size = chunk_size
        self._zstd = zstandard.ZstdCompressor()
        self._known_channels: dict[object, WriterChannel] = {}
        self._known_schemas: dict[tuple[str, str, bytes], int] = {}
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunks: list[records.ChunkIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._counts: dict[int, int] = {}
        self._parts: list[bytes] = []
        self._size = 0
        """Bytes of the open chunk, which is in `_parts`."""
        self._indexes: dict[int, list[int]] = {}
        """For each channel of the open chunk: log time and offset of one message after the other."""
        self.messages = 0
        self._profile = profile
        stream.write(MAGIC + (_header_of("", room=len(ROS2)) if profile is None else _header_of(profile)))

    def add(
        self,
        topic: str,
        payload: bytes,
        type: PayloadType,
        *,
        metadata: Mapping[str, str],
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int | None = None,
    ) -> None:
        """Write one message, on the channel of its topic, type and metadata.

        Without a `sequence`, the messages of a channel are numbered from 0. Times are in nanoseconds. Raises
        `Unrecordable`, and then has written nothing.
        """
        check_message(topic, payload, log_time_ns, publish_time_ns)
        self.write(self.channel(topic, type, metadata), payload, log_time_ns, publish_time_ns, sequence)

    def write(
        self,
        channel: WriterChannel,
        payload: bytes,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int | None = None,
    ) -> None:
        """Write one message that passed `check_message`, on a channel of this file."""
        size, offset, channel_id = len(payload), self._size, channel.id
        number = (channel.sequence if sequence is None else sequence) & 0xFFFFFFFF
        head = _MESSAGE_RECORD.pack(
            Opcode.MESSAGE, _MESSAGE_FIELDS + size, channel_id, number, log_time_ns, publish_time_ns
        )
        if (index := self._indexes.get(channel_id)) is None:
            index = self._indexes[channel_id] = []
        index += (log_time_ns, offset)
        self._parts += (head, payload)
        self._size = offset = offset + _MESSAGE_RECORD.size + size
        channel.sequence += 1
        self.messages += 1
        if offset > self._chunk_size:
            self._close_chunk()

    def channel(self, topic: str, type: PayloadType, metadata: Mapping[str, str]) -> WriterChannel:
        """The channel of a topic, type and metadata, created on first use. Raises `Unrecordable`."""
        key = (topic, type, *metadata.items())
        if (known := self._known_channels.get(key)) is not None:
            return known
        if len(self._channels) >= MAX_CHANNELS:
            raise Unrecordable(f"a recording can't hold more than {MAX_CHANNELS} channels")
        for text in (type.encoding, type.schema_name, type.schema_encoding, *metadata, *metadata.values()):
            _check_text(text)
        record = records.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=type.encoding,
            schema_id=self._schema(type),
            metadata=dict(metadata),
        )
        self._append(_bytes_of(record))
        self._channels.append(record)
        channel = self._known_channels[key] = WriterChannel(record.id)
        return channel

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record. Raises `Unrecordable`."""
        for text in (name, *values, *values.values()):
            _check_text(text)
        record = _bytes_of(records.Metadata(name=name, metadata=dict(values)))
        self._metadata.append(records.MetadataIndex(offset=self._stream.tell(), length=len(record), name=name))
        self._stream.write(record)

    def add_attachment(self, attachment: Attachment, data: bytes) -> None:
        """Write an attachment: `data` under the names and times of `attachment`."""
        create_time, log_time = attachment.create_time, attachment.log_time
        name, media_type = attachment.name, attachment.media_type
        record = _bytes_of(records.Attachment(create_time, log_time, name, media_type, data))
        offset = self._stream.tell()
        self._attachments.append(
            records.AttachmentIndex(offset, len(record), log_time, create_time, len(data), name, media_type)
        )
        self._stream.write(record)

    def flush(self) -> None:
        """Close the open chunk, if it has messages, and hand everything to the operating system."""
        self._close_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write the index and the end of the file; the stream stays open."""
        self._close_chunk()
        if self._profile is None and self._channels and all(map(self._is_ros2, self._channels)):
            self._stream.seek(len(MAGIC))
            self._stream.write(_header_of(ROS2))
            self._stream.seek(0, SEEK_END)
        self._stream.write(_bytes_of(records.DataEnd(0)))
        start = self._stream.tell()
        summary, offsets = self._summary(start)
        offsets_start = start + len(summary)
        summary += _bytes_of(*offsets)
        crc = zlib.crc32(_FOOTER_HEAD.pack(Opcode.FOOTER, 8 + 8 + 4, start, offsets_start), zlib.crc32(summary))
        footer = records.Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=crc)
        self._stream.write(summary + _bytes_of(footer) + MAGIC)

    def _is_ros2(self, channel: records.Channel) -> bool:
        encoding = self._schemas[channel.schema_id - 1].encoding if channel.schema_id else ""
        return channel.message_encoding == "cdr" and encoding in ("ros2msg", "ros2idl")

    def _schema(self, type: PayloadType) -> int:
        """The number of a type's schema; 0, which means none, for bytes of no known type."""
        key = (type.schema_name, type.schema_encoding, type.schema_data)
        if type.encoding == "json" and not type.schema_data:
            key = (type.schema_name, JSON.schema_encoding, JSON.schema_data)
        elif not any(key):
            return 0
        known = self._known_schemas.get(key)
        if known is not None:
            return known
        name, encoding, data = key
        schema = records.Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._append(_bytes_of(schema))
        self._schemas.append(schema)
        self._known_schemas[key] = schema.id
        return schema.id

    def _append(self, record: bytes) -> None:
        self._parts.append(record)
        self._size += len(record)

    def _close_chunk(self) -> None:
        if not self._indexes:
            return
        data = b"".join(self._parts)
        times = [time for index in self._indexes.values() for time in (min(index[::2]), max(index[::2]))]
        packed = self._zstd.compress(data)
        chunk = records.Chunk(
            compression="zstd",
            data=packed,
            message_start_time=min(times),
            message_end_time=max(times),
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        start, record = self._stream.tell(), _bytes_of(chunk)
        indexes, offsets = self._message_indexes(start + len(record))
        self._stream.write(record + indexes)
        self._chunks.append(
            records.ChunkIndex(
                message_start_time=chunk.message_start_time,
                message_end_time=chunk.message_end_time,
                chunk_start_offset=start,
                chunk_length=len(record),
                message_index_offsets=offsets,
                message_index_length=len(indexes),
                compression="zstd",
                compressed_size=len(packed),
                uncompressed_size=len(data),
            )
        )
        self._parts, self._size, self._indexes = [], 0, {}

    def _message_indexes(self, start: int) -> tuple[bytes, dict[int, int]]:
        """The index records of the open chunk, which will be at `start`, and the offset of each channel's."""
        packed, offsets, length = [], {}, 0
        for channel, index in self._indexes.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(index) // 2
            offsets[channel] = start + length
            size = 8 * len(index)
            packed.append(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size))
            packed.append(struct.pack(f"<{len(index)}Q", *index))
            length += _INDEX.size + size
        return b"".join(packed), offsets

    def _summary(self, start: int) -> tuple[bytes, list[records.SummaryOffset]]:
        """The summary section, which will be at `start`, and the offsets of its groups."""
        groups: list[tuple[Opcode, Sequence[records.McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        summary, offsets = b"", []
        for opcode, members in groups:
            group = _bytes_of(*members)
            if group:
                offsets.append(records.SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        return summary, offsets

    def _statistics(self) -> records.Statistics:
        return records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            schema_count=len(self._schemas),
        )


def check_message(topic: str, payload: object, *times_ns: object) -> None:
    """Raise `Unrecordable` for a message that no record can hold. A time that is None is that of the recorder."""
    if not isinstance(payload, bytes):
        raise Unrecordable(f"a payload must be bytes, not {payload.__class__.__name__}")
    for moment in times_ns:
        if moment is not None and not (isinstance(moment, int) and 0 <= moment <= MAX_TIME):
            raise Unrecordable(f"{moment!r} is not a time in nanoseconds")
    _check_text(topic)
    if not topic:
        raise Unrecordable("a message needs a topic")


def _check_text(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise Unrecordable(f"{text[:40]!a} can't be encoded as UTF-8") from None


def _header_of(profile: str, *, room: int = 0) -> bytes:
    """The header record, with room for a profile of so many characters: readers skip what follows its fields."""
    header = _bytes_of(records.Header(profile, "aira-mesh")) + bytes(max(room - len(profile), 0))
    return _PREFIX.pack(Opcode.HEADER, len(header) - _PREFIX.size) + header[_PREFIX.size :]


def _bytes_of(*members: records.McapRecord) -> bytes:
    """Records as they are in a file."""
    builder = RecordBuilder()
    for record in members:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
