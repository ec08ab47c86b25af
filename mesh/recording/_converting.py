"""Making recordings: from JSON lines, from any messages, and from recordings of another format.

MCAP, ROS 1 bags and rosbag2 are converted to each other by the package rosbags (`aira-mesh[ros]`). Between formats of
the same ROS version the payloads keep their bytes; between ROS 1 and ROS 2 they are encoded again. rosbag2 and bags
hold nothing but ROS messages of defined types: what else is in a file is named, and nothing is written, unless the
caller leaves it out.

Fields of a JSON line:

- `topic`: the topic, `/blink`; required.
- `time`: seconds from the beginning, not negative, to the nanosecond; by default that of the line before (0 at first).
  Lines may be in any order.
- `value`: the content. Without it, or null, the message is a std_msgs/Empty; a text is a std_msgs/String, a number a
  std_msgs/Int64 or Float64, a list of numbers an array of these; anything else is JSON.
- `type`: to override that. `std_msgs/Empty` and `std_msgs/String`; `json`, or `json;NAME` to name
  the type; or any other Zenoh encoding (`application/octet-stream`, `ros1;my_msgs/Move`,
  `application/cdr;my_msgs/msg/Move`), whose payload is then `value` in base64.
"""

from __future__ import annotations

import base64
import binascii
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass, replace
from decimal import Decimal
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec

from mesh.base.private_files import atomic_file
from mesh.errors import InputError, InvalidKey
from mesh.recording._json_schemas import JsonSchemas, encode_described
from mesh.recording._mcap import MAX_TIME, McapWriter
from mesh.recording._recovery import copy_attachments
from mesh.recording._source import GENEROUS, CorruptRecording, Limits, NotARecording
from mesh.recording.objective import Played, open_source
from mesh.recording.ros import RosConverter, definition_text, full_ros_name
from schemas.decoding import decode_json, without_mark
from schemas.errors import InvalidPayload
from schemas.keys import topic_chunks
from schemas.payloads import EMPTY, JSON, STRING, Empty, PayloadType, String, encode_value, payload_type

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from contextlib import AbstractContextManager
    from typing import TypeAlias

    from mesh.content import Progress
    from mesh.recording._source import RecordedMessage, RecordingChannel, RecordingSource
    from mesh.recording.ros import RosConversion
    from schemas.model import ModelDescription

    OnRecord: TypeAlias = Callable[[RecordingChannel, RosConversion, RecordedMessage], None]
    FormatWriter: TypeAlias = Callable[
        [Path, Sequence[RecordingSource], str], AbstractContextManager[tuple[Path, OnRecord]]
    ]
    Plan: TypeAlias = dict[int, RosConversion]


class _ObjectiveLine(msgspec.Struct, forbid_unknown_fields=True):
    topic: str
    time: Decimal | None = None
    value: Any = None
    type: str = ""


def messages_in(lines: Iterable[bytes]) -> Iterator[Played]:
    """The messages of JSON lines (see the module), in the same order; empty lines are skipped. Raises `InputError`."""
    time, longest, second = Decimal(0), 16 << 20, 10**9
    for number, text in enumerate(lines, 1):
        try:
            if not (text := without_mark(text).strip()):  # files that were joined have several marks
                continue
            if len(text) > longest:
                raise ValueError(f"it has {len(text)} bytes, more than {longest}")
            line = decode_json(text, _ObjectiveLine)
            time = time if line.time is None else line.time
            if not time.is_finite() or not 0 <= time <= MAX_TIME // second:
                raise ValueError(f"{time} is not a valid time in seconds from the beginning")
            topic, moment = topic_chunks(line.topic), int(time * second)
            payload, kind = _payload(line)
        except (InvalidKey, InvalidPayload, ValueError) as error:
            hint = 'a line is like {"topic": "/blink", "time": 0.5, "value": "blue"}'
            raise InputError(f"line {number}: {error}", hint=hint, code="invalid-line") from None
        yield Played(topic, payload, moment, moment, 0, kind)


def described_line(topic: str, value: Any, model: ModelDescription | None, *, time: float | Decimal | int = 0) -> bytes:
    """A value as a line for `messages_in`, of the type that the model's description says."""
    described = model.topic(topic) if model else None
    encoding = described.encoding if described else ""
    line: dict[str, Any] = {"topic": topic, "time": time, "value": value}
    if encoding in (EMPTY.zenoh_encoding, STRING.zenoh_encoding):
        line["type"] = encoding.partition(";")[2]
    elif encoding.startswith("application/json"):
        line["type"] = "json" + encoding.removeprefix("application/json")
    elif encoding:
        line["type"] = encoding
    return msgspec.json.encode(line)


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


def pack_described(values: Iterable[tuple[str, Any]], target: Path, model: ModelDescription | None) -> PackSummary:
    """Write JSON values on topics to an MCAP file, in order, all at time 0, with the types that the model's description
    says. Raises `InputError`, and as `pack` does."""
    return pack(messages_in(described_line(topic, value, model) for topic, value in values), target)


def _payload(line: _ObjectiveLine) -> tuple[bytes, PayloadType]:
    value = line.value
    match line.type:
        case "":
            return encode_value(Empty() if value is None else value)
        case EMPTY.schema_name:
            if value is not None:
                raise ValueError("a std_msgs/Empty has no value")
            return b"", EMPTY
        case STRING.schema_name:
            if not isinstance(value, str):
                raise ValueError("the value of a std_msgs/String must be a text")
            return String(value).encode(), STRING
    encoding, _, name = line.type.partition(";")
    if encoding == "json":
        return msgspec.json.encode(value), PayloadType("json", name, JSON.schema_encoding, JSON.schema_data)
    if not isinstance(value, str):
        raise ValueError(f"the value of a {line.type} must be its payload in base64")
    try:
        return base64.b64decode(value, validate=True), payload_type(line.type)
    except binascii.Error as error:
        raise ValueError(f"the value is not base64: {error}") from None


RecordingFormat = Literal["mcap", "bag", "rosbag2-mcap", "rosbag2-sqlite3"]
_SUFFIXES: Final = {"MCAP": "mcap", "SQLITE3": "db3"}
METADATA: Final = "metadata.yaml"
"""The file that makes a folder a recording of rosbag2."""


@dataclass(frozen=True, kw_only=True)
class ConversionSummary:
    """What was written: the file with the messages, their number, and what was left out (topics, metadata
    records, attachments), and why.
    """

    path: Path
    messages: int
    duration_ns: int
    left_out: dict[str, str]


def recording_files(path: Path) -> list[Path]:
    """The files of a recording: `path` itself, or those in the folder of rosbag2 at `path`, in order.

    Raises `NotARecording` for a folder of anything else.
    """
    if not path.is_dir():
        return [path]
    files = list(path.iterdir())
    if compressed := sorted(file.name for file in files if file.name.endswith((".mcap.zstd", ".db3.zstd"))):
        why = f"its files are compressed as a whole; decompress them first: zstd -d {compressed[0]}"
        raise NotARecording(why, path=path)
    found = [file for file in files if file.suffix in (".mcap", ".db3")]
    if not found or not (path / METADATA).is_file():
        raise NotARecording(f"it is a folder without {METADATA} and files of rosbag2 (.mcap, .db3)", path=path)
    return sorted(found, key=lambda file: (len(file.name), file.name))  # NAME_9.mcap, NAME_10.mcap


def recording_file(path: Path) -> Path:
    """The file of a recording that has only one: `path` itself, or that in the folder of rosbag2. Other folders stay.

    Raises `NotARecording` for a folder with several files.
    """
    if not (path / METADATA).is_file():
        return path
    first, *others = recording_files(path)
    if others:
        why = f"it has {len(others) + 1} files; join them in one: aira objective convert {path.name} {path.name}.mcap"
        raise NotARecording(why, path=path)
    return first


def convert(
    source: Path,
    target: Path,
    *,
    to: RecordingFormat,
    topics: Sequence[str] = (),
    leave_out: bool = False,
    distribution: str = "jazzy",
    cid: str = "",
    rename: Callable[[str], str] = str,
    limits: Limits = GENEROUS,
    progress: Progress | None = None,
) -> ConversionSummary:
    """Convert the recording at `source`, a file or a folder of rosbag2, to a new file or folder at `target`.

    `topics` are patterns (`/camera/*`; none: all topics). Types that the recording does not define are those of the
    ROS `distribution`. `cid`, the source's own, goes into an MCAP file's metadata. `rename` gives the name that a topic
    has in the target. Replaces no file. Blocks on the disk. Raises `InputError` (`unconvertible`, `time-out-of-range`),
    what `open_objective` does, `OSError`, and without rosbags `PackageMissing`.
    """
    sources = [open_source(path, limits) for path in recording_files(source)]
    converter = RosConverter(_VERSIONS[to], distribution)
    plans, left_out = _plans(sources, converter, topics)
    if left_out and not leave_out:
        why = "; ".join(f"{topic}: {why}" for topic, why in left_out.items())
        raise InputError(
            f"{source.name}: {len(left_out)} of its topics can't be converted: {why}",
            hint="convert the others with --leave-out, or choose topics with --topic",
            code="unconvertible",
        )
    total = sum(segment.count for each in sources for segment in each.segments)
    count, first, last = 0, 0, 0
    with _WRITERS[to](target, sources, cid) as (path, add):
        for channel, conversion, message in _messages(sources, plans, rename):
            add(channel, conversion, message)
            first, last = min(first, message.log_time) if count else message.log_time, max(last, message.log_time)
            count += 1
            if progress is not None:
                progress(count, total)
    if to != "mcap":
        for each in sources:
            for name, _ in each.metadata_records:
                left_out[f"metadata {name}"] = f"{_NO_ROOM[to]} holds no metadata records"
            for attachment in each.attachments:
                left_out[f"attachment {attachment.name}"] = f"{_NO_ROOM[to]} holds no attachments"
    return ConversionSummary(path=path, messages=count, duration_ns=last - first, left_out=left_out)


def _plans(
    sources: Sequence[RecordingSource], converter: RosConverter, topics: Sequence[str]
) -> tuple[list[Plan], dict[str, str]]:
    """For each source how its channels are converted, by number; and what can't be, by topic."""
    plans, left_out = [], {}
    conversions: dict[PayloadType, RosConversion] = {}
    for source in sources:
        plan: Plan = {}
        for number, channel in source.channels.items():
            if topics and not any(fnmatchcase(channel.topic, pattern) for pattern in topics):
                continue
            if channel.type not in conversions:
                conversions[channel.type] = converter.of(channel.type)
            conversion = conversions[channel.type]
            if conversion.why:
                left_out[channel.topic] = conversion.why
            else:
                plan[number] = conversion
        plans.append(plan)
    return plans, left_out


def _messages(
    sources: Sequence[RecordingSource], plans: Sequence[Plan], rename: Callable[[str], str]
) -> Iterator[tuple[RecordingChannel, RosConversion, RecordedMessage]]:
    """The converted messages, in file order. Raises `CorruptRecording` for one that is not of its type."""
    for source, plan in zip(sources, plans, strict=True):
        renamed = {number: replace(one, topic=rename(one.topic)) for number, one in source.channels.items()}
        for message in source.in_file_order():
            conversion = plan.get(message.channel)
            if conversion is None:
                continue
            channel = source.channels[message.channel]
            try:
                payload = conversion.convert(message.payload)
            except Exception as error:  # the converter is made from the file's definitions, and may fail in any way
                why = f"a message on {channel.topic} is no {channel.type.schema_name}: {error}"
                raise CorruptRecording(why, path=source.path) from None
            yield renamed[message.channel], conversion, message._replace(payload=payload)


@contextmanager
def _mcap_file(target: Path, sources: Sequence[RecordingSource], cid: str) -> Iterator[tuple[Path, OnRecord]]:
    is_ros1 = all(channel.type.encoding == "ros1" for each in sources for channel in each.channels.values())
    with atomic_file(target) as stream:
        writer = McapWriter(stream, profile="ros1" if is_ros1 else None)
        origin = {"source": cid, "source_format": sources[0].format}
        for name, values in [record for each in sources for record in each.metadata_records if record[0] != "aira"]:
            writer.add_metadata(name, values)
        writer.add_metadata("aira", {**sources[0].metadata.get("aira", {}), **origin})

        def add(channel: RecordingChannel, conversion: RosConversion, message: RecordedMessage) -> None:
            times = {"log_time_ns": message.log_time, "publish_time_ns": message.publish_time}
            of, metadata = conversion.type, channel.metadata
            writer.add(channel.topic, message.payload, of, metadata=metadata, sequence=message.sequence, **times)

        yield target, add
        for source in sources:
            copy_attachments(source, writer)
        writer.finish()


@contextmanager
def _bag_file(target: Path, *_: object) -> Iterator[tuple[Path, OnRecord]]:
    from rosbags.rosbag1 import Writer

    with _beside(target) as partial_file:
        with Writer(partial_file) as writer:
            yield target, _ros_writer(writer, target, first_time=1, end=(1 << 32) * 10**9)
        partial_file.rename(target)


@contextmanager
def _rosbag2_folder(storage: str, target: Path, *_: object) -> Iterator[tuple[Path, OnRecord]]:
    from rosbags.rosbag2 import StoragePlugin, Writer

    with _beside(target) as folder:
        # The metadata is that of ROS 2 Jazzy.
        with Writer(folder, version=9, storage_plugin=StoragePlugin[storage]) as writer:
            file = target / f"{target.name}.{_SUFFIXES[storage]}"
            yield file, _ros_writer(writer, target, first_time=0, end=1 << 63, is_ros2=True)
        folder.rename(target)


def _ros_writer(writer: Any, target: Path, *, first_time: int, end: int, is_ros2: bool = False) -> OnRecord:
    """Adds messages to a writer of rosbags. Its format has times from `first_time` until `end`, in nanoseconds.

    Bags have 32 bits for the seconds, and `rosbag play` refuses 0; rosbag2 has 64 bits with a sign.
    """
    connections: dict[tuple[str, PayloadType], Any] = {}

    def add(channel: RecordingChannel, conversion: RosConversion, message: RecordedMessage) -> None:
        of = conversion.type
        if (channel.topic, of) not in connections:
            digest: dict[str, Any] = {"md5sum": conversion.digest}
            if is_ros2:
                digest = {"rihs01": conversion.digest, "offered_qos_profiles": _qos(channel)}
            connections[channel.topic, of] = writer.add_connection(
                channel.topic, full_ros_name(of.schema_name), msgdef=definition_text(of), **digest
            )
        if message.log_time >= end:
            why = f"{target.name}: its format can't hold a message at {message.log_time} ns"
            raise InputError(why, hint="convert to MCAP, which holds all times", code="time-out-of-range")
        writer.write(connections[channel.topic, of], max(message.log_time, first_time), message.payload)

    return add


@contextmanager
def _beside(target: Path) -> Iterator[Path]:
    """A path of the same name in a folder beside the target, which is deleted at the end."""
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as folder:
        yield Path(folder) / target.name


def _qos(channel: RecordingChannel) -> Any:
    """The QoS that a channel's metadata state: of rosbag2, or latching of ROS 1. None that is not readable."""
    from rosbags.convert.converter import LATCH
    from rosbags.rosbag2.metadata import parse_qos

    if channel.metadata.get("latching") == "1":
        return LATCH
    text = channel.metadata.get("offered_qos_profiles", "")
    try:
        return parse_qos(text) if 0 < len(text) <= 64 << 10 else ()
    except Exception:  # of a stranger's text
        return ()


_NO_ROOM: Final = {"bag": "a ROS 1 bag", "rosbag2-mcap": "rosbag2", "rosbag2-sqlite3": "rosbag2"}
_VERSIONS: Final = {"mcap": 0, "bag": 1, "rosbag2-mcap": 2, "rosbag2-sqlite3": 2}
"""The version of ROS of each format; 0 for any."""
_WRITERS: Final[dict[str, FormatWriter]] = {
    "mcap": _mcap_file,
    "bag": _bag_file,
    "rosbag2-mcap": partial(_rosbag2_folder, "MCAP"),
    "rosbag2-sqlite3": partial(_rosbag2_folder, "SQLITE3"),
}
