"""MCAP files as other programs write them, and record by record as no writer does."""

from __future__ import annotations

import io
import struct
import zlib
from typing import TYPE_CHECKING, Any

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

SECOND = 10**9
MAGIC = b"\x89MCAP0\r\n"
T0 = 1_535_622_771 * SECOND


def mcap_file(write: Callable[[Writer], None], **options: Any) -> bytes:
    """A file with the records that `write` gives to its writer."""
    stream = io.BytesIO()
    writer = Writer(stream, **options)
    writer.start("", "a test")
    write(writer)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def with_messages(
    times: Iterable[int], *, chunk_size: int = 1024, compression: CompressionType = CompressionType.ZSTD, **options: Any
) -> bytes:
    """A file with a JSON message on `/a` and one on `/b` in turn, at each of these times."""

    def write(writer: Writer) -> None:
        schema = writer.register_schema("thing", "jsonschema", b'{"type":"object"}')
        channels = [writer.register_channel(topic, "json", schema, {"color": "red"}) for topic in ("/a", "/b")]
        for number, time in enumerate(times):
            writer.add_message(channels[number % 2], time, b'{"n":%d}' % number, time + 5, number)

    return mcap_file(write, chunk_size=chunk_size, compression=compression, **options)


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def raw_file(*records: bytes) -> bytes:
    """A file of these records, with an end but no index and no checksums."""
    header = record(Opcode.HEADER, bytes(8))
    end = record(Opcode.DATA_END, bytes(4)) + record(Opcode.FOOTER, bytes(20))
    return MAGIC + header + b"".join(records) + end + MAGIC


def chunk(data: bytes, *, compression: str = "", size: int | None = None, inner: bytes | None = None) -> bytes:
    builder = RecordBuilder()
    Chunk(
        compression=compression,
        data=data,
        message_start_time=0,
        message_end_time=0,
        uncompressed_crc=0 if inner is None else zlib.crc32(inner),
        uncompressed_size=len(data) if size is None else size,
    ).write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


SCHEMA = record(Opcode.SCHEMA, struct.pack("<H", 1) + text("x") + text("") + text(""))
CHANNEL = record(Opcode.CHANNEL, struct.pack("<HH", 1, 1) + text("/a") + text("json") + text(""))


def message(data: bytes = b"", *, channel: int = 1, time: int = T0) -> bytes:
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", channel, 0, time, time) + data)
