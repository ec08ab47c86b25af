"""Writing MCAP files that every viewer opens, fast enough for a busy device.

The `mcap` package's own writer packs each field of each message separately, twice. Here a message is one packed header
and its payload, and the index of a chunk is packed once per chunk; the package packs all other records. What no record
can hold is refused before anything of it is written. Source: the MCAP specification, version 1.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from io import SEEK_END
from typing import TYPE_CHECKING, BinaryIO, Final

import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from mesh.recording._mcap_reader import MAGIC
from mesh.recording._source import Unrecordable
from schemas.payloads import JSON

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mesh.recording._source import Attachment
    from schemas.payloads import PayloadType

CHUNK_SIZE: Final = 128 << 10
"""Bytes of a chunk. With the package's default of 1 MiB, writing one stalls for 13 ms, and a crash loses more."""
MAX_CHANNELS: Final = 0xFFFF
ROS2: Final = "ros2"
"""The profile without which readers of rosbag2 refuse a file."""
MAX_TIME: Final = (1 << 64) - 1


_PREFIX: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS: Final = _MESSAGE.size - 9
_INDEX: Final = struct.Struct("<BQHI")
_FOOTER: Final = struct.Struct("<BQQQ")


@dataclass
class WriterChannel:
    """A channel of the file: its number there, and the sequence number of its next message."""

    id: int
    sequence: int = 0


class McapWriter:
    """An MCAP file that is written to `stream`, in zstd chunks of about `chunk_size` bytes. For one thread.

    Without `finish` the file has no index and no end; closing the stream is left to the caller. With the `profile` None
    a file of ROS 2 messages only gets the profile of ROS 2 at the end. All methods that write raise `OSError`.
    """

    def __init__(self, stream: BinaryIO, *, profile: str | None = "", chunk_size: int = CHUNK_SIZE) -> None:
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
        head = _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE_FIELDS + size, channel_id, number, log_time_ns, publish_time_ns)
        if (index := self._indexes.get(channel_id)) is None:
            index = self._indexes[channel_id] = []
        index += (log_time_ns, offset)
        self._parts += (head, payload)
        self._size = offset = offset + _MESSAGE.size + size
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
        crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, 8 + 8 + 4, start, offsets_start), zlib.crc32(summary))
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
