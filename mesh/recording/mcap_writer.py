"""Writing the records of an MCAP file, fast enough for all that a busy device says.

The package's own writer takes each number of each message on its own, twice. Here a message is one packed header and
its payload, and what the index says of a chunk's messages is packed once a chunk; all other records are the package's.
Source: the MCAP specification, version 1.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, BinaryIO, Final

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mcap.records import McapRecord

MAGIC: Final = b"\x89MCAP0\r\n"
LIBRARY: Final = "aira-mesh"

_MESSAGE: Final = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS: Final = _MESSAGE.size - 9
_INDEX: Final = struct.Struct("<BQHI")
_FOOTER: Final = struct.Struct("<BQQQ")


class McapWriter:
    """One MCAP file on its way to `stream`, in zstd chunks of about `chunk_size` bytes. For one thread.

    Schemas and channels are numbered from 1. Arguments that no record can hold raise before anything is written of
    it (`struct.error`, `AttributeError`, `UnicodeEncodeError`). Without `finish` the file has no index.
    """

    def __init__(self, stream: BinaryIO, *, chunk_size: int) -> None:
        self._stream = stream
        self._chunk_size = chunk_size
        self._zstd = zstandard.ZstdCompressor()
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._counts: dict[int, int] = {}
        self._parts: list[bytes] = []
        self._size = 0
        """Bytes of the chunk that is open, in these parts."""
        self._indexes: dict[int, list[int]] = {}
        """For each channel of the open chunk: log time and offset of one message after the other."""

    def start(self, profile: str) -> None:
        """Write the beginning of the file."""
        self._stream.write(MAGIC + _bytes_of(Header(profile, LIBRARY)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Write a schema and return its number."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._append(_bytes_of(schema))
        self._schemas.append(schema)
        return schema.id

    def register_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Write a channel and return its number."""
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=encoding,
            schema_id=schema,
            metadata=dict(metadata),
        )
        self._append(_bytes_of(channel))
        self._channels.append(channel)
        return channel.id

    def add_message(self, channel: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> None:
        """Write a message; times are in nanoseconds."""
        size, offset = len(data), self._size
        head = _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE_FIELDS + size, channel, sequence, log_time, publish_time)
        try:
            index = self._indexes[channel]
        except KeyError:
            index = self._indexes[channel] = []
        index += (log_time, offset)
        self._parts += (head, data)
        self._size = offset = offset + _MESSAGE.size + size
        if offset > self._chunk_size:
            self._close_chunk()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record, outside of the chunks."""
        record = _bytes_of(Metadata(name=name, metadata=dict(values)))
        self._metadata.append(MetadataIndex(offset=self._stream.tell(), length=len(record), name=name))
        self._stream.write(record)

    def add_attachment(self, create_time: int, log_time: int, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment, outside of the chunks; times are in nanoseconds."""
        record = _bytes_of(
            Attachment(create_time=create_time, log_time=log_time, name=name, media_type=media_type, data=data)
        )
        self._attachments.append(
            AttachmentIndex(
                offset=self._stream.tell(),
                length=len(record),
                create_time=create_time,
                log_time=log_time,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )
        self._stream.write(record)

    def flush(self) -> None:
        """Close the open chunk, if it has messages, and hand all to the operating system."""
        self._close_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write the index and the end of the file; the stream stays open."""
        self._close_chunk()
        self._stream.write(_bytes_of(DataEnd(0)))
        start = self._stream.tell()
        summary, offsets = self._summary(start)
        offsets_start = start + len(summary)
        summary += _bytes_of(*offsets)
        crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, 8 + 8 + 4, start, offsets_start), zlib.crc32(summary))
        footer = Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=crc)
        self._stream.write(summary + _bytes_of(footer) + MAGIC)

    def _append(self, record: bytes) -> None:
        self._parts.append(record)
        self._size += len(record)

    def _close_chunk(self) -> None:
        if not self._indexes:
            return
        data = b"".join(self._parts)
        times = [time for index in self._indexes.values() for time in (min(index[::2]), max(index[::2]))]
        packed = self._zstd.compress(data)
        chunk = Chunk(
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
            ChunkIndex(
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
        """The index records of the open chunk, which will be at `start`, and where each channel's is."""
        records, offsets, length = [], {}, 0
        for channel, index in self._indexes.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(index) // 2
            offsets[channel] = start + length
            size = 8 * len(index)
            records.append(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size))
            records.append(struct.pack(f"<{len(index)}Q", *index))
            length += _INDEX.size + size
        return b"".join(records), offsets

    def _summary(self, start: int) -> tuple[bytes, list[SummaryOffset]]:
        """All records by which a reader finds its way, which will be at `start`, and where those of each kind are."""
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        summary, offsets = b"", []
        for opcode, records in groups:
            group = _bytes_of(*records)
            if group:
                where = SummaryOffset(group_opcode=opcode, group_start=start + len(summary), group_length=len(group))
                offsets.append(where)
            summary += group
        return summary, offsets

    def _statistics(self) -> Statistics:
        return Statistics(
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


def _bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
