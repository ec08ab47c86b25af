"""Recording messages from any thread, without ever making the caller wait.

One thread owns the file. It syncs the file to the disk every second, so that a power cut costs at most a second of the
recording, and whenever someone asks for it: many that ask at once cost one sync. Log times never go backwards: they
count by the monotonic clock from the time of day at which the recorder was opened.

A recorder writes to `NAME.mcap.part`. If that exists at the start, a crash left it: it becomes `NAME.mcap.cut`, its
readable messages are copied to a new `.part`, and only once these are on the disk is the `.cut` deleted. Whenever
another crash comes, one of the two files has all messages.
"""

from __future__ import annotations

import logging
import os
import threading
from concurrent.futures import Future
from contextvars import copy_context
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, Literal, Self, TypeAlias, get_args

from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.log_context import log_event
from mesh.base.private_files import make_missing_folders, open_private, sync_directory, try_lock
from mesh.errors import ClosedError
from mesh.recording._json_schemas import JsonSchemas
from mesh.recording._mcap import McapWriter, check_message
from mesh.recording._recovery import RECOVERED, copy_content, last_time, readable_part
from mesh.recording._source import NotARecording, RecordingFailed, Unrecordable, recording_exists
from schemas.payloads import EMPTY, PayloadType

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from mesh.base.clock import Clock
    from mesh.recording._mcap import WriterChannel
    from mesh.recording._source import RecordingSource


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

    Leaving the `with` block without `finish` leaves the `.part` on the disk. Raises `InputError` if the finished
    file exists or another process is writing it, and `OSError`.
    """

    def __init__(self, final: Path, about: RecordingAbout, clock: Clock) -> None:
        if final.exists():
            raise recording_exists(final)
        self._final = final
        self._clock = clock
        self._part = final.with_name(f"{final.name}.part")
        self._cut = final.with_name(f"{final.name}.cut")
        make_missing_folders(final.parent)
        self._set_aside()
        self._stream = _locked(self._part, open(self._part, "xb", opener=open_private))  # noqa: SIM115
        self._channels: dict[str, tuple[PayloadType, MessageRole, WriterChannel]] = {}
        """The channel of the last message on each topic: the next one most likely has the same type and role."""
        self._schemas = JsonSchemas()
        self._unsynced_since: float | None = None
        self._has_name = False
        """Whether its name is on the disk."""
        try:
            self._writer = McapWriter(self._stream, profile=None)
            self.begins_ns: Final = self._begin(about)
            """The log time of its beginning: the time of day, unless that is before the last message."""
        except BaseException:
            self._stream.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._stream.close()

    @property
    def messages(self) -> int:
        return self._writer.messages

    def _begin(self, about: RecordingAbout) -> int:
        """Write the metadata `about`, and the messages of an interrupted recording. Returns the log time of now."""
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
        self._writer.add_metadata(CLOSED, {"messages": str(self.messages), **closing})
        self._writer.finish()
        if sync:
            self.sync()
        else:
            self._writer.flush()
        self._part.rename(self._final)
        if sync:
            sync_directory(self._final.parent)
        return self.messages, self._stream.tell()

    def sync(self) -> None:
        """Write everything to the disk."""
        self._writer.flush()
        os.fsync(self._stream.fileno())
        if not self._has_name:
            sync_directory(self._final.parent)
            self._has_name = True
        self._unsynced_since = None

    def _set_aside(self) -> None:
        """Rename an interrupted `.part` to `.cut`. If a `.cut` exists, the `.part` only has copies of it: delete it."""
        if not self._part.exists():
            return
        with _locked(self._final, self._part.open("rb")):
            if self._cut.exists():
                self._part.unlink()
            else:
                self._part.rename(self._cut)

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


def _locked(path: Path, stream: BinaryIO) -> BinaryIO:
    """The same stream, locked until it is closed. Raises `InputError` if another process has locked it."""
    if not try_lock(stream):
        stream.close()
        raise recording_exists(path)
    return stream


@lru_cache(maxsize=4096)
def _type_to_write(type: PayloadType) -> PayloadType:
    """The same type, without a schema encoding if it has no schema: viewers would read it as an empty one."""
    if type.schema_data or type.encoding == "json" or type.schema_name == EMPTY.schema_name:
        return type
    return PayloadType(type.encoding, type.schema_name)


log = logging.getLogger(__name__)

_COST: Final = 256
"""Bytes of memory that a message takes in the queue besides its payload."""


@dataclass(frozen=True, kw_only=True)
class RecorderSettings:
    """After how many seconds messages are synced to the disk, and how many bytes may wait to be written."""

    sync_seconds: float = 1.0
    queue_bytes: int = 64 << 20


@dataclass(frozen=True, kw_only=True)
class RecordingSummary:
    """A finished recording. `recovered` of its `messages` are from a file that a crash left behind.

    `lost` messages were dropped because the disk was too slow or no file can hold them, `lost_played` of them with the
    role `objective`. `size` is in bytes.
    """

    path: Path
    messages: int
    lost: int
    lost_played: int
    recovered: int
    size: int


@dataclass(frozen=True, kw_only=True)
class RecorderStatistics:
    """What one or several recorders have done so far: messages written, and messages dropped.

    `lag` is how many seconds the oldest waiting message has waited to be written.
    """

    recorded: int
    lost: int
    lag: float


_SETTINGS: Final = RecorderSettings()


class Recorder:
    """Writes the recording at `path`, `NAME.mcap`, which is called `NAME.mcap.part` until `close`.

    If a crash left a `.part`, the new recording begins with its readable messages, of which there are `recovered`.
    Opening blocks on the disk until they are copied, `close` until everything is written: use threads. Raises
    `InputError` if `path` exists or another process is recording it, and `RecordingFailed` if the disk refuses it.
    """

    def __init__(
        self,
        path: str | Path,
        about: RecordingAbout,
        *,
        settings: RecorderSettings = _SETTINGS,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        path = Path(path)
        self.path: Final = path
        self._settings = settings
        self._clock = clock
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._queue: list[PendingMessage] = []
        self._queued = 0
        self._taken = 0
        self._closing = False
        self._sync_at_end = True
        self._closed = threading.Event()
        self._lost = self._lost_played = 0
        self._recorded = 0
        self._since = self._taken_since = 0.0
        self._syncing: list[Future[int]] = []
        self._failure: Exception | None = None
        self._summary: RecordingSummary | None = None
        try:
            self._file = PartialFile(path, about, clock)
        except OSError as error:
            raise RecordingFailed(path, error.strerror or str(error)) from error
        self._epoch = self._file.begins_ns - clock.monotonic_ns()
        self.recovered: Final = self._file.recovered
        self._thread = threading.Thread(
            target=copy_context().run, args=(self._run,), name=f"aira-recorder-{path.stem[-8:]}", daemon=True
        )
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    @property
    def lost(self) -> int:
        """Messages dropped so far, because too many were waiting or the disk refused them."""
        return self._lost

    @property
    def is_behind(self) -> bool:
        """Whether so much is waiting to be written that a caller who can wait should: for `sync`."""
        return 2 * self._queued > self._settings.queue_bytes

    @property
    def is_done(self) -> bool:
        """Whether the file is finished or failed: the statistics no longer change."""
        return self._summary is not None or self._failure is not None

    def statistics(self) -> RecorderStatistics:
        """What it has done so far. For any thread."""
        with self._lock:
            now = self._clock.monotonic()
            since = self._taken_since if self._taken else self._since if self._queue else now
            return RecorderStatistics(recorded=self._recorded, lost=self._lost, lag=now - since)

    def record(
        self,
        topic: str,
        payload: bytes,
        type: PayloadType,
        *,
        role: MessageRole = "device",
        log_time_ns: int | None = None,
        publish_time_ns: int | None = None,
    ) -> None:
        """Add a message without waiting for anything. For any thread. Times are in nanoseconds, by default now.

        `role` distinguishes what was played from what the device sent. If more than `queue_bytes` are waiting, the
        message is dropped and counted, unless it was played: who plays must wait while the recorder `is_behind`. Raises
        `Unrecordable` for a message that no file can hold, `ClosedError`, and `RecordingFailed` once the disk has
        refused the recording.
        """
        check_message(topic, payload, log_time_ns, publish_time_ns)
        cost = len(payload) + _COST
        with self._lock:
            log_time = self._epoch + self._clock.monotonic_ns() if log_time_ns is None else log_time_ns
            publish_time = log_time if publish_time_ns is None else publish_time_ns
            if self._closing:
                raise ClosedError(f"the recording {self.path} is closed")
            if self._failure is not None:
                self._lost += 1
                raise RecordingFailed(self.path, str(self._failure))
            if self._queued + cost > self._settings.queue_bytes and role != "objective":
                self._lost += 1
                return
            first = not self._queue
            if first:
                self._since = self._clock.monotonic()
            self._queue.append((topic, payload, type, role, log_time, publish_time))
            self._queued += cost
        if first:
            self._wake.set()

    def sync(self) -> Future[int]:
        """Done when everything that was recorded before is on the disk: how many messages the file has there.

        Returns without waiting. Fails with `RecordingFailed` if the disk refused the recording.
        """
        done: Future[int] = Future()
        with self._lock:
            self._syncing.append(done)
            ended = self.is_done
        if ended:
            self._synced(len(self._syncing))
        self._wake.set()
        return done

    def close(self, *, sync: bool = True) -> RecordingSummary:
        """Write the waiting messages, end and `sync` the file, and give it its final name. Safe to call twice.

        Without the sync, a power loss may leave what was synced before. Raises `RecordingFailed` if the disk refused
        any of it; the `.part` stays for `recover`.
        """
        with self._lock:
            self._closing, self._sync_at_end = True, sync
        self._closed.set()
        self._wake.set()
        self._thread.join()
        if self._failure is not None:
            raise RecordingFailed(self.path, str(self._failure)) from self._failure
        assert self._summary is not None
        return self._summary

    def _run(self) -> None:
        try:
            with self._file as file:
                self._write(file)
                lost = self._lost
                messages, size = file.finish({"lost": str(lost)}, sync=self._sync_at_end)
            counts = {"lost": lost, "lost_played": self._lost_played, "recovered": self.recovered}
            with self._lock:
                self._summary = RecordingSummary(path=self.path, messages=messages, size=size, **counts)
        except Exception as error:
            with self._lock:
                self._failure = error
                self._lost += len(self._queue) + self._taken
                self._queue.clear()
        self._synced(len(self._syncing))

    def _write(self, file: PartialFile) -> None:
        """Write messages until `close` was called and none is waiting."""
        every, at_once = self._settings.sync_seconds, 512
        while True:
            if self._wake.wait(file.seconds_until_due(every)):
                self._closed.wait(0.005)  # messages gather: waking the thread for each of them costs more
            self._wake.clear()
            closing = self._closing
            while True:
                batch, syncing = self._take()
                for start in range(0, len(batch), at_once):
                    self._add(file, batch[start : start + at_once])
                    file.sync_if_due(every)
                if syncing:
                    file.sync()
                    self._synced(syncing)
                elif not batch:
                    break
            file.sync_if_due(every)
            if closing:
                return

    def _add(self, file: PartialFile, messages: list[PendingMessage]) -> None:
        refused = file.add(messages)
        with self._lock:
            self._queued -= sum([len(message[1]) for message in messages]) + _COST * len(messages)
            self._lost += len(refused)
            self._lost_played += sum(message[3] == "objective" for message, _ in refused)
            self._recorded += len(messages) - len(refused)
            self._taken -= len(messages)
        for _, error in refused:
            event = log_event("recording-message-refused", path=self.path, error=error)
            log.warning("%s lacks a message: %s", self.path.name, error, extra=event)

    def _take(self) -> tuple[list[PendingMessage], int]:
        """All waiting messages, which count as waiting until they are written, and how many callers wait for a sync."""
        with self._lock:
            batch, self._queue = self._queue, []
            self._taken, self._taken_since = len(batch), self._since
            return batch, len(self._syncing)

    def _synced(self, count: int) -> None:
        """Tell the first `count` of those who wait for a sync."""
        with self._lock:
            done, self._syncing = self._syncing[:count], self._syncing[count:]
            failure, messages = self._failure, self._file.messages
        for waiting in done:
            if not waiting.set_running_or_notify_cancel():
                continue
            if failure is None:
                waiting.set_result(messages)
            else:
                waiting.set_exception(RecordingFailed(self.path, str(failure)))


class Recorders:
    """Opens recorders, and adds up their statistics, including those of closed ones. For any thread."""

    def __init__(self, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._open: list[Recorder] = []
        self._recorded = 0
        self._lost = 0

    def open(self, path: Path, about: RecordingAbout) -> Recorder:
        """Open a `Recorder`; the caller closes it. Raises as that does."""
        recorder = Recorder(path, about, clock=self._clock)
        with self._lock:
            self._drop_finished()
            self._open.append(recorder)
        return recorder

    def statistics(self) -> RecorderStatistics:
        """What all have done together; `lag` is that of the slowest."""
        with self._lock:
            self._drop_finished()
            now = [recorder.statistics() for recorder in self._open]
            return RecorderStatistics(
                recorded=self._recorded + sum(one.recorded for one in now),
                lost=self._lost + sum(one.lost for one in now),
                lag=max((one.lag for one in now), default=0.0),
            )

    def _drop_finished(self) -> None:
        """Add the statistics of finished recorders to the totals, and drop them."""
        for recorder in [recorder for recorder in self._open if recorder.is_done]:
            done = recorder.statistics()
            self._recorded += done.recorded
            self._lost += done.lost
            self._open.remove(recorder)
