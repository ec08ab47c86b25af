"""Recording messages from any thread, without ever making the caller wait.

One thread owns the file. Every second and every 128 KiB it closes a chunk and hands it to the operating system, so that
a crash of the process costs at most a second of the recording. Every few seconds it syncs the file to the disk.
"""

from __future__ import annotations

import logging
import threading
import time
from contextvars import copy_context
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final, Self

from mesh.errors import ClosedError
from mesh.log_context import log_event
from mesh.recording.errors import RecordingFailed
from mesh.recording.mcap_writer import check_message
from mesh.recording.partial import PartialFile, PendingMessage

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.recording.partial import MessageRole
    from schemas.payloads import PayloadType

log = logging.getLogger(__name__)

_COST: Final = 256
"""Bytes of memory that a message takes in the queue besides its payload."""
_AT_ONCE: Final = 512
"""Messages written before the thread looks at the clock again."""
_GATHERING_SECONDS: Final = 0.005
"""How long messages gather before they are written: waking the thread for each of them costs more."""
_KNOWN_TOPICS: Final = 4096


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


@dataclass(frozen=True, kw_only=True)
class RecorderSettings:
    """How often a recording is flushed to the operating system and synced to the disk, and how many bytes may wait."""

    flush_seconds: float = 1.0
    sync_seconds: float = 5.0
    queue_bytes: int = 64 << 20


@dataclass(frozen=True, kw_only=True)
class RecordingSummary:
    """A finished recording. `recovered` of its `messages` are from a file that a crash left behind.

    `lost` messages were dropped because the disk was too slow. `size` is in bytes.
    """

    path: Path
    messages: int
    lost: int
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

    If a crash left a `.part`, the new recording begins with its readable messages. Opening blocks on the disk for a
    moment, `close` until everything is written: use threads. Raises `RecordingExists` if `path` exists or another
    process is recording it, and `RecordingFailed` if the file can't be created.
    """

    def __init__(self, path: Path, about: RecordingAbout, *, settings: RecorderSettings = _SETTINGS) -> None:
        self.path: Final = path
        self._settings = settings
        self._about = about
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._queue: list[PendingMessage] = []
        self._queued = 0
        self._taken = 0
        self._topics: set[str] = set()
        self._closing = False
        self._closed = threading.Event()
        self._lost = 0
        self._recorded = 0
        self._since = self._taken_since = 0.0
        self._failure: Exception | None = None
        self._summary: RecordingSummary | None = None
        try:
            self._file = PartialFile(path)
        except OSError as error:
            raise RecordingFailed(path, error.strerror or str(error)) from error
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
    def is_done(self) -> bool:
        """Whether the file is finished or failed: the statistics no longer change."""
        return self._summary is not None or self._failure is not None

    def statistics(self) -> RecorderStatistics:
        """What it has done so far. For any thread."""
        with self._lock:
            now = time.monotonic()
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
        message is dropped and counted. Raises `Unrecordable` for a message that no file can hold, `ClosedError`, and
        `RecordingFailed` once the disk has refused the recording.
        """
        log_time = time.time_ns() if log_time_ns is None else log_time_ns
        publish_time = log_time if publish_time_ns is None else publish_time_ns
        if log_time_ns is not None or publish_time_ns is not None or topic not in self._topics:
            self._check(topic, payload, log_time, publish_time)
        elif payload.__class__ is not bytes:
            check_message(topic, payload, log_time, publish_time)
        cost = len(payload) + _COST
        with self._lock:
            if self._closing:
                raise ClosedError(f"the recording {self.path} is closed")
            if self._failure is not None:
                self._lost += 1
                raise RecordingFailed(self.path, str(self._failure))
            if self._queued + cost > self._settings.queue_bytes:
                self._lost += 1
                return
            first = not self._queue
            if first:
                self._since = time.monotonic()
            self._queue.append((topic, payload, type, role, log_time, publish_time))
            self._queued += cost
        if first:
            self._wake.set()

    def close(self) -> RecordingSummary:
        """Write the waiting messages, end and sync the file, and give it its final name. Safe to call twice.

        Raises `RecordingFailed` if the disk refused any of it; the `.part` stays for `recover`.
        """
        with self._lock:
            self._closing = True
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
                file.begin(asdict(self._about))
                self._write(file)
                lost, recovered = self._lost, file.recovered
                messages, size = file.finish({"lost": str(lost)})
            self._summary = RecordingSummary(
                path=self.path, messages=messages, lost=lost, recovered=recovered, size=size
            )
        except Exception as error:
            with self._lock:
                self._failure = error
                self._lost += len(self._queue) + self._taken
                self._queue.clear()

    def _write(self, file: PartialFile) -> None:
        """Write messages until `close` was called and none is waiting."""
        every = self._settings.flush_seconds, self._settings.sync_seconds
        while True:
            if self._wake.wait(file.seconds_until_due(*every)):
                self._closed.wait(_GATHERING_SECONDS)
            self._wake.clear()
            closing = self._closing
            while batch := self._take():
                for start in range(0, len(batch), _AT_ONCE):
                    self._add(file, batch[start : start + _AT_ONCE])
                    file.flush_if_due(*every)
            file.flush_if_due(*every)
            if closing:
                return

    def _add(self, file: PartialFile, messages: list[PendingMessage]) -> None:
        refused = file.add(messages)
        with self._lock:
            self._queued -= sum([len(message[1]) for message in messages]) + _COST * len(messages)
            self._lost += len(refused)
            self._recorded += len(messages) - len(refused)
        self._taken -= len(messages)
        for error in refused:
            event = log_event("recording-message-refused", path=self.path, error=error)
            log.warning("%s lacks a message: %s", self.path.name, error, extra=event)

    def _take(self) -> list[PendingMessage]:
        """All waiting messages; they count as waiting until they are written."""
        with self._lock:
            batch, self._queue = self._queue, []
            self._taken, self._taken_since = len(batch), self._since
        return batch

    def _check(self, topic: str, payload: bytes, log_time: int, publish_time: int) -> None:
        check_message(topic, payload, log_time, publish_time)
        if len(self._topics) < _KNOWN_TOPICS:
            self._topics.add(topic)


class Recorders:
    """Opens recorders, and adds up their statistics, including those of closed ones. For any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: list[Recorder] = []
        self._recorded = 0
        self._lost = 0

    def open(self, path: Path, about: RecordingAbout) -> Recorder:
        """Open a `Recorder`; the caller closes it. Raises as that does."""
        recorder = Recorder(path, about)
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
