"""A run of a job: its objective played to the handlers, and everything on the job's topics recorded."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import threading
from typing import TYPE_CHECKING, Final, NamedTuple

import zenoh

from mesh.errors import AiraError
from mesh.log_context import log_event
from mesh.recording import NOTE_TOPIC, AtOnce, Unrecordable, play
from mesh.work.job import HandlerCancelled, Job
from schemas.agent_keys import LiabilityTopicKey, ObjectiveTopicKey, ProgressKey, parse_agent_key
from schemas.definitions import defined_by
from schemas.payloads import JSON, STRING, PayloadType, String, payload_type
from schemas.records import PlaybackPosition
from schemas.selectors import topic_selector

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.recording import Objective, Pace, Played, Recorder, RecordingSummary
    from schemas import Liability

    Handle = Callable[[Job, Played], Awaitable[object]]

log = logging.getLogger(__name__)

QUEUED: Final = 1024
"""Most played messages that wait for their handler; then the player waits."""
LEARNT: Final = 4096
"""Types of a job whose definitions are remembered, at most."""
FLUSH: Final = "aira/flush"
"""Encoding of the message that a run sends to itself to know that it has received everything before it."""


class RecordingIncomplete(AiraError, code="recording-incomplete"):
    """A job's recording lacks messages that were played, so the job is not a success. `missing` is how many."""

    def __init__(self, liability: str, missing: int) -> None:
        super().__init__(
            f"the recording of {liability} lacks {missing} messages that the disk had, or that were played"
        )
        self.liability = liability
        self.missing = missing


class SyncedRun(NamedTuple):
    """What of a run is on the disk: `messages` are recorded, and with them all of the objective up to `position`."""

    position: int
    messages: int


class JobRun(Job):
    """A job while it is worked on: `open`, then `play` once, then `close`. It can't be used again after `close`.

    It plays `objective`, if there is one, from the message at `position`, and records the topics in `recorded` (None:
    all). It owns the `recorder`; what arrives on the job's topics is recorded in Zenoh's thread, past the event loop.
    An interrupted run that it continues had synced `earlier` messages.
    """

    def __init__(
        self,
        session: zenoh.Session,
        agent: str,
        liability: Liability,
        recorder: Recorder,
        *,
        objective: Objective | None = None,
        pace: Pace | None = None,
        position: int = 0,
        recorded: frozenset[str] | None = None,
        earlier: int = 0,
    ) -> None:
        super().__init__(session, agent, liability, position=position)
        self._recorder = recorder
        self._objective = objective
        self._types = _described(objective)
        self._markers: dict[bytes, threading.Event] = {}
        self._queue: asyncio.Queue[Played | None] = asyncio.Queue(QUEUED)
        self._player: asyncio.Task[None] | None = None
        self._closing = False
        self.pace: Pace = pace or AtOnce()
        """How fast the objective is played."""
        self.recorded = recorded
        """The topics that are recorded; None for all."""
        self.unrecordable = 0
        """Messages on the job's topics that could not be recorded."""
        self.missing = max(0, earlier - recorder.recovered)
        """Messages of the interrupted run that are no longer on the disk, although they were synced."""
        if objective is not None:
            self.topics = frozenset(topic.name for topic in objective.topics)

    def open(self) -> None:
        """Subscribe to the job's topics; from now on everything on them is recorded."""
        selector = topic_selector(self._agent, self.liability.address)
        self._subscriber = self._session.declare_subscriber(selector, self._receive)

    async def play(self, handle: Handle | None) -> None:
        """Play the objective to its end, each message at its time. Returns when the last one is handled.

        Each message goes into the recording, to the mesh and to `handle`, one after the other; then it counts in
        `position`. Raises what `handle` raises. If the run is closed meanwhile (`handle` may do that), it returns after
        the message that is being handled.
        """
        failed: BaseException | None = None
        try:
            async with asyncio.TaskGroup() as tasks:
                if not self._closing:
                    self._player = tasks.create_task(self._publish_messages(), name=f"player {self.liability.address}")
                tasks.create_task(self._handle_all(handle), name=f"handlers {self.liability.address}")
        except ExceptionGroup as group:
            failed = group.exceptions[0]
        if failed is not None:
            raise failed

    def publish_position(self) -> None:
        """Put on the job's progress key how far the playback is."""
        assert self._objective is not None, "a run without an objective only records"
        key = str(ProgressKey(self._agent, self.liability.address))
        playback = PlaybackPosition(position=self.position, total=self._objective.count)
        self._put(key, playback.encode(), JSON)

    async def sync(self) -> SyncedRun:
        """Sync the recording of all messages that were handled, and of what their handlers published.

        Raises `RecordingFailed`.
        """
        position = self.position
        if self._subscriber is not None:
            await asyncio.to_thread(self._receive_sent)
        return SyncedRun(position, await asyncio.wrap_future(self._recorder.sync()))

    async def close(self, note: str = "", *, sync: bool = True) -> RecordingSummary:
        """Close the recording, which has everything that was received before, and `sync` it.

        `note` is written at its end.
        """
        self._closing = True
        if self._player is not None:
            self._player.cancel()
        with contextlib.suppress(asyncio.QueueFull):  # a full queue wakes the handlers anyway
            self._queue.put_nowait(None)
        if self._subscriber is not None:
            await asyncio.to_thread(self._unsubscribe)
        self._end_listening()
        if note:
            self._recorder.record(NOTE_TOPIC, String(note).encode(), STRING, role="agent")
        return await asyncio.to_thread(self._recorder.close, sync=sync)

    async def _publish_messages(self) -> None:
        assert self._objective is not None, "a run without an objective only records"
        async for step in play(self._objective, pace=self.pace, start_index=self.position):
            message = step.message
            while self._recorder.is_behind:
                await asyncio.wrap_future(self._recorder.sync())
            if self._is_recorded(message.topic):
                self._recorder.record(message.topic, message.payload, message.type, role="objective")
            key = str(ObjectiveTopicKey(self._agent, self.liability.address, message.topic))
            self._put(key, message.payload, message.type)
            await self._queue.put(message)
        await self._queue.put(None)

    async def _handle_all(self, handle: Handle | None) -> None:
        while (message := await self._queue.get()) is not None and not self._closing:
            if handle is not None:
                self.playing = message
                await self._handle_one(handle, message)
            self.position += 1

    async def _handle_one(self, handle: Handle, message: Played) -> None:
        try:
            await handle(self, message)
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                raise
            # A task group would take this task for one that it cancelled itself, and the job for done.
            raise HandlerCancelled(f"the handler of {message.topic} was cancelled") from None

    def _receive(self, sample: zenoh.Sample) -> None:
        """Zenoh's callback: record a message on the job's topics, or take the run's own marker."""
        encoding = str(sample.encoding)
        if encoding == FLUSH and (flushed := self._markers.pop(sample.payload.to_bytes(), None)) is not None:
            flushed.set()
            return
        try:
            key = parse_agent_key(str(sample.key_expr))
            if isinstance(key, LiabilityTopicKey):
                kind, payload = self._type_of(key.topic, encoding, sample.attachment), sample.payload.to_bytes()
                self._deliver(key.topic, payload, kind)
                if self._is_recorded(key.topic):
                    self._recorder.record(key.topic, payload, kind, role="device")
        except Exception as error:
            # Nothing catches what a callback raises: count and log it, and record the next message.
            self.unrecordable += 1
            level = logging.INFO if isinstance(error, Unrecordable) else logging.ERROR
            facts = log_event("message-not-recorded", liability=self.liability.address, key=sample.key_expr)
            log.log(level, "%s: can't record %s: %s", self.liability.address, sample.key_expr, error, extra=facts)

    def _type_of(self, topic: str, encoding: str, attachment: zenoh.ZBytes | None) -> PayloadType:
        """The type of a received message. Its name travels; the run may know its definition, or learn it."""
        known = self._types.get((topic, encoding)) or self._types.get(("", encoding))
        if known is not None:
            return known
        kind = payload_type(encoding)
        if attachment is None or kind.schema_data or len(self._types) >= LEARNT:
            return kind
        defined = defined_by(attachment.to_bytes(), kind)
        if defined is None:
            return kind
        self._types[topic, encoding] = defined
        return defined

    def _is_recorded(self, topic: str) -> bool:
        return self.recorded is None or topic in self.recorded

    def _unsubscribe(self) -> None:
        self._receive_sent()
        subscriber, self._subscriber = self._subscriber, None
        with contextlib.suppress(zenoh.ZError):  # a broken session delivers nothing more
            subscriber.undeclare()

    def _receive_sent(self) -> None:
        """Return when everything that was sent before is received: samples reach a subscriber in order."""
        marker, flushed = secrets.token_bytes(16), threading.Event()
        self._markers[marker] = flushed
        with contextlib.suppress(zenoh.ZError):
            key = LiabilityTopicKey(self._agent, self.liability.address, NOTE_TOPIC)
            local = zenoh.Locality.SESSION_LOCAL
            self._session.put(str(key), marker, encoding=FLUSH, allowed_destination=local)
            flushed.wait(timeout=5)
        self._markers.pop(marker, None)


def _described(objective: Objective | None) -> dict[tuple[str, str], PayloadType]:
    """Types that only the objective describes, by any topic ('') and their Zenoh encoding."""
    if objective is None:
        return {}
    types = (topic.type for topic in objective.topics if topic.type.schema_name and topic.type.schema_data)
    return {("", kind.zenoh_encoding): kind for kind in types if not payload_type(kind.zenoh_encoding).schema_data}
