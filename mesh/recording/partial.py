"""Recordings without an end: the file that is being written, and what can be read of one that a crash cut.

A recorder writes to `NAME.mcap.part`. If that exists at the start, a crash left it: it becomes `NAME.mcap.cut`, its
readable messages are copied to a new `.part`, and only once these are on the disk is the `.cut` deleted. Whenever
another crash comes, one of the two files has all messages.
"""

from __future__ import annotations

import fcntl
import os
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, BinaryIO, Final, Literal, Self, TypeAlias, get_args

from mesh.content.files import sync_directory
from mesh.private_files import make_missing_folders, open_private
from mesh.recording.errors import NotARecording, RecordingExists, Unrecordable
from mesh.recording.json_schemas import JsonSchemas
from mesh.recording.mcap_writer import McapWriter
from mesh.recording.recovery import RECOVERED, copy_content, last_time, readable_part
from schemas.payloads import EMPTY, PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from mesh.clock import Clock
    from mesh.recording.mcap_writer import WriterChannel
    from mesh.recording.source import RecordingSource

MessageRole = Literal["objective", "device", "agent"]

ABOUT: Final = "aira"
"""Name of the metadata record with the job that the recording belongs to."""
CLOSED: Final = "aira-closed"
"""Name of the metadata record that is written last."""
CLOCK_RECORD: Final = "aira-clock"
"""Name of the metadata record with the time of day at which each part of the file began.

`unix_ns` is that time by the machine's clock, `log_ns` the log time that stands for it; a value for each part.
"""
NOTE_TOPIC: Final = "/aira/note"
"""Topic of the recording on which the agent says why a job failed."""

_ROLES: Final[Mapping[MessageRole, Mapping[str, str]]] = {role: {"role": role} for role in get_args(MessageRole)}


PendingMessage: TypeAlias = "tuple[str, bytes, PayloadType, MessageRole, int, int]"
"""A message to record, already checked: topic, payload, type, role, log time and publish time in nanoseconds.

A plain tuple, since there may be hundreds of thousands a second.
"""


@dataclass(frozen=True, kw_only=True)
class RecordingAbout:
    """The job that a recording belongs to: the content of its metadata record `aira`. Any field may be empty.

    `topics` are the recorded topics, separated by commas; empty for all.
    """

    liability: str = ""
    agent: str = ""
    lighthouse: str = ""
    objective: str = ""
    software: str = ""
    topics: str = ""


class PartialFile:
    """A recording that is being written. For one thread.

    Leaving the `with` block without `finish` leaves the `.part` on the disk. Raises `RecordingExists` if the finished
    file exists or another process is writing it, and `OSError`.
    """

    def __init__(self, final: Path, clock: Clock) -> None:
        if final.exists():
            raise RecordingExists(final)
        self._final = final
        self._clock = clock
        self._part = final.with_name(f"{final.name}.part")
        self._cut = final.with_name(f"{final.name}.cut")
        make_missing_folders(final.parent)
        _set_aside(final, self._part, self._cut)
        self._stream = _locked(self._part)
        self._writer = McapWriter(self._stream, profile=None)
        self._channels: dict[str, tuple[PayloadType, MessageRole, WriterChannel]] = {}
        self._schemas = JsonSchemas()
        """The channel of the last message on each topic: the next one most likely has the same type and role."""
        self._unsynced_since: float | None = None
        self._has_name = False
        """Whether its name is on the disk."""
        self.recovered = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._stream.close()

    @property
    def messages(self) -> int:
        """How many messages it has."""
        return self._writer.messages

    def begin(self, about: RecordingAbout) -> int:
        """Write the metadata `about`, and the messages of an interrupted recording of the same name.

        Returns the log time of this moment: the time of day, unless that is before the last message. Closes the file
        if it fails.
        """
        try:
            return self._begin(about)
        except BaseException:
            self._stream.close()
            raise

    def _begin(self, about: RecordingAbout) -> int:
        self._writer.add_metadata(ABOUT, asdict(about))
        continues = self._cut.exists()
        cut = self._copy_cut() if continues else None
        self.recovered = self.messages
        unix_ns = self._clock.time_ns()
        log_ns = max(unix_ns, 0 if cut is None else last_time(cut))
        earlier = {} if cut is None else cut.metadata.get(CLOCK_RECORD, {})
        times = {"unix_ns": unix_ns, "log_ns": log_ns}
        self._writer.add_metadata(
            CLOCK_RECORD, {name: f"{earlier.get(name, '')},{time}".lstrip(",") for name, time in times.items()}
        )
        if continues:
            self.sync()
            self._cut.unlink()
            sync_directory(self._final.parent)
        return log_ns

    def add(self, messages: Iterable[PendingMessage]) -> list[tuple[PendingMessage, Unrecordable]]:
        """Write messages in their order. Returns those that no file can hold, and why. Raises `OSError`."""
        refused: list[tuple[PendingMessage, Unrecordable]] = []
        for message in messages:
            topic, payload, type, role, log_time_ns, publish_time_ns = message
            if type.encoding == "json" and role != "objective":  # what was played keeps the type that it has
                type = self._schemas.describe(topic, payload, type)
            known = self._channels.get(topic)
            if known is None or known[0] is not type or known[1] != role:
                try:
                    channel = self._writer.channel(topic, _type_to_write(type), _ROLES[role])
                except Unrecordable as error:
                    refused.append((message, error))
                    continue
                known = self._channels[topic] = (type, role, channel)
            self._writer.write(known[2], payload, log_time_ns, publish_time_ns)
        if self._unsynced_since is None:
            self._unsynced_since = self._clock.monotonic()
        return refused

    def seconds_until_due(self, every: float) -> float | None:
        """Seconds until `sync_if_due` has something to do; None if everything is on the disk."""
        if self._unsynced_since is None:
            return None
        return max(0.0, self._unsynced_since + every - self._clock.monotonic())

    def sync_if_due(self, every: float) -> None:
        """Sync messages older than `every` seconds to the disk."""
        if self.seconds_until_due(every) == 0:
            self.sync()

    def finish(self, closing: Mapping[str, str], *, sync: bool) -> tuple[int, int]:
        """End the file, `sync` it and give it its final name. Returns its numbers of messages and bytes."""
        messages = self._writer.messages
        self._writer.add_metadata(CLOSED, {"messages": str(messages), **closing})
        self._writer.finish()
        if sync:
            self.sync()
        else:
            self._writer.flush()
        self._part.rename(self._final)
        if sync:
            sync_directory(self._final.parent)
        return messages, self._stream.tell()

    def sync(self) -> None:
        """Write everything to the disk."""
        self._writer.flush()
        os.fsync(self._stream.fileno())
        if not self._has_name:
            sync_directory(self._final.parent)
            self._has_name = True
        self._unsynced_since = None

    def _copy_cut(self) -> RecordingSource | None:
        """Copy the readable part of the interrupted recording, and write the metadata about it; None if it has none.

        `seams` are the numbers of messages after which a recorder continued, one for each interruption.
        """
        try:
            source, why = readable_part(self._cut)
        except NotARecording:
            why = "none of it had reached the disk"
            self._writer.add_metadata(RECOVERED, {"messages": "0", "seams": "0", "why": why})
            return None
        copy_content(source, self._writer)
        messages, earlier = str(self.messages), source.metadata.get(RECOVERED, {}).get("seams", "")
        seams = f"{earlier},{messages}".lstrip(",")
        self._writer.add_metadata(RECOVERED, {"messages": messages, "seams": seams, "why": why})
        return source


def _set_aside(final: Path, part: Path, cut: Path) -> None:
    """Rename an interrupted `.part` to `.cut`. If a `.cut` exists, the `.part` only has copies of it: delete it."""
    if not part.exists():
        return
    with _lock_of(final, part.open("rb")):
        if cut.exists():
            part.unlink()
        else:
            part.rename(cut)


def _locked(part: Path) -> BinaryIO:
    return _lock_of(part, open(part, "xb", opener=open_private))


def _lock_of(path: Path, stream: BinaryIO) -> BinaryIO:
    """The same stream, locked until it is closed. Raises `RecordingExists` if another process has locked it."""
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.close()
        raise RecordingExists(path) from None
    return stream


@lru_cache(maxsize=4096)
def _type_to_write(type: PayloadType) -> PayloadType:
    """The same type, without a schema encoding if it has no schema: viewers would read it as an empty one."""
    if type.schema_data or type.encoding == "json" or type.schema_name == EMPTY.schema_name:
        return type
    return PayloadType(type.encoding, type.schema_name)
