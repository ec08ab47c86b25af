"""One run of a job: the objective played to the device, and all that the device says recorded."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec
import zenoh

from mesh.errors import AiraError, ClosedError
from mesh.recording import Recorder, Unrecordable, json_type, play
from schemas.keys import LiabilityTopicKey, ObjectiveTopicKey, parse_key, topic_selector
from schemas.payloads import JSON, STRING, PayloadType, String, encode_value, payload_type

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.recording import Objective, Pace, Played, RecordingSummary
    from schemas import Liability

log = logging.getLogger(__name__)

AHEAD: Final = 1024
"""Played messages that wait for the device's handler at most; then the player waits."""
NOTE_TOPIC: Final = "/aira/note"
"""Topic of the recording on which the agent says why a job failed."""
FLUSH: Final = "aira/flush"
"""Encoding of the mark that a run sends to itself when it has heard enough."""


class HandlerCancelled(AiraError):
    """A handler ended with the cancellation of something that it waited for, and so without having done its work."""

    code = "handler-cancelled"


class TopicHandler(Protocol):
    """What does the work: the code that talks to the device."""

    @property
    def topics(self) -> frozenset[str] | None:
        """The objective's topics that it understands; None for any."""

    def obstacle(self, topic: str, said: Any) -> str:
        """Why it can't do what a message on one of its topics says, decoded; empty if it can."""

    async def perform(self, run: Job, message: Played) -> None:
        """Do what one played message asks; the next one waits. An exception fails the job."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a run needs to know: the job, how fast to play, where to begin, what to record (None: all topics)."""

    liability: Liability
    objective: Objective | None
    pace: Pace
    position: int = 0
    topics: frozenset[str] | None = None


class Job:
    """A run on an open session. `open`, then `play` once, then `close`; `publish` at any time between.

    The recorder owns its file; what arrives on the liability's topics goes into it from Zenoh's thread directly,
    never over the event loop. Not to be used again after `close`.
    """

    def __init__(self, session: zenoh.Session, agent: str, plan: Plan, recorder: Recorder) -> None:
        self._session = session
        self._agent = agent
        self._plan = plan
        self._recorder = recorder
        self._subscriber: Any = None
        self._mark = secrets.token_bytes(16)
        self._flushed = threading.Event()
        self._waiting: asyncio.Queue[Played | None] = asyncio.Queue(AHEAD)
        self._player: asyncio.Task[None] | None = None
        self._closing = False
        self._types = _described(plan.objective)
        self.position = plan.position
        """How many of the objective's messages have been done with."""
        self.playing: Played | None = None
        """The message that the performer is at: its topic, times and type."""
        self.refused = 0
        """Messages that were heard on the job's topics but can't be recorded."""

    @property
    def liability(self) -> Liability:
        """The contract that this run works for."""
        return self._plan.liability

    def open(self) -> None:
        """Begin to listen to the job's topics; from now on everything on them is recorded."""
        selector = topic_selector(self._agent, self.liability.address)
        self._subscriber = self._session.declare_subscriber(selector, self._hear)

    def publish(self, topic: str, message: object) -> None:
        """Say `message` on a topic of the job, as the device does; it becomes part of the recording.

        `message` is bytes, or what `schemas.payloads.encode_value` takes: `Empty`, `String`, a str, a msgspec
        Struct or plain JSON data.
        """
        if self._subscriber is None:
            raise ClosedError(f"the run of {self.liability.address} is not open")
        payload, kind = encode_value(message)
        key = str(LiabilityTopicKey(self._agent, self.liability.address, topic))
        if kind == JSON and isinstance(message, msgspec.Struct):
            kind = json_type(type(message))
            self._types[topic, kind.zenoh_encoding] = kind
        self._put(key, payload, kind)

    async def play(self, performer: TopicHandler | None, *, progress: Callable[[int], Awaitable[None]]) -> None:
        """Play the objective from its position to its end, each message at its time; returns when all is done.

        Every message goes to the mesh, into the recording and, where there is a `performer`, to it: in order, one
        after the other. `progress` is told the position after each. Raises what the performer raises. When the run is
        closed meanwhile, which the performer itself may do, it returns after the message that the performer is at.
        """
        failed: BaseException | None = None
        try:
            async with asyncio.TaskGroup() as tasks:
                if not self._closing:
                    self._player = tasks.create_task(self._play(), name=f"player {self.liability.address}")
                tasks.create_task(self._perform(performer, progress), name=f"performer {self.liability.address}")
        except ExceptionGroup as group:
            failed = group.exceptions[0]
        if failed is not None:
            raise failed

    async def close(self, note: str = "") -> RecordingSummary:
        """Close the recording; everything heard before this call is in it. `note` is written at its end."""
        self._closing = True
        if self._player is not None:
            self._player.cancel()
        with contextlib.suppress(asyncio.QueueFull):  # then the performer has something to wake up for
            self._waiting.put_nowait(None)
        if self._subscriber is not None:
            await asyncio.to_thread(self._stop_listening)
        if note:
            self._recorder.record(NOTE_TOPIC, String(note).encode(), STRING, role="agent")
        return await asyncio.to_thread(self._recorder.close)

    async def _play(self) -> None:
        plan = self._plan
        assert plan.objective is not None, "a run without an objective only records"
        async for step in play(plan.objective, pace=plan.pace, start_index=plan.position):
            message = step.message
            if self._wanted(message.topic):
                self._recorder.record(message.topic, message.payload, message.type, role="objective")
            key = str(ObjectiveTopicKey(self._agent, self.liability.address, message.topic))
            self._put(key, message.payload, message.type)
            await self._waiting.put(message)
        await self._waiting.put(None)

    async def _perform(self, performer: TopicHandler | None, progress: Callable[[int], Awaitable[None]]) -> None:
        while (message := await self._waiting.get()) is not None and not self._closing:
            if performer is not None:
                self.playing = message
                await self._perform_one(performer, message)
            self.position += 1
            await progress(self.position)

    async def _perform_one(self, performer: TopicHandler, message: Played) -> None:
        try:
            await performer.perform(self, message)
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                raise
            # A task group takes a task that ends so for one that it has cancelled itself, and the job for done.
            raise HandlerCancelled(f"the handler of {message.topic} was cancelled") from None

    def _put(self, key: str, payload: bytes, kind: PayloadType) -> None:
        self._session.put(key, payload, encoding=kind.zenoh_encoding, congestion_control=zenoh.CongestionControl.DROP)

    def _hear(self, sample: zenoh.Sample) -> None:
        """Zenoh's callback: a message on the job's topics, or our own mark that all before it has been heard."""
        encoding = str(sample.encoding)
        if encoding == FLUSH and sample.payload.to_bytes() == self._mark:
            self._flushed.set()
            return
        try:
            key = parse_key(str(sample.key_expr))
            if isinstance(key, LiabilityTopicKey) and self._wanted(key.topic):
                kind = self._type_of(key.topic, encoding)
                self._recorder.record(key.topic, sample.payload.to_bytes(), kind, role="device")
        except Exception as error:
            # Nobody stands behind a callback: what can't be recorded is counted and said, and the next one is heard.
            self.refused += 1
            level = logging.INFO if isinstance(error, Unrecordable) else logging.ERROR
            log.log(level, "%s: not recorded from %s: %s", self.liability.address, sample.key_expr, error)

    def _type_of(self, topic: str, encoding: str) -> PayloadType:
        """The type of what is heard: only its name travels, and who knows how it is described may be ourselves."""
        return self._types.get((topic, encoding)) or self._types.get(("", encoding)) or payload_type(encoding)

    def _wanted(self, topic: str) -> bool:
        return self._plan.topics is None or topic in self._plan.topics

    def _stop_listening(self) -> None:
        """Samples reach a subscriber in order, so once it has our mark it has all that came before."""
        subscriber, self._subscriber = self._subscriber, None
        with contextlib.suppress(zenoh.ZError):  # a session that broke has nothing more to say
            mark = LiabilityTopicKey(self._agent, self.liability.address, NOTE_TOPIC)
            self._session.put(str(mark), self._mark, encoding=FLUSH, allowed_destination=zenoh.Locality.SESSION_LOCAL)
            self._flushed.wait(timeout=5)
            subscriber.undeclare()


def _described(objective: Objective | None) -> dict[tuple[str, str], PayloadType]:
    """The types that an objective describes and nobody here knows, by any topic ('') and their Zenoh encoding."""
    if objective is None:
        return {}
    types = (topic.type for topic in objective.topics if topic.type.schema_name and topic.type.schema_data)
    return {("", kind.zenoh_encoding): kind for kind in types if not payload_type(kind.zenoh_encoding).schema_data}
