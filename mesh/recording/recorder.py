"""Recording messages from any thread, without ever making the caller wait.

One thread owns the file. It syncs the file to the disk every second, so that a power cut costs at most a second of the
recording, and whenever someone asks for it: many that ask at once cost one sync.

Log times never go backwards: they count by the monotonic clock from the time of day at which the recorder was opened.
"""

from __future__ import annotations

import logging
import threading
from concurrent.futures import Future
from contextvars import copy_context
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from mesh.clock import SYSTEM_CLOCK
from mesh.errors import ClosedError
from mesh.log_context import log_event
from mesh.recording.errors import RecordingFailed
from mesh.recording.mcap_writer import check_message
from mesh.recording.partial import PartialFile, PendingMessage

if TYPE_CHECKING:
    from mesh.clock import Clock
    from mesh.recording.partial import MessageRole, RecordingAbout
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
    `RecordingExists` if `path` exists or another process is recording it, and `RecordingFailed` if the disk refuses it.
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
        self._topics: set[str] = set()
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
            self._file = PartialFile(path, clock)
            self._epoch = self._file.begin(about) - clock.monotonic_ns()
        except OSError as error:
            raise RecordingFailed(path, error.strerror or str(error)) from error
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
        if log_time_ns is not None or publish_time_ns is not None or topic not in self._topics:
            self._check(topic, payload, log_time_ns, publish_time_ns)
        elif payload.__class__ is not bytes:
            check_message(topic, payload)
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
        every = self._settings.sync_seconds
        while True:
            if self._wake.wait(file.seconds_until_due(every)):
                self._closed.wait(_GATHERING_SECONDS)
            self._wake.clear()
            closing = self._closing
            while True:
                batch, syncing = self._take()
                for start in range(0, len(batch), _AT_ONCE):
                    self._add(file, batch[start : start + _AT_ONCE])
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

    def _check(self, topic: str, payload: bytes, *times: int | None) -> None:
        check_message(topic, payload, *(time for time in times if time is not None))
        if len(self._topics) < _KNOWN_TOPICS:
            self._topics.add(topic)
