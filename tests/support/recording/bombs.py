"""Bombs: small files that take much time or memory to open."""

from __future__ import annotations

import random
import struct
from typing import TYPE_CHECKING

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.opcode import Opcode

from mesh.recording import Limits
from tests.support.bags import MAGIC, Bag, BagMessage, compress, fields
from tests.support.bags import record as bag_record
from tests.support.recording.files import CHANNEL, SCHEMA, chunk, message, raw_file, record, text

if TYPE_CHECKING:
    from collections.abc import Callable

GIB = 1 << 30
LIMITS = Limits()
CHUNK = LIMITS.record
MANY = LIMITS.messages - 10
PLAIN = record(Opcode.CHANNEL, struct.pack("<HH", 1, 1) + text("/a") + text("") + text(""))


def zeros(size: int) -> bytes:
    return zstandard.compress(bytes(size), 19)


def one_chunk() -> bytes:
    """About 33 kB that expand to 1 GiB."""
    return raw_file(chunk(zeros(GIB), compression="zstd", size=GIB))


def many_chunks() -> bytes:
    """The same in chunks of the maximum size, each with one message of zeros."""
    chunks = []
    for number in range(GIB // CHUNK):
        data = message(bytes(CHUNK - 31), time=number)
        chunks.append(chunk(zstandard.compress(data), compression="zstd", size=CHUNK))
    return raw_file(SCHEMA, PLAIN, *chunks)


def nothing_but_zeros() -> bytes:
    """A gigabyte of empty records with opcode 0."""
    return raw_file(*[chunk(zeros(CHUNK), compression="zstd", size=CHUNK)] * (GIB // CHUNK))


def private_records() -> bytes:
    """A gigabyte of empty records with a private opcode."""
    data = struct.pack("<BQ", 0x80, 0) * (CHUNK // 9)
    return raw_file(*[chunk(zstandard.compress(data), compression="zstd", size=len(data))] * (GIB // CHUNK))


def tiny_messages() -> bytes:
    """More messages than can be counted in time."""
    data = message() * (CHUNK // 31)
    return raw_file(SCHEMA, PLAIN, *[chunk(zstandard.compress(data), compression="zstd", size=len(data))] * 10)


def tiny_records() -> bytes:
    """A file of empty uncompressed records."""
    return raw_file(record(0x80, b"") * 5_000_000)


def interwoven() -> bytes:
    """Chunks that all span the same time, so that sorting their messages needs all at once."""
    data = message(bytes(1 << 20), time=0) * 20 + message(time=1)
    return raw_file(SCHEMA, PLAIN, *[chunk(zstandard.compress(data), compression="zstd", size=len(data))] * 40)


def backwards() -> bytes:
    """A chunk of many messages in the wrong order."""
    data = b"".join(message(time=n) for n in range(300_000, 0, -1))
    return raw_file(SCHEMA, PLAIN, chunk(zstandard.compress(data), compression="zstd", size=len(data)))


def lying_lz4() -> bytes:
    """A chunk that expands to 256 MiB and states 1 KiB."""
    return raw_file(chunk(bytes(lz4.frame.compress(bytes(GIB // 4))), compression="lz4", size=1000))


def bag_of_zeros() -> bytes:
    """A bag whose chunk expands a thousandfold, to more than it states."""
    header = {"op": b"\x05", "compression": b"bz2", "size": struct.pack("<I", 1000)}
    return (
        MAGIC
        + bag_record({"op": b"\x03", "index_pos": bytes(8)}, b"")
        + bag_record(header, compress(bytes(GIB // 8), "bz2"))
    )


CONNECTION = bag_record({"op": b"\x07", "conn": bytes(4), "topic": b"/a"}, struct.pack("<I", 6) + b"type=x")


def bag_of(records: bytes) -> bytes:
    """A bag with chunks of the maximum size, full of these records."""
    data = CONNECTION + records * ((CHUNK - len(CONNECTION)) // len(records))
    header = {"op": b"\x05", "compression": b"lz4", "size": struct.pack("<I", len(data))}
    one = bag_record(header, compress(data, "lz4"))
    return MAGIC + bag_record({"op": b"\x03", "index_pos": bytes(8)}, b"") + one * 20


def bag_of_connections() -> bytes:
    """A bag that repeats one connection a million times in every chunk."""
    return bag_of(CONNECTION)


def bag_of_tiny_messages() -> bytes:
    """A bag of more messages than can be counted in time."""
    return bag_of(bag_record({"op": b"\x02", "conn": bytes(4), "time": bytes(8)}, b""))


def bag_of_fields() -> bytes:
    """A bag whose messages have as many fields as fit."""
    many = {str(number): b"" for number in range(5000)}
    return bag_of(bag_record({"op": b"\x02", "conn": bytes(4), "time": bytes(8), **many}, b""))


def bag_without_chunks() -> bytes:
    """A bag of messages outside any chunk."""
    one = bag_record({"op": b"\x02", "conn": bytes(4), "time": bytes(8)}, b"")
    return MAGIC + bag_record({"op": b"\x03", "index_pos": bytes(8)}, b"") + CONNECTION + one * 240_000


def bag_of_scattered_messages() -> bytes:
    """The same with a connection between any two of them."""
    one = bag_record({"op": b"\x02", "conn": bytes(4), "time": bytes(8)}, b"")
    return MAGIC + bag_record({"op": b"\x03", "index_pos": bytes(8)}, b"") + (CONNECTION + one) * 240_000


def bag_of_slow_chunks() -> bytes:
    """A bag with bz2 chunks, which take longest to expand."""
    data = CONNECTION + bag_record(
        {"op": b"\x02", "conn": bytes(4), "time": bytes(8)}, random.Random(1).randbytes(1 << 20)
    )
    header = {"op": b"\x05", "compression": b"bz2", "size": struct.pack("<I", len(data))}
    one = bag_record(header, compress(data, "bz2"))
    return MAGIC + bag_record({"op": b"\x03", "index_pos": bytes(8)}, b"") + one * 30


def bag_of_too_many_slow_chunks() -> bytes:
    """The same, over the limit."""
    data = bytes(CHUNK)
    header = {"op": b"\x05", "compression": b"bz2", "size": struct.pack("<I", len(data))}
    return (
        MAGIC + bag_record({"op": b"\x03", "index_pos": bytes(8)}, b"") + bag_record(header, compress(data, "bz2")) * 3
    )


def bag_of_all_that_is_taken() -> bytes:
    """A bag of as many messages as the limit allows."""
    said = b"".join(fields({name: value}) for name, value in {"type": b"std_msgs/String"}.items())
    connection = bag_record({"op": b"\x07", "conn": bytes(4), "topic": b"/a"}, said)
    data = connection + bag_record({"op": b"\x02", "conn": bytes(4), "time": bytes(8)}, b"\x01\0\0\0x") * (
        MANY // 10 - 1
    )
    header = {"op": b"\x05", "compression": b"lz4", "size": struct.pack("<I", len(data))}
    return (
        MAGIC + bag_record({"op": b"\x03", "index_pos": bytes(8)}, b"") + bag_record(header, compress(data, "lz4")) * 10
    )


def all_that_is_taken() -> bytes:
    """As many JSON messages as the limit allows."""
    data = message(b'{"a":[1.5]}') * (MANY // 10)
    chunks = [chunk(zstandard.compress(data), compression="zstd", size=len(data))] * 10
    return raw_file(SCHEMA, CHANNEL, *chunks)


def json_of_lists() -> bytes:
    """As much JSON as the limit allows, of the slowest and largest kind: empty lists."""
    data = message(b"[" + b"[]," * (LIMITS.json // 30) + b"[]]")
    return raw_file(SCHEMA, CHANNEL, *[chunk(zstandard.compress(data), compression="zstd", size=len(data))] * 9)


def json_too_long() -> bytes:
    """A JSON message that is ten times as large in memory as in the file."""
    data = message(b"[" + b"[]," * (CHUNK // 3 - 100) + b"[]]")
    return raw_file(SCHEMA, CHANNEL, chunk(zstandard.compress(data), compression="zstd", size=len(data)))


def large_channel() -> bytes:
    """A channel with millions of empty metadata entries, repeated in every chunk."""
    pairs = bytes(CHUNK - 200)
    channel = struct.pack("<HH", 1, 1) + text("/a") + text("") + struct.pack("<I", len(pairs)) + pairs
    data = record(Opcode.CHANNEL, channel)
    return raw_file(SCHEMA, *[chunk(zstandard.compress(data), compression="zstd", size=len(data))] * 30)


def metadata() -> bytes:
    """As much metadata as the limit allows, all different."""
    pairs = b"".join(text(f"{number:05x}") + bytes(4) for number in range(LIMITS.definitions // 13 - 10))
    return raw_file(
        SCHEMA, PLAIN, record(Opcode.METADATA, text("a") + struct.pack("<I", len(pairs)) + pairs), message()
    )


def long_statistics() -> bytes:
    """Repeated statistics of more channels than a file can have."""
    counts = bytes(10 * (CHUNK // 10 - 100))
    return raw_file(*[record(Opcode.STATISTICS, bytes(42) + struct.pack("<I", len(counts)) + counts)] * 7)


def attachments() -> bytes:
    """A file of empty attachments."""
    return raw_file(record(Opcode.ATTACHMENT, bytes(36)) * 900_000)


def empty_chunks() -> bytes:
    """A file of chunks with one message each, all of the same time."""
    one = chunk(message(), inner=message())
    return raw_file(SCHEMA, PLAIN, one * (LIMITS.blocks - 10))


def huge_message() -> bytes:
    """A bag with one message over the limit."""
    return Bag([BagMessage("/a", bytes(CHUNK + 1), 1)]).encode()


BOMBS: dict[Callable[[], bytes], str] = {
    one_chunk: "expands-too-much",
    many_chunks: "",
    nothing_but_zeros: "corrupt",
    private_records: "expands-too-much",
    tiny_messages: "expands-too-much",
    tiny_records: "expands-too-much",
    interwoven: "expands-too-much",
    backwards: "",
    lying_lz4: "corrupt",
    bag_of_zeros: "corrupt",
    bag_of_connections: "expands-too-much",
    bag_of_tiny_messages: "expands-too-much",
    huge_message: "expands-too-much",
    bag_of_fields: "corrupt",
    bag_without_chunks: "",
    bag_of_scattered_messages: "expands-too-much",
    bag_of_slow_chunks: "",
    bag_of_too_many_slow_chunks: "expands-too-much",
    bag_of_all_that_is_taken: "",
    all_that_is_taken: "",
    json_of_lists: "",
    json_too_long: "expands-too-much",
    large_channel: "expands-too-much",
    metadata: "",
    long_statistics: "expands-too-much",
    attachments: "expands-too-much",
    empty_chunks: "expands-too-much",
}
