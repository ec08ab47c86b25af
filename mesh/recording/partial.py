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
from typing import TYPE_CHECKING, BinaryIO, Final, Literal, Self, TypeAlias, get_args

from mesh.content.files import sync_directory
from mesh.recording.errors import NotARecording, RecordingExists, Unrecordable
from mesh.recording.mcap_file import McapFile
from mesh.recording.recovery import RECOVERED, copy_content, readable_part
from schemas.payloads import EMPTY, PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path
    from types import TracebackType

    from mesh.recording.mcap_file import FileChannel

Role = Literal["objective", "device", "agent"]

ABOUT: Final = "aira"
"""Name of the metadata record that says whose recording it is."""
CLOSED: Final = "aira-closed"
"""Name of the metadata record that is written last."""

_ROLES: Final[Mapping[Role, Mapping[str, str]]] = {role: {"role": role} for role in get_args(Role)}


Message: TypeAlias = "tuple[str, bytes, PayloadType, Role, int, int]"
"""A message to be recorded, checked: topic, payload, type, role, log time and publish time in nanoseconds.

A bare tuple, since there may be hundreds of thousands a second.
"""


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
        self._channels: dict[str, tuple[PayloadType, Role, FileChannel]] = {}
        """The channel of the last message on each topic: the next is most likely of the same type and role."""
        self._unflushed_since: float | None = None
        self._unsynced_since: float | None = None
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
            self._file.add_metadata(RECOVERED, self._copy_cut())
            self.recovered = self._file.messages
        self._sync()
        self._cut.unlink(missing_ok=True)
        sync_directory(self._final.parent)

    def add(self, messages: Iterable[Message]) -> list[Unrecordable]:
        """Write messages in their order, but for those that no file can hold: why not. Raises `OSError`."""
        refused: list[Unrecordable] = []
        for topic, payload, type, role, log_time_ns, publish_time_ns in messages:
            known = self._channels.get(topic)
            if known is None or known[0] is not type or known[1] != role:
                try:
                    channel = self._file.channel(topic, _described(type), _ROLES[role])
                except Unrecordable as error:
                    refused.append(error)
                    continue
                known = self._channels[topic] = (type, role, channel)
            self._file.write(known[2], payload, log_time_ns, publish_time_ns)
        if self._unflushed_since is None:
            self._unflushed_since = time.monotonic()
            if self._unsynced_since is None:
                self._unsynced_since = self._unflushed_since
        return refused

    def seconds_to_keep(self, flush: float, sync: float) -> float | None:
        """How long until something must be handed over or put on the disk (see `keep_what_is_due`); None if all is."""
        due = [
            since + every
            for since, every in ((self._unflushed_since, flush), (self._unsynced_since, sync))
            if since is not None
        ]
        return max(0.0, min(due) - time.monotonic()) if due else None

    def keep_what_is_due(self, flush: float, sync: float) -> None:
        """Hand over what was added `flush` seconds ago, and put on the disk what was added `sync` seconds ago."""
        now = time.monotonic()
        if self._unsynced_since is not None and now >= self._unsynced_since + sync:
            self._sync()
        elif self._unflushed_since is not None and now >= self._unflushed_since + flush:
            self._file.flush()
            self._unflushed_since = None

    def finish(self, closing: Mapping[str, str]) -> tuple[int, int]:
        """End the file, put it on the disk and give it its name; how many messages and bytes it has."""
        messages = self._file.messages
        self._file.add_metadata(CLOSED, {"messages": str(messages), **closing})
        self._file.finish()
        self._sync()
        self._part.rename(self._final)
        sync_directory(self._final.parent)
        return messages, self._stream.tell()

    def _copy_cut(self) -> dict[str, str]:
        """Copy what is readable of the interrupted recording; gives what is to be said about it.

        `seams` are the numbers of messages after which it was gone on with, each time that happened.
        """
        try:
            source, why = readable_part(self._cut)
        except NotARecording:
            return {"messages": "0", "seams": "0", "why": "nothing of it had reached the disk"}
        copy_content(source, self._file)
        messages, earlier = str(self._file.messages), source.metadata.get(RECOVERED, {}).get("seams", "")
        return {"messages": messages, "seams": f"{earlier},{messages}".lstrip(","), "why": why}

    def _sync(self) -> None:
        self._file.flush()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._unflushed_since = self._unsynced_since = None


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
