"""Recordings without an end: the file that is being written, and what can be read of one that a crash cut.

A recorder writes to `NAME.mcap.part`. If that exists at the start, a crash left it: it becomes `NAME.mcap.cut`, its
readable messages are copied to a new `.part`, and only once these are on the disk is the `.cut` deleted. Whenever
another crash comes, one of the two files has all messages.
"""

from __future__ import annotations

import fcntl
import os
import time
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, BinaryIO, Final, Literal, Self, TypeAlias, get_args

from mcap.opcode import Opcode

from mesh.content.files import atomic_file, sync_directory
from mesh.recording.errors import CorruptRecording, NotARecording, RecordingExists, Unrecordable
from mesh.recording.limits import Limits
from mesh.recording.mcap_records import mcap_records
from mesh.recording.mcap_source import McapReader
from mesh.recording.mcap_writer import McapWriter
from schemas.payloads import EMPTY, PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording.mcap_writer import WriterChannel
    from mesh.recording.source import RecordingSource

MessageRole = Literal["objective", "device", "agent"]

ABOUT: Final = "aira"
"""Name of the metadata record with the job that the recording belongs to."""
CLOSED: Final = "aira-closed"
"""Name of the metadata record that is written last."""
RECOVERED: Final = "aira-recovered"
"""Name of the metadata record that marks a file, or its first part, as recovered."""
PROGRESS_EVERY: Final = 1000
"""Messages between two calls of `progress`."""

_NO_LIMIT: Final = 1 << 62
_UNLIMITED: Final = Limits(
    size=_NO_LIMIT,
    expanded=_NO_LIMIT,
    bz2=_NO_LIMIT,
    record=1 << 30,
    definitions=1 << 30,
    channels=_NO_LIMIT,
    messages=_NO_LIMIT,
    blocks=_NO_LIMIT,
)
_ROLES: Final[Mapping[MessageRole, Mapping[str, str]]] = {role: {"role": role} for role in get_args(MessageRole)}


PendingMessage: TypeAlias = "tuple[str, bytes, PayloadType, MessageRole, int, int]"
"""A message to record, already checked: topic, payload, type, role, log time and publish time in nanoseconds.

A plain tuple, since there may be hundreds of thousands a second.
"""


@dataclass(frozen=True, kw_only=True)
class RecoverySummary:
    """What was recovered: `messages` messages, in the file at `path`. `why` says why not more; empty if all were."""

    path: Path
    messages: int
    why: str


class PartialFile:
    """A recording that is being written. For one thread.

    Leaving the `with` block without `finish` leaves the `.part` on the disk. Raises `RecordingExists` if the finished
    file exists or another process is writing it, and `OSError`.
    """

    def __init__(self, final: Path) -> None:
        if final.exists():
            raise RecordingExists(final)
        self._final = final
        self._part = final.with_name(f"{final.name}.part")
        self._cut = final.with_name(f"{final.name}.cut")
        final.parent.mkdir(parents=True, exist_ok=True)
        _set_aside(final, self._part, self._cut)
        self._stream = _locked(self._part)
        self._writer = McapWriter(self._stream)
        self._channels: dict[str, tuple[PayloadType, MessageRole, WriterChannel]] = {}
        """The channel of the last message on each topic: the next one most likely has the same type and role."""
        self._unflushed_since: float | None = None
        self._unsynced_since: float | None = None
        self.recovered = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._stream.close()

    def begin(self, about: Mapping[str, str]) -> None:
        """Write the metadata `about`, and the messages of an interrupted recording of the same name."""
        self._writer.add_metadata(ABOUT, about)
        if self._cut.exists():
            self._writer.add_metadata(RECOVERED, self._copy_cut())
            self.recovered = self._writer.messages
        self._sync()
        self._cut.unlink(missing_ok=True)
        sync_directory(self._final.parent)

    def add(self, messages: Iterable[PendingMessage]) -> list[Unrecordable]:
        """Write messages in their order. Returns an error for each that no file can hold. Raises `OSError`."""
        refused: list[Unrecordable] = []
        for topic, payload, type, role, log_time_ns, publish_time_ns in messages:
            known = self._channels.get(topic)
            if known is None or known[0] is not type or known[1] != role:
                try:
                    channel = self._writer.channel(topic, _type_to_write(type), _ROLES[role])
                except Unrecordable as error:
                    refused.append(error)
                    continue
                known = self._channels[topic] = (type, role, channel)
            self._writer.write(known[2], payload, log_time_ns, publish_time_ns)
        if self._unflushed_since is None:
            self._unflushed_since = time.monotonic()
            if self._unsynced_since is None:
                self._unsynced_since = self._unflushed_since
        return refused

    def seconds_until_due(self, flush: float, sync: float) -> float | None:
        """Seconds until `flush_if_due` has something to do; None if everything is on the disk."""
        due = [
            since + every
            for since, every in ((self._unflushed_since, flush), (self._unsynced_since, sync))
            if since is not None
        ]
        return max(0.0, min(due) - time.monotonic()) if due else None

    def flush_if_due(self, flush: float, sync: float) -> None:
        """Flush messages older than `flush` seconds to the operating system, older than `sync` seconds to the disk."""
        now = time.monotonic()
        if self._unsynced_since is not None and now >= self._unsynced_since + sync:
            self._sync()
        elif self._unflushed_since is not None and now >= self._unflushed_since + flush:
            self._writer.flush()
            self._unflushed_since = None

    def finish(self, closing: Mapping[str, str]) -> tuple[int, int]:
        """End the file, sync it and give it its final name. Returns its numbers of messages and bytes."""
        messages = self._writer.messages
        self._writer.add_metadata(CLOSED, {"messages": str(messages), **closing})
        self._writer.finish()
        self._sync()
        self._part.rename(self._final)
        sync_directory(self._final.parent)
        return messages, self._stream.tell()

    def _copy_cut(self) -> dict[str, str]:
        """Copy the readable part of the interrupted recording, and return the metadata to write about it.

        `seams` are the numbers of messages after which a recorder continued, one for each interruption.
        """
        try:
            source, why = readable_part(self._cut)
        except NotARecording:
            return {"messages": "0", "seams": "0", "why": "none of it had reached the disk"}
        copy_content(source, self._writer)
        messages, earlier = str(self._writer.messages), source.metadata.get(RECOVERED, {}).get("seams", "")
        return {"messages": messages, "seams": f"{earlier},{messages}".lstrip(","), "why": why}

    def _sync(self) -> None:
        self._writer.flush()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._unflushed_since = self._unsynced_since = None


def recover(path: Path, target: Path | None = None) -> RecoverySummary:
    """Write the readable beginning of the MCAP file at `path` to a new, complete file; the old one is unchanged.

    Without `target` that is `NAME.mcap` for `NAME.mcap.part`, else `NAME.recovered.mcap`. Messages, channels, schemas,
    metadata and attachments are kept; the metadata record `aira-recovered` says what was recovered. Reading stops at
    the first record that is cut off or has a wrong checksum. Blocks on the disk.

    Raises `NotARecording` if it is not an MCAP file, `RecordingExists` if `target` exists, and `OSError`.
    """
    final = target or _name_for(path)
    if final.exists():
        raise RecordingExists(final)
    source, why = readable_part(path)
    with atomic_file(final) as stream:
        writer = McapWriter(stream)
        for name, values in source.metadata.items():
            writer.add_metadata(name, values)
        copy_content(source, writer)
        writer.add_metadata(RECOVERED, {"messages": str(writer.messages), "why": why})
        writer.finish()
    return RecoverySummary(path=final, messages=writer.messages, why=why)


def readable_part(path: Path) -> tuple[RecordingSource, str]:
    """The readable beginning of an MCAP file, and why reading stopped there; empty if nothing is missing.

    Raises `NotARecording` if it does not begin as an MCAP file, and `OSError`.
    """
    why = ""
    size = path.stat().st_size
    with path.open("rb") as file:
        reader = McapReader(path, file, _UNLIMITED)
        try:
            for header in mcap_records(path, file, size):
                if header.opcode == Opcode.DATA_END:
                    break
                reader.read(header)
        except CorruptRecording as error:
            why = error.why
    return reader.source(size), why


def copy_content(source: RecordingSource, writer: McapWriter, *, progress: Progress | None = None) -> None:
    """Write all messages of a source, in file order and on equal channels, and its attachments."""
    with source.path.open("rb") as stream:
        for attachment in source.attachments:
            stream.seek(attachment.offset)
            writer.add_attachment(attachment, stream.read(attachment.size))
    total = sum(segment.count for segment in source.segments)
    for done, (number, sequence, log_time, publish_time, payload) in enumerate(source.in_file_order(), 1):
        channel = source.channels[number]
        writer.add(
            channel.topic,
            payload,
            channel.type,
            metadata=channel.metadata,
            log_time_ns=log_time,
            publish_time_ns=publish_time,
            sequence=sequence,
        )
        if progress is not None and (done % PROGRESS_EVERY == 0 or done == total):
            progress(done, total)


def _name_for(path: Path) -> Path:
    return path.with_suffix("") if path.suffix == ".part" else path.with_suffix(".recovered.mcap")


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
    return _lock_of(part, part.open("xb"))


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
