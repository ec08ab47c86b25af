"""Making objectives: from JSON lines, from any messages, and from ROS 1 bags.

Fields of a JSON line:

- `topic`: the topic, `/blink`; required.
- `time`: seconds from the beginning, not negative, to the nanosecond; by default that of the line before (0 at first).
  Lines may be in any order.
- `data`: the content. Without it, or null, the message is a std_msgs/Empty; a text is a std_msgs/String, a number a
  std_msgs/Int64 or Float64, a list of numbers an array of these; anything else is JSON.
- `type`: to override that. `std_msgs/Empty` and `std_msgs/String`; `json`, or `json;NAME` to name
  the type; or any other Zenoh encoding (`application/octet-stream`, `ros1;my_msgs/Move`,
  `application/cdr;my_msgs/msg/Move`), whose payload is then `data` in base64.
"""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.content.files import atomic_file
from mesh.errors import InputError, InvalidKey
from mesh.recording.json_schemas import JsonSchemas, encode_described
from mesh.recording.limits import Limits
from mesh.recording.mcap_writer import MAX_TIME, McapWriter
from mesh.recording.objective import Played, open_source
from mesh.recording.recovery import copy_content
from schemas.agent_keys import topic_chunks
from schemas.errors import InvalidPayload
from schemas.payloads import EMPTY, JSON, STRING, Empty, PayloadType, String, encode_value, payload_type

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from mesh.content import Progress

_DEFAULT: Final = Limits()
_SECOND: Final = 10**9
_LONGEST: Final = 16 << 20
"""Bytes of the longest line."""


class InvalidLine(InputError, code="invalid-line"):
    """A line is not a valid message of an objective. `number` counts from 1."""

    def __init__(self, number: int, why: str) -> None:
        super().__init__(
            f"line {number}: {why}", hint='a line is like {"topic": "/blink", "time": 0.5, "data": "blue"}'
        )
        self.number = number
        self.why = why


class _ObjectiveLine(msgspec.Struct, forbid_unknown_fields=True):
    topic: str
    time: Decimal | None = None
    data: Any = None
    type: str = ""


_DECODER: Final = msgspec.json.Decoder(_ObjectiveLine)


def messages_in(lines: Iterable[bytes]) -> Iterator[Played]:
    """The messages of JSON lines (see the module), in the same order; empty lines are skipped. Raises `InvalidLine`."""
    time = Decimal(0)
    for number, text in enumerate(lines, 1):
        if not text.strip():
            continue
        try:
            line = _decoded(text)
            time = time if line.time is None else line.time
            topic, moment = topic_chunks(line.topic), _nanoseconds(time)
            payload, kind = _payload(line)
        except (InvalidKey, InvalidPayload, ValueError) as error:
            raise InvalidLine(number, str(error)) from None
        yield Played(topic, payload, moment, moment, 0, kind)


@dataclass(frozen=True, kw_only=True)
class PackSummary:
    """What was written: how many messages on how many topics, and the nanoseconds from the first to the last."""

    messages: int
    topics: int
    duration_ns: int


def pack(
    messages: Iterable[Played], target: str | Path, *, metadata: Mapping[str, Mapping[str, str]] | None = None
) -> PackSummary:
    """Write messages, in any order, and metadata records to an MCAP file. Equal messages give equal bytes.

    Sequence numbers are new. Replaces the file at `target` atomically, once everything is written. Blocks on the disk.
    Raises `Unrecordable`, `OSError`, and whatever `messages` raises; then `target` is unchanged.
    """
    first = last = 0
    topics: set[str] = set()
    schemas = JsonSchemas()
    with atomic_file(Path(target)) as stream:
        writer = McapWriter(stream)
        for name, values in (metadata or {}).items():
            writer.add_metadata(name, values)
        for message in messages:
            writer.add(
                message.topic,
                message.payload,
                schemas.describe(message.topic, message.payload, message.type),
                metadata={},
                log_time_ns=message.log_time_ns,
                publish_time_ns=message.publish_time_ns,
            )
            first = min(first, message.log_time_ns) if topics else message.log_time_ns
            last = max(last, message.log_time_ns)
            topics.add(message.topic)
        writer.finish()
    return PackSummary(messages=writer.messages, topics=len(topics), duration_ns=last - first)


def pack_values(
    values: Iterable[tuple[str, object]],
    target: Path,
    *,
    time_ns: int = 0,
    metadata: Mapping[str, Mapping[str, str]] | None = None,
) -> PackSummary:
    """Write values on topics to an MCAP file, in order, all at one time. Raises also as `encode_described` does."""
    encoded = ((topic_chunks(topic), encode_described(value)) for topic, value in values)
    messages = (Played(topic, payload, time_ns, time_ns, 0, kind) for topic, (payload, kind) in encoded)
    return pack(messages, target, metadata=metadata)


def bag_to_mcap(
    bag: Path, target: Path, *, cid: str = "", limits: Limits = _DEFAULT, progress: Progress | None = None
) -> Path:
    """Convert a ROS 1 bag to an MCAP file of the profile `ros1` without loss, and return `target`.

    Payloads and definitions keep their bytes, messages the order of the bag; other fields of a connection (md5sum,
    callerid, latching) become metadata of its channel. `cid`, the bag's own, goes into the metadata record `aira` as
    `source`. Replaces the file at `target` atomically. `progress` is called with the messages written, of all. Blocks
    on the disk. Raises what `open_objective` does.
    """
    source = open_source(bag, limits)
    with atomic_file(target) as stream:
        writer = McapWriter(stream, profile="ros1")
        writer.add_metadata("aira", {"source": cid, "source_format": source.format})
        copy_content(source, writer, progress=progress)
        writer.finish()
    return target


def _decoded(text: bytes) -> _ObjectiveLine:
    if len(text) > _LONGEST:
        raise ValueError(f"it has {len(text)} bytes, more than {_LONGEST}")
    try:
        return _DECODER.decode(text)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(str(error)) from None


def _nanoseconds(seconds: Decimal) -> int:
    if not seconds.is_finite() or not 0 <= seconds <= MAX_TIME // _SECOND:
        raise ValueError(f"{seconds} is not a valid time in seconds from the beginning")
    return int(seconds * _SECOND)


def _payload(line: _ObjectiveLine) -> tuple[bytes, PayloadType]:
    data = line.data
    match line.type:
        case "":
            return encode_value(Empty() if data is None else data)
        case EMPTY.schema_name:
            if data is not None:
                raise ValueError("a std_msgs/Empty has no data")
            return b"", EMPTY
        case STRING.schema_name:
            if not isinstance(data, str):
                raise ValueError("the data of a std_msgs/String must be a text")
            return String(data).encode(), STRING
    encoding, _, name = line.type.partition(";")
    if encoding == "json":
        return msgspec.json.encode(data), PayloadType("json", name, JSON.schema_encoding, JSON.schema_data)
    if not isinstance(data, str):
        raise ValueError(f"the data of a {line.type} must be its payload in base64")
    try:
        return base64.b64decode(data, validate=True), payload_type(line.type)
    except binascii.Error as error:
        raise ValueError(f"the data is not base64: {error}") from None
