"""Opening a recording of unknown origin, to read it or play it."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from mesh.recording import bag_records, mcap_records
from mesh.recording.bag_source import open_bag
from mesh.recording.errors import NotARecording, RecordingTooLarge
from mesh.recording.limits import Limits
from mesh.recording.mcap_source import open_mcap
from mesh.recording.ros_values import ros_value
from mesh.recording.sqlite_source import SQLITE_MAGIC, open_sqlite
from schemas.errors import InvalidPayload
from schemas.payloads import Empty, PayloadType, String, decode_value

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from mesh.content import Progress
    from mesh.recording.source import OnMessage, RecordingChannel, RecordingSource

_DEFAULT: Final = Limits()
_ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"


class Topic(Struct, frozen=True):
    """A topic of a recording and the type of its payloads. The name is unchecked: it is whatever the file says."""

    name: str
    type: PayloadType


class Played(Struct, frozen=True):
    """A message of a recording. Times are in nanoseconds by the recorder's clock.

    `role` comes from the metadata of its channel: in our recordings, whether it was played (`objective`) or sent by the
    `device` or the `agent`.
    """

    topic: str
    payload: bytes
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    type: PayloadType
    role: str = ""

    @property
    def value(self) -> Any:
        """A number, a text, a list, None for an empty message, JSON data, a ROS 2 message as a dict; else bytes.

        A ROS 2 message needs its definition in the recording, and the package rosbags (`aira-mesh[ros]`).
        """
        if self.type.encoding == "cdr":
            return ros_value(self.payload, self.type)
        try:
            value = decode_value(self.payload, self.type)
        except InvalidPayload:
            return self.payload
        if isinstance(value, String):
            return value.data
        return None if isinstance(value, Empty) else value


class ChannelMessage(Struct, frozen=True):
    """A message of a recording, with the number of its channel in the file."""

    channel: int
    message: Played


class Objective:
    """A recording that was checked completely. No file stays open; the messages are read again each time.

    `format` is `mcap`, `bag` or `sqlite3` (of rosbag2), `size` is in bytes, `count` the number of messages, `metadata`
    the metadata records by name, and `attachments` the files in it (only MCAP files have these). `statistics` is what
    an MCAP file states about itself, if it does, `unchecked` the number of message blocks without a checksum, and
    `repeated` the names of metadata records that it has more than once.
    """

    def __init__(self, source: RecordingSource) -> None:
        self._source = source
        self.path: Final = source.path
        self.format: Final = source.format
        self.size: Final = source.size
        self.metadata: Final[Mapping[str, Mapping[str, str]]] = source.metadata
        self.attachments: Final = source.attachments
        self.statistics: Final = source.statistics
        self.unchecked: Final = source.unchecked
        self.repeated: Final = source.repeated
        self.channels: Final = len(source.channels)
        self.count: Final = sum(segment.count for segment in source.segments)
        self.start_ns: Final = min((segment.start for segment in source.segments), default=0)
        self.duration_ns: Final = max((segment.end for segment in source.segments), default=0) - self.start_ns

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics in the order of the file; a topic with payloads of two types appears twice."""
        found = {Topic(channel.topic, channel.type): None for channel in self._source.channels.values()}
        return tuple(found)

    def messages(self, *, from_index: int = 0) -> Iterator[Played]:
        """The messages by log time, without the first `from_index`; those of equal time in file order.

        Reads the file block by block: use a thread. Raises `CorruptRecording` if the file has changed.
        """
        channels = self._source.channels
        for channel, sequence, log_time, publish_time, payload in self._source.in_time_order(skip=from_index):
            yield _played(channels[channel], payload, log_time, publish_time, sequence)

    def in_file_order(self) -> Iterator[ChannelMessage]:
        """The messages in file order, whatever their times. Otherwise like `messages`."""
        channels = self._source.channels
        for channel, sequence, log_time, publish_time, payload in self._source.in_file_order():
            yield ChannelMessage(channel, _played(channels[channel], payload, log_time, publish_time, sequence))


def open_objective(path: str | Path, limits: Limits = _DEFAULT, *, progress: Progress | None = None) -> Objective:
    """Check the whole recording at `path`, and open it: an MCAP file, a ROS 1 bag, or a database of rosbag2 (`.db3`).

    Reads the whole file: use a thread. The limits bound the memory, whatever the file states; schema texts are never
    parsed. `progress` is called with the bytes read, of all. Raises `NotARecording`, `RecordingTooLarge`,
    `CorruptRecording`.
    """
    return Objective(open_source(Path(path), limits, progress=progress))


def open_source(
    path: Path, limits: Limits, *, on_message: OnMessage | None = None, progress: Progress | None = None
) -> RecordingSource:
    """Like `open_objective`, but returns the source, and calls `on_message` for each message while checking."""
    size, magic = _size_and_magic(path)
    if size > limits.size:
        raise RecordingTooLarge(path, f"it has {size} bytes, more than the {limits.size} allowed", limit="size")
    if magic.startswith(mcap_records.MAGIC):
        source = open_mcap(path, size, limits, on_message=on_message, progress=progress)
    elif magic.startswith(bag_records.MAGIC):
        source = open_bag(path, size, limits, on_message=on_message, progress=progress)
    elif magic.startswith(SQLITE_MAGIC):
        source = open_sqlite(path, size, limits, on_message=on_message, progress=progress)
    elif magic.startswith(_ZSTD_MAGIC):
        raise NotARecording(path, "it is compressed as a whole; decompress it first: zstd -d")
    else:
        raise NotARecording(path, "it is neither an MCAP file, nor a ROS 1 bag, nor a database of rosbag2")
    if progress is not None:
        progress(size, size)
    return source


class TopicRates(Struct, frozen=True):
    """The number of messages of each topic in consecutive spans of `span_ns` nanoseconds."""

    span_ns: int
    counts: dict[str, list[int]]

    def per_second(self, topic: str) -> list[float]:
        """Messages per second in each span."""
        return [count * 1e9 / self.span_ns for count in self.counts[topic]]


def rates_of(messages: Iterable[Played], *, start_ns: int, duration_ns: int, spans: int) -> TopicRates:
    """Count the messages from `start_ns` to `duration_ns` later, in each of `spans` equal spans."""
    span = max(1, -(-(duration_ns + 1) // spans))
    counts: dict[str, list[int]] = {}
    for message in messages:
        counted = counts.get(message.topic)
        if counted is None:
            counted = counts[message.topic] = [0] * spans
        counted[(message.log_time_ns - start_ns) // span] += 1
    return TopicRates(span, counts)


def _played(channel: RecordingChannel, payload: bytes, log_time: int, publish_time: int, sequence: int) -> Played:
    role = channel.metadata.get("role", "")
    return Played(channel.topic, payload, log_time, publish_time, sequence, channel.type, role)


def _size_and_magic(path: Path) -> tuple[int, bytes]:
    """The size and the first bytes of a regular file. Opening anything else could block."""
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise NotARecording(path, "it is not a file")
        with path.open("rb") as file:
            return status.st_size, file.read(len(SQLITE_MAGIC))
    except OSError as error:
        raise NotARecording(path, f"it can't be read: {error.strerror}") from error
