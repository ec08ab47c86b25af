"""ROS 1 bags, version 2.0, made by code: plain, bz2 or lz4 chunks, closed with their index or left as a crash does."""

from __future__ import annotations

import bz2
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

import lz4.frame  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from collections.abc import Sequence

Compression = Literal["none", "bz2", "lz4"]

MAGIC: Final = b"#ROSBAG V2.0\n"
_BAG_HEADER: Final = 4096


@dataclass(frozen=True)
class BagMessage:
    """A message of a bag; `time_ns` is when it was recorded."""

    topic: str
    payload: bytes
    time_ns: int
    type: str = "std_msgs/String"
    md5sum: str = "992ce8a1687cec8c8bd883ec73ca41d1"
    definition: str = "string data\n"


@dataclass
class Bag:
    """A bag of these messages, `per_chunk` in each chunk; `indexed=False` is one whose writer was killed."""

    messages: Sequence[BagMessage]
    compression: Compression = "none"
    per_chunk: int = 100
    indexed: bool = True
    _chunks: list[tuple[int, dict[int, list[tuple[int, int]]]]] = field(default_factory=list)

    def encode(self) -> bytes:
        """The bytes of the file."""
        self._chunks.clear()
        body = b""
        start = len(MAGIC) + _BAG_HEADER
        for first in range(0, len(self.messages), self.per_chunk):
            body += self._chunk(self.messages[first : first + self.per_chunk], start + len(body))
        index = b"".join(self._connection(message) for message in self._connections().values())
        index += b"".join(self._chunk_info(position, entries) for position, entries in self._chunks)
        header = self._bag_header(start + len(body))
        return MAGIC + header + body + (index if self.indexed else b"")

    def _connections(self) -> dict[str, BagMessage]:
        return {message.topic: message for message in reversed(self.messages)}

    def _number(self, topic: str) -> int:
        return sorted(self._connections()).index(topic)

    def _bag_header(self, index: int) -> bytes:
        fields = {
            "op": b"\x03",
            "index_pos": struct.pack("<Q", index if self.indexed else 0),
            "conn_count": struct.pack("<I", len(self._connections())),
            "chunk_count": struct.pack("<I", len(self._chunks)),
        }
        padding = _BAG_HEADER - len(record(fields, b""))
        return record(fields, b" " * padding)

    def _connection(self, message: BagMessage) -> bytes:
        described = {
            "topic": message.topic.encode(),
            "type": message.type.encode(),
            "md5sum": message.md5sum.encode(),
            "message_definition": message.definition.encode(),
            "callerid": b"/tester",
        }
        number = struct.pack("<I", self._number(message.topic))
        return record({"op": b"\x07", "conn": number, "topic": message.topic.encode()}, fields(described))

    def _chunk(self, messages: Sequence[BagMessage], position: int) -> bytes:
        known: set[str] = set()
        entries: dict[int, list[tuple[int, int]]] = {}
        data = b""
        for message in messages:
            if message.topic not in known:
                known.add(message.topic)
                data += self._connection(message)
            number = self._number(message.topic)
            entries.setdefault(number, []).append((message.time_ns, len(data)))
            header = {"op": b"\x02", "conn": struct.pack("<I", number), "time": _time(message.time_ns)}
            data += record(header, message.payload)
        self._chunks.append((position, entries))
        header = {"op": b"\x05", "compression": self.compression.encode(), "size": struct.pack("<I", len(data))}
        return record(header, compress(data, self.compression)) + self._index(entries)

    def _index(self, entries: dict[int, list[tuple[int, int]]]) -> bytes:
        written = b""
        for number, places in entries.items():
            header = {
                "op": b"\x04",
                "ver": struct.pack("<I", 1),
                "conn": struct.pack("<I", number),
                "count": struct.pack("<I", len(places)),
            }
            written += record(header, b"".join(_time(time) + struct.pack("<I", offset) for time, offset in places))
        return written

    def _chunk_info(self, position: int, entries: dict[int, list[tuple[int, int]]]) -> bytes:
        times = [time for places in entries.values() for time, _ in places]
        header = {
            "op": b"\x06",
            "ver": struct.pack("<I", 1),
            "chunk_pos": struct.pack("<Q", position),
            "start_time": _time(min(times)),
            "end_time": _time(max(times)),
            "count": struct.pack("<I", len(entries)),
        }
        return record(header, b"".join(struct.pack("<II", n, len(places)) for n, places in entries.items()))


def string(text: str) -> bytes:
    """The payload of a std_msgs/String."""
    return struct.pack("<I", len(text.encode())) + text.encode()


def record(header: dict[str, bytes], data: bytes) -> bytes:
    """A record of a bag."""
    described = fields(header)
    return struct.pack("<I", len(described)) + described + struct.pack("<I", len(data)) + data


def fields(values: dict[str, bytes]) -> bytes:
    """Fields as record headers and connections hold them."""
    named = [name.encode() + b"=" + value for name, value in values.items()]
    return b"".join(struct.pack("<I", len(one)) + one for one in named)


def compress(data: bytes, compression: Compression) -> bytes:
    """The data of a chunk as it is stored."""
    if compression == "bz2":
        return bz2.compress(data)
    return bytes(lz4.frame.compress(data)) if compression == "lz4" else data


def _time(nanoseconds: int) -> bytes:
    return struct.pack("<II", nanoseconds // 10**9, nanoseconds % 10**9)
