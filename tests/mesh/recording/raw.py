"""MCAP files record by record, with whatever no writer would write."""

from __future__ import annotations

import struct
import zlib

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk

from tests.mesh.recording.files import T0

MAGIC = b"\x89MCAP0\r\n"


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def raw_file(*records: bytes) -> bytes:
    """A file of these records, with an end but without any index or checksum."""
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
