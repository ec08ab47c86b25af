"""Recording what passes, from any thread, without ever making it wait.

One thread owns the file. It closes a chunk and hands it to the operating system every second and every 128 KiB, so
that a crash of the process costs a second of the recording at most, and puts it on the disk every few seconds.
"""

from __future__ import annotations

import logging
import threading
import time
from contextvars import copy_context
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final, Self

from mesh.errors import ClosedError
from mesh.recording.errors import RecordingFailed
from mesh.recording.mcap_file import check_message
from mesh.recording.partial import Message, PartialFile

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

    from mesh.recording.partial import Role
    from schemas.payloads import PayloadType

log = logging.getLogger(__name__)

_COST: Final = 256
"""Bytes of memory that a message takes in the queue besides its payload."""
_AT_ONCE: Final = 512
"""Messages written before the thread looks at the clock again."""
_GATHERING_SECONDS: Final = 0.005
"""How long messages gather before they are written: a thread that is woken for each of them costs more than that."""
_KNOWN_TOPICS: Final = 4096


@dataclass(frozen=True, kw_only=True)
class RecordingAbout:
    """Whose recording it is: what goes into its metadata record `aira`. Any field may be empty.

    `topics` are those that are recorded, separated by commas; empty for all.
    """

    liability: str = ""
    agent: str = ""
    lighthouse: str = ""
    objective: str = ""
    software: str = ""
    topics: str = ""


@dataclass(frozen=True, kw_only=True)
class RecorderSettings:
    """How often a recording is handed over and put on the disk, in seconds, and how much may wait, in bytes."""

    flush_seconds: float = 1.0
    sync_seconds: float = 5.0
    queue_bytes: int = 64 << 20


@dataclass(frozen=True, kw_only=True)
class RecordingSummary:
    """A finished recording. `recovered` of its `messages` came from a file that a crash had left.

    `lost` messages were dropped because the disk could not keep up. `size` is in bytes.
    """

    path: Path
    messages: int
    lost: int
    recovered: int
    size: int


@dataclass(frozen=True, kw_only=True)
class RecorderStatistics:
    """What a recorder, or several, have done so far: messages in the file, and messages dropped.

    `lag` is for how many seconds the message that waits longest has waited to be written.
    """

    recorded: int
    lost: int
    lag: float


_SETTINGS: Final = RecorderSettings()


class Recorder:
    """Makes the recording at `path`, `NAME.mcap`; it is `NAME.mcap.part` until `close`.

    A `.part` that a crash left is gone on with: the new recording begins with what can be read of it. Opening blocks
    on the disk for a moment, `close` until all is written; use threads. Raises `RecordingExists` if `path` is there or
    somebody else is recording it, `RecordingFailed` if the file can't be made.
    """

    def __init__(self, path: Path, about: RecordingAbout, *, settings: RecorderSettings = _SETTINGS) -> None:
        self.path: Final = path
        self._settings = settings
        self._about = about
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._queue: list[Message] = []
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def lost(self) -> int:
        """Messages dropped so far, because too much was waiting or the disk refused it."""
        return self._lost

    @property
    def is_done(self) -> bool:
        """Whether the file is written, or given up: nothing is counted any more."""
        return self._summary is not None or self._failure is not None

    def statistics(self) -> RecorderStatistics:
        """What it has done so far; from any thread."""
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
        role: Role = "device",
        log_time_ns: int | None = None,
        publish_time_ns: int | None = None,
    ) -> None:
        """Add a message, without waiting for anything; from any thread. Times are nanoseconds, now if not given.

        `role` tells what was played from what the device said. Over `queue_bytes` waiting, the message is dropped and
        counted. Raises `Unrecordable` for what no file can hold, `ClosedError`, and `RecordingFailed` once the disk
        has refused the recording.
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
        """Write what waits, end the file, put it on the disk and give it its name. Safe to call twice.

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
        """Write what comes until `close` was called and nothing waits any more."""
        every = self._settings.flush_seconds, self._settings.sync_seconds
        while True:
            if self._wake.wait(file.seconds_to_keep(*every)):
                self._closed.wait(_GATHERING_SECONDS)
            self._wake.clear()
            closing = self._closing
            while batch := self._take():
                for start in range(0, len(batch), _AT_ONCE):
                    self._add(file, batch[start : start + _AT_ONCE])
                    file.keep_what_is_due(*every)
            file.keep_what_is_due(*every)
            if closing:
                return

    def _add(self, file: PartialFile, messages: list[Message]) -> None:
        refused = file.add(messages)
        with self._lock:
            self._queued -= sum([len(message[1]) for message in messages]) + _COST * len(messages)
            self._lost += len(refused)
            self._recorded += len(messages) - len(refused)
        self._taken -= len(messages)
        for error in refused:
            log.warning("a message is lost for %s: %s", self.path.name, error)

    def _take(self) -> list[Message]:
        """All that waits; it counts as waiting until it is written."""
        with self._lock:
            batch, self._queue = self._queue, []
            self._taken, self._taken_since = len(batch), self._since
        return batch

    def _check(self, topic: str, payload: bytes, log_time: int, publish_time: int) -> None:
        check_message(topic, payload, log_time, publish_time)
        if len(self._topics) < _KNOWN_TOPICS:
            self._topics.add(topic)
