"""Opening a recording of unknown origin, to read or play it; and whether an objective can be played (`preflight`)."""

from __future__ import annotations

import base64
import os
import stat
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import Struct

from mesh.errors import InvalidKey
from mesh.recording import _bag_reader, _mcap
from mesh.recording._bag_reader import open_bag
from mesh.recording._mcap import open_mcap
from mesh.recording._source import Limits, NotARecording, RecordingError, about
from mesh.recording._sqlite_reader import SQLITE_MAGIC, ZSTD_MAGIC, open_sqlite
from mesh.recording.ros import ros_value
from schemas.decoding import decode_json_once
from schemas.errors import InvalidPayload
from schemas.keys import topic_chunks
from schemas.model import Effort, json_value
from schemas.payloads import PayloadType, String, decode_value, plain_value

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
    from typing import TypeAlias

    from mesh.content import Progress
    from mesh.recording._source import OnMessage, RecordingChannel, RecordingSource
    from schemas.model import ModelDescription

    Obstacle: TypeAlias = Callable[[str, Any], str]
    "Returns why no handler accepts a message, given its topic and value; empty if one does."


_DEFAULT: Final = Limits()
_FORMATS: Final = {_mcap.MAGIC: open_mcap, _bag_reader.MAGIC: open_bag, SQLITE_MAGIC: open_sqlite}


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
            return plain_value(self.payload, self.type)
        except InvalidPayload:
            return self.payload


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
    parsed. `progress` is called with the bytes read, of all. Raises `RecordingError`.
    """
    return Objective(open_source(Path(path), limits, progress=progress))


def open_source(
    path: Path, limits: Limits, *, on_message: OnMessage | None = None, progress: Progress | None = None
) -> RecordingSource:
    """Like `open_objective`, but returns the source, and calls `on_message` for each message while checking."""
    with about(path):
        try:
            status = os.stat(path)
            if not stat.S_ISREG(status.st_mode):  # opening it could block
                raise NotARecording("it is not a file")
            with path.open("rb") as file:
                magic = file.read(len(SQLITE_MAGIC))
        except OSError as error:
            raise NotARecording(f"it can't be read: {error.strerror}") from error
        size = status.st_size
        limits.check(size=size)
        opened = next((opened for start, opened in _FORMATS.items() if magic.startswith(start)), None)
        if opened is not None:
            source = opened(path, size, limits, on_message=on_message, progress=progress)
        elif magic.startswith(ZSTD_MAGIC):
            raise NotARecording("it is compressed as a whole; decompress it first: zstd -d")
        else:
            raise NotARecording("it is neither an MCAP file, nor a ROS 1 bag, nor a database of rosbag2")
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


LONGEST_LIST: Final = 12
"""Members of a list whose numbers are read."""


def json_messages(objective: Objective) -> Iterator[tuple[str, Any]]:
    """The topics and values of an objective, as rules of values judge them. Blocks on the disk.

    Raises `InvalidData` for JSON that names a field twice, which robots may read in another way.
    """
    for message in objective.messages():
        is_json = message.type.encoding == "json"
        yield message.topic, decode_json_once(message.payload) if is_json else json_value(message.value)


LONGEST_SHOWN: Final = 4096
"""Bytes of a message's JSON that are shown."""


def shown_value(message: Played) -> tuple[Any, bool]:
    """A message's value for JSON, at most `LONGEST_SHOWN` bytes of it, and whether it was cut. Bytes are in base 64."""
    value, is_cut = message.value, False
    if isinstance(value, bytes):
        is_cut = len(value) > LONGEST_SHOWN
        value = base64.b64encode(value[:LONGEST_SHOWN]).decode()
    elif len(encoded := msgspec.json.encode(value)) > LONGEST_SHOWN:
        value, is_cut = encoded[:LONGEST_SHOWN].decode(errors="ignore"), True
    return value, is_cut


def numbers_of(message: Played) -> Iterator[tuple[str, float]]:
    """The numbers in a message with the paths of their fields: `.linear.x`, empty for a number alone.

    A std_msgs/String may consist of numbers, too. Of a message that is not of its type there are none.
    """
    try:
        value = decode_value(message.payload, message.type)
    except InvalidPayload:
        return
    if isinstance(value, String):
        try:
            value = [float(word) for word in value.data.split(maxsplit=LONGEST_LIST)[:LONGEST_LIST]]
        except ValueError:
            return
        value = value[0] if len(value) == 1 else value
    yield from _numbers_in(value, "")


def _numbers_in(value: Any, name: str) -> Iterator[tuple[str, float]]:
    match value:
        case bool() | int() | float():
            try:
                yield name, float(value)
            except OverflowError:
                return
        case dict():
            for key, member in value.items():
                yield from _numbers_in(member, f"{name}.{key}")
        case list():
            for number, member in enumerate(value[:LONGEST_LIST]):
                yield from _numbers_in(member, f"{name}[{number}]")


@dataclass(frozen=True, kw_only=True)
class Preflight:
    """The outcome of checking an objective.

    `reason` is machine-readable: empty if the objective can be played, or one of `not-a-recording`, `too-large`,
    `expands-too-much`, `corrupt`, `no-messages`, `too-long`, `unplayable-topic`, `unknown-topic`, `unreadable-message`
    (its payload does not match its schema), `unfit-message` (no handler, or not the model, accepts it),
    `missing-topic`, `too-many-messages` (for the model). `detail` is for people. `objective` is set if the file itself
    is sound.
    """

    reason: str = ""
    detail: str = ""
    limit: str = ""
    """The field of `Limits` that the file exceeds, if that is the reason."""
    objective: Objective | None = None

    @property
    def ok(self) -> bool:
        """Whether it can be played."""
        return not self.reason


def preflight(
    path: Path,
    limits: Limits = _DEFAULT,
    *,
    topics: Collection[str] | None = None,
    obstacle: Obstacle | None = None,
    model: ModelDescription | None = None,
    progress: Progress | None = None,
) -> Preflight:
    """Check the whole file at `path`. Raises nothing for a bad file. Reads the whole file: use a thread.

    `topics` are those that the device accepts (None: any), `obstacle` finds messages that it does not accept, `model`
    describes what objectives play. `progress` is called with the bytes read, of all.
    """
    check = _MessageCheck(limits, obstacle, model)
    try:
        objective = Objective(open_source(path, limits, on_message=check.on_message, progress=progress))
    except RecordingError as error:
        return Preflight(reason=error.reason, detail=str(error), limit=error.limit)
    reason, detail = _recording_fault(objective, limits, topics)
    if not reason:
        reason, detail = check.reason, check.detail
    if not reason and model is not None:
        fault = model.objective_fault(check.counts, duration_ns=objective.duration_ns, size=objective.size)
        reason, detail = fault or ("", "")
    return Preflight(reason=reason, detail=detail, objective=objective)


def _recording_fault(objective: Objective, limits: Limits, topics: Collection[str] | None) -> tuple[str, str]:
    """What is wrong with the recording as a whole: a reason and a detail, or empty texts."""
    if not objective.count:
        return "no-messages", "it has no messages"
    if objective.duration_ns > limits.duration_ns:
        return "too-long", f"playing it takes {objective.duration_ns // 10**9} seconds"
    for topic in objective.topics:
        try:
            topic_chunks(topic.name)
        except InvalidKey as error:
            return "unplayable-topic", str(error)
        if topics is not None and topic.name not in topics:
            return "unknown-topic", f"no handler accepts {topic.name}"
    return "", ""


class _MessageCheck:
    """Finds the first message that would fail in the middle of the job."""

    def __init__(self, limits: Limits, obstacle: Obstacle | None, model: ModelDescription | None) -> None:
        self.reason = self.detail = ""
        self.counts: Counter[str] = Counter()
        """Messages by topic, until one has failed; only counted for a `model`."""
        self._model = model
        self._effort = Effort(1_000_000)
        """For values in arrays and objects, which take about a second; numbers in arrays are compared faster, and not
        counted."""
        self._most_json = limits.json
        self._obstacle = obstacle
        self._messages = 0
        self._json = 0

    def on_message(self, channel: RecordingChannel, payload: bytes) -> None:
        """Check the next message, unless one has failed already."""
        if self.reason:
            return
        if channel.type.encoding == "json":
            self._json += len(payload)
            # As objects it takes twenty times as much.
            if len(payload) > 4 << 20 or self._json > self._most_json:
                self._fail("expands-too-much", channel, f"{len(payload)} bytes of JSON, {self._json} with those before")
                return
        try:
            said = decode_value(payload, channel.type)
        except InvalidPayload as error:
            self._fail("unreadable-message", channel, str(error))
            return
        fault = None
        if self._model is not None:
            fault = self._model.message_fault(channel.topic, channel.type, said, self._effort)
            self.counts[channel.topic] += 1
        if fault is not None:
            self._fail(fault.reason, channel, fault.detail)
        elif self._obstacle is not None and (why := self._obstacle(channel.topic, said)):
            self._fail("unfit-message", channel, why)
        self._messages += 1

    def _fail(self, reason: str, channel: RecordingChannel, why: str) -> None:
        self.reason, self.detail = reason, f"message {self._messages} on {channel.topic}: {why}"
