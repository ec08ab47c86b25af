"""The file of a recording while it is being made, and how one that a crash cut is gone on with.

`NAME.mcap.part` is the file being written. If one is there at the start, it becomes `NAME.mcap.cut`, its readable
messages are copied to a new `.part`, and only once these are on the disk is the `.cut` deleted: a crash at any moment
leaves one of the two with all of them.
"""

from __future__ import annotations

import fcntl
import os
import time
from functools import lru_cache
from typing import TYPE_CHECKING, BinaryIO, Final, Literal, NamedTuple, Self, get_args

from mesh.content.files import sync_directory
from mesh.recording.errors import NotARecording, RecordingExists
from mesh.recording.mcap_file import McapFile
from mesh.recording.recovery import RECOVERED, copy_messages, readable_part
from schemas.payloads import EMPTY, PayloadType

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from types import TracebackType

Role = Literal["objective", "device", "agent"]

ABOUT: Final = "aira"
"""Name of the metadata record that says whose recording it is."""
CLOSED: Final = "aira-closed"
"""Name of the metadata record that is written last."""

_ROLES: Final[Mapping[Role, Mapping[str, str]]] = {role: {"role": role} for role in get_args(Role)}


class Message(NamedTuple):
    """A message to be recorded, its fields checked. Times are in nanoseconds."""

    topic: str
    payload: bytes
    type: PayloadType
    role: Role
    log_time_ns: int
    publish_time_ns: int


class PartialFile:
    """A recording that is being made, for one thread. Leaving `with` unfinished leaves the `.part` on the disk.

    Raises `RecordingExists` if the finished file is there or somebody else is making it, and `OSError`.
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
        self._file = McapFile(self._stream)
        self._unflushed_since: float | None = None
        self._synced = time.monotonic()
        self.recovered = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()

    def begin(self, about: Mapping[str, str]) -> None:
        """Write whose recording it is, and what an interrupted one of the same name holds."""
        self._file.add_metadata(ABOUT, about)
        if self._cut.exists():
            why = self._copy_cut()
            self.recovered = self._file.messages
            self._file.add_metadata(RECOVERED, {"messages": str(self.recovered), "why": why})
        self._sync()
        self._cut.unlink(missing_ok=True)
        sync_directory(self._final.parent)

    def add(self, message: Message) -> None:
        """Write one message. Raises `Unrecordable`, and then has written nothing; and `OSError`."""
        self._file.add(
            message.topic,
            message.payload,
            _described(message.type),
            metadata=_ROLES[message.role],
            log_time_ns=message.log_time_ns,
            publish_time_ns=message.publish_time_ns,
        )
        if self._unflushed_since is None:
            self._unflushed_since = time.monotonic()

    def seconds_to_flush(self, every: float) -> float | None:
        """How long until what was added must be handed over; None if all was."""
        if self._unflushed_since is None:
            return None
        return max(0.0, self._unflushed_since + every - time.monotonic())

    def flush_if_due(self, every: float, *, sync_every: float) -> None:
        """Hand over what was added `every` seconds ago; put all on the disk if that was last `sync_every` ago."""
        now = time.monotonic()
        if self._unflushed_since is None or now < self._unflushed_since + every:
            return
        self._file.flush()
        self._unflushed_since = None
        if now >= self._synced + sync_every:
            self._sync()

    def finish(self, closing: Mapping[str, str]) -> tuple[int, int]:
        """End the file, put it on the disk and give it its name; how many messages and bytes it has."""
        messages = self._file.messages
        self._file.add_metadata(CLOSED, {"messages": str(messages), **closing})
        self._file.finish()
        self._sync()
        self._part.rename(self._final)
        sync_directory(self._final.parent)
        return messages, self._stream.tell()

    def _copy_cut(self) -> str:
        try:
            source, why = readable_part(self._cut)
        except NotARecording:
            return "nothing of it had reached the disk"
        copy_messages(source, self._file)
        return why

    def _sync(self) -> None:
        self._file.flush()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._synced = time.monotonic()


def _set_aside(final: Path, part: Path, cut: Path) -> None:
    """Make an interrupted recording the `.cut`, unless a `.cut` is there: then the `.part` has only copies of it."""
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
    """The same stream, locked until it is closed. Raises `RecordingExists` if somebody else has it locked."""
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.close()
        raise RecordingExists(path) from None
    return stream


@lru_cache(maxsize=4096)
def _described(type: PayloadType) -> PayloadType:
    """The same type, without a schema encoding if there is no schema: a viewer would take it for an empty one."""
    if type.schema_data or type.encoding == "json" or type.schema_name == EMPTY.schema_name:
        return type
    return PayloadType(type.encoding, type.schema_name)
