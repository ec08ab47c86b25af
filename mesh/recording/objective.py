"""Opening a recording of unknown origin to read or play it."""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from mesh.recording import bag_records, mcap_records
from mesh.recording.bag_source import open_bag
from mesh.recording.errors import NotARecording, RecordingTooLarge
from mesh.recording.limits import Limits
from mesh.recording.mcap_source import open_mcap
from schemas.payloads import PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording.source import Channel, Look, Source

_DEFAULT: Final = Limits()


class Topic(Struct, frozen=True):
    """A topic of a recording, and how its payloads are to be read. Its name is whatever the file says."""

    name: str
    type: PayloadType


class Played(Struct, frozen=True):
    """A message of a recording. Times are nanoseconds of the recorder's clock.

    `role` is what the metadata of its channel says: in recordings of ours, whether it was played (`objective`) or said
    by the `device` or the `agent`.
    """

    topic: str
    payload: bytes
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    type: PayloadType
    role: str = ""


class ChannelMessage(Struct, frozen=True):
    """A message as it lies in its file: on the channel of that number."""

    channel: int
    message: Played


class Objective:
    """A recording whose every byte was checked. Keeps no file open; its messages are read anew each time.

    `format` is `mcap` or `bag`, `size` that of the file in bytes, `count` the number of messages, `metadata` the
    records of that kind by their names, `attachments` the files in it (a bag has neither). `statistics` is what an
    MCAP file says about itself, if it does, and `unchecked` how many blocks of messages have no checksum.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.path: Final = source.path
        self.format: Final = source.format
        self.size: Final = source.size
        self.metadata: Final[Mapping[str, Mapping[str, str]]] = source.metadata
        self.attachments: Final = source.attachments
        self.statistics: Final = source.statistics
        self.unchecked: Final = source.unchecked
        self.count: Final = sum(segment.count for segment in source.segments)
        self.start_ns: Final = min((segment.start for segment in source.segments), default=0)
        self.duration_ns: Final = max((segment.end for segment in source.segments), default=0) - self.start_ns

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics in the order in which the file names them; twice if payloads of two types are on one."""
        found = {Topic(channel.topic, channel.type): None for channel in self._source.channels.values()}
        return tuple(found)

    def messages(self, *, from_index: int = 0) -> Iterator[Played]:
        """The messages by their log time, without the first `from_index`; those of one time in the file's order.

        Reads the file as it goes, in blocks of it: do so in a thread. Raises `CorruptRecording` if the file is not
        any more what it was.
        """
        channels = self._source.channels
        for channel, sequence, log_time, publish_time, payload in self._source.in_time_order(skip=from_index):
            yield _played(channels[channel], payload, log_time, publish_time, sequence)

    def in_file_order(self) -> Iterator[ChannelMessage]:
        """The messages as they lie in the file, whatever their times. Otherwise as `messages`."""
        channels = self._source.channels
        for channel, sequence, log_time, publish_time, payload in self._source.in_file_order():
            yield ChannelMessage(channel, _played(channels[channel], payload, log_time, publish_time, sequence))


def open_objective(path: Path, limits: Limits = _DEFAULT, *, progress: Progress | None = None) -> Objective:
    """Check the whole of the recording at `path`, an MCAP file or a ROS 1 bag by its first bytes, and open it.

    Reads the whole file: do so in a thread. Memory is bounded by the limits whatever the file says, and no schema
    text is ever looked into. `progress` is told how many bytes of the file are read, of how many. Raises
    `NotARecording`, `RecordingTooLarge`, `CorruptRecording`.
    """
    return Objective(open_source(path, limits, progress=progress))


def open_source(path: Path, limits: Limits, *, look: Look | None = None, progress: Progress | None = None) -> Source:
    """As `open_objective`, for what needs the messages in the order of the file, or to `look` at them on the way."""
    size, magic = _look(path)
    if size > limits.size:
        raise RecordingTooLarge(path, f"it has {size} bytes, more than the {limits.size} allowed", reason="too-large")
    if magic.startswith(mcap_records.MAGIC):
        source = open_mcap(path, size, limits, look=look, progress=progress)
    elif magic.startswith(bag_records.MAGIC):
        source = open_bag(path, size, limits, look=look, progress=progress)
    else:
        raise NotARecording(path, "it is neither an MCAP file nor a ROS 1 bag")
    if progress is not None:
        progress(size, size)
    return source


def _played(channel: Channel, payload: bytes, log_time: int, publish_time: int, sequence: int) -> Played:
    role = channel.metadata.get("role", "")
    return Played(channel.topic, payload, log_time, publish_time, sequence, channel.type, role)


def _look(path: Path) -> tuple[int, bytes]:
    """The size and the first bytes of a regular file; anything else might block whoever opens it."""
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise NotARecording(path, "it is not a file")
        with path.open("rb") as file:
            return status.st_size, file.read(len(bag_records.MAGIC))
    except OSError as error:
        raise NotARecording(path, f"it can't be read: {error.strerror}") from error
