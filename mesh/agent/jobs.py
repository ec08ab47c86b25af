"""The jobs of an agent: from a liability that names it as promisor to a signed Result.

    incoming ──► ready ──► running ──► complete ──► finalized        (`mesh.agent.ledger`)
    fetch, check           play, record  store, sign    paid or refunded

Objectives of several jobs are fetched at once; jobs run one after the other, or `parallel` at a time. A missing or bad
objective fails its own job only. The ledger has each change before anyone is notified. `Executor` takes jobs through
their phases. `JobRun` is one run of a job: the objective played to the handlers, and everything on the job's topics
recorded into a file of `JobRecordings`.

Why a job failed stands at the end of its recording: one line of text and the error's code, as in
`the lamp is broken [job-failed]`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import secrets
import shutil
import threading
import time
from contextlib import asynccontextmanager
from contextvars import ContextVar, copy_context
from functools import partial
from traceback import format_exception_only
from typing import TYPE_CHECKING, Final, NamedTuple

import zenoh
from msgspec.structs import replace

import mesh
from mesh.agent.handlers import STOPPING, Job, call
from mesh.agent.ledger import STARTABLE, TO_BE_DONE, Outgoing, Phase, Stop, WrongPhase, advance
from mesh.base.background import Background, in_daemon_thread
from mesh.base.database import LedgerUnusable
from mesh.base.extras import needs_extra
from mesh.base.log_context import liability_context, log_event, with_liability_context
from mesh.base.private_files import make_private_folder, sync_directory
from mesh.errors import AiraError, ClosedError, ContentError, InputError, public_text
from mesh.network.presence import present_keys
from mesh.recording import (
    AT_ONCE,
    GENEROUS,
    NOTE_TOPIC,
    Recorders,
    RecordingAbout,
    RecordingFailed,
    Unrecordable,
    convert,
    is_bag,
    open_objective,
    play,
)
from mesh.recording.ros import legacy_topic
from mesh.role.local_stop import Hold, stop_folder
from schemas import Result, parse_address
from schemas.errors import InvalidAddress, InvalidPayload, InvalidRecord
from schemas.keys import (
    IDLE,
    PRESENT,
    STOP,
    DeviceTopicKey,
    LiabilityTopicKey,
    ObjectiveTopicKey,
    ProgressKey,
    device_selector,
    parse_agent_key,
    topic_selector,
)
from schemas.payloads import JSON, STRING, PayloadType, String, defined_by, payload_type
from schemas.records import DeviceStop, PlaybackPosition
from schemas.signing import LONGEST_WHY, is_word

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
    from pathlib import Path

    from mesh.agent.components import AgentComponents
    from mesh.agent.handlers import StopHandler, TopicHandlers
    from mesh.agent.ledger import JobRecord, Ledger
    from mesh.agent.objectives import Objectives
    from mesh.recording import Objective, Played, Recorder, RecordingSummary
    from schemas import Liability

    Handle = Callable[[Job, Played], Awaitable[object]]
    OnPhase = Callable[[Phase, Liability], Awaitable[None]]


HANDLER_FAILED: Final = "handler-failed"
"""The code of an exception that has none: one of a handler's own."""
STOPPED: Final = "stopped"
"""The code of a job that its customer stopped."""
ROBOT_STOPPED: Final = "robot-stopped"
"""The code of a job that the robot's side stopped; one that it handed back has a code of its own."""
_CODE: Final = re.compile(r"(.*) \[([a-z0-9-]{1,64})\]", re.DOTALL)


def check_stop(why: str, code: str | None = None) -> None:
    """Raise `InputError` for a reason that is too long, and for a code that a job can't be handed back with."""
    if len(why) > LONGEST_WHY:
        raise InputError(f"the reason has {len(why)} characters, the most are {LONGEST_WHY}", code="why-too-long")
    if code is not None and not is_word(code):
        hint = "use lower-case letters, digits and hyphens, 64 characters at most"
        raise InputError(f"{code!r} is not a valid code", hint=hint, code="invalid-code")
    if code in (STOPPED, ROBOT_STOPPED):
        raise InputError(f"a job that is handed back can't have the code {code}", code="invalid-code")


class Reason(NamedTuple):
    """Why a job failed. Both are empty if nothing says so."""

    text: str = ""
    code: str = ""


def note_of(error: Exception) -> str:
    """The note for an error that ended a job. It becomes public with the recording."""
    if isinstance(error, AiraError):
        return f"{public_text(error)} [{error.code}]"
    return f"{public_text(''.join(format_exception_only(error)).strip())} [{HANDLER_FAILED}]"


def note_of_stop(stop: Stop) -> str:
    """The note at the end of a stopped job's recording. It becomes public with the recording."""
    whats = {STOPPED: "stopped by the customer", ROBOT_STOPPED: "stopped by the robot's side"}
    what = whats.get(stop.code, "handed back by the robot")
    return f"{what}{': ' if stop.why else ''}{public_text(stop.why)} [{stop.code}]"


def read_reason(recording: Path) -> Reason:
    """What the last note of a recording says. Use a thread. Raises `RecordingError` if it is none."""
    note = ""
    for message in open_objective(recording, GENEROUS).messages():
        if message.topic == NOTE_TOPIC:
            try:
                note = String.decode(message.payload).data[:1000]
            except InvalidPayload:
                continue  # the recording is a stranger's: what is no text says nothing
    return reason_in(note)


def reason_in(note: str) -> Reason:
    found = _CODE.fullmatch(note)
    return Reason(note) if found is None else Reason(*found.groups())


log = logging.getLogger(__name__)

QUEUED: Final = 1024
"""Most played messages that wait for their handler; then the player waits."""
FLUSH: Final = "aira/flush"
"""Encoding of the message that a run sends to itself to know that it has received everything before it."""


class JobPace(NamedTuple):
    """How often a job's run is saved, and what its end waits for, in seconds."""

    publishing: float = 0.5
    """After which a run's position is published, if it has changed."""
    saving: float = 0.5
    """After which a run's recording is synced and its position saved, again and again: what a crash repeats."""
    presence: float = 2.0
    """For the question whether devices are present."""
    idle: float = 30.0
    """For which the end of a job waits for the devices: as long as a command waits for a device that is absent."""
    quiet: float = 0.25
    """For which a job's topics must be silent then, as a device may answer after it has carried out a command …"""
    longest_quiet: float = 2.0
    """… but no longer than this: a device may never be silent."""


JOB_PACE: Final = JobPace()


class JobStopPace(NamedTuple):
    """What the stop of a job waits for, in seconds."""

    hearing: float = 2.0
    """Until the agent's devices have confirmed that they heard it."""
    leaving: float = 2.0
    """For which the cancelled handlers of the job may clean up; then `on_stop` is called beside them."""
    safe: float = 60.0
    """For which a handler of `Agent.on_stop` may bring the robot to a safe state."""


JOB_STOP_PACE: Final = JobStopPace()


def stop_devices(session: zenoh.Session, agent: str, why: str) -> tuple[DeviceStop, ...]:
    """Tell the devices of an agent that are present to stop; returns once each has answered. Blocks.

    A device that does not answer in time has not heard it.
    """
    answers: dict[str, DeviceStop] = {}
    with contextlib.suppress(zenoh.ZError):
        stop, payload = device_selector(agent, topic=STOP), String(why).encode()
        target, consolidation = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.NONE
        timeout = JOB_STOP_PACE.hearing
        for reply in session.get(
            stop, payload=payload, target=target, consolidation=consolidation, timeout=timeout, express=True
        ):
            if reply.ok is not None:
                with contextlib.suppress(InvalidRecord):
                    answer = DeviceStop.decode(reply.ok.payload.to_bytes())
                    answers[answer.device] = answer
        for text in present_keys(session, device_selector(agent, topic=PRESENT), timeout=JOB_PACE.presence):
            key = parse_agent_key(text)
            if isinstance(key, DeviceTopicKey) and key.device not in answers:
                detail = f"it did not confirm the stop within {timeout:g} s"
                answers[key.device] = DeviceStop(device=key.device, heard=False, detail=detail)
    return tuple(answers[device] for device in sorted(answers))


def incomplete(liability: str, missing: int) -> AiraError:
    """The error of a job whose recording lacks messages that were played: it is not a success."""
    why = f"the recording of {liability} lacks {missing} messages that the disk had, or that were played"
    return AiraError(why, code="recording-incomplete")


class JobRun(Job):
    """A job while it is worked on: `open`, then `play` once, then `close` or `suspend`. After that it can't be used.

    It plays `objective`, if there is one, from the position of `job`, and records the topics in `recorded` (None: all).
    It owns the `recorder`; what arrives on the job's topics is recorded in Zenoh's thread, past the event loop.
    """

    def __init__(
        self,
        session: zenoh.Session,
        agent: str,
        job: JobRecord,
        recorder: Recorder,
        *,
        objective: Objective | None = None,
        speed: float = AT_ONCE,
        recorded: frozenset[str] | None = None,
    ) -> None:
        super().__init__(session, agent, job.liability, position=job.position)
        self._recorder = recorder
        self._objective = objective
        self._types = _described(objective)
        self._markers: dict[bytes, threading.Event] = {}
        self._queue: asyncio.Queue[Played | None] = asyncio.Queue(QUEUED)
        self._player: asyncio.Task[None] | None = None
        self._closing = False
        self._heard_at = 0.0
        """When something was last received on the job's topics."""
        self.speed = speed
        """How fast the objective is played."""
        self.recorded = recorded
        """The topics that are recorded; None for all."""
        self.unrecordable = 0
        """Messages on the job's topics that could not be recorded."""
        self.missing = max(0, job.recorded - recorder.recovered)
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

    async def play_and_save(self, handle: Handle | None, ledger: Ledger) -> None:
        """The same, and meanwhile publish the position, and save how far the recording on the disk reaches.

        Raises what `handle` raises, `RecordingFailed`, `LedgerUnusable`, and at once if the recording is `incomplete`.
        """
        address = self.liability.address
        if self.missing:
            raise incomplete(address, self.missing)
        async with Background() as tasks:
            tasks.start(self._save_regularly(ledger), f"position {address}")
            tasks.start(self._publish_regularly(), f"progress {address}")
            await self.play(handle)
        self._publish_position()
        await self._save(ledger)

    async def suspend(self, ledger: Ledger) -> None:
        """Close the run and save its position, so that another run can continue it."""
        summary = await self.close()
        await ledger.set_position(self.liability.address, self.position, recorded=summary.messages)

    @property
    def playback(self) -> PlaybackPosition | None:
        """How far the playback is; None if the run only records."""
        return (
            None if self._objective is None else PlaybackPosition(position=self.position, total=self._objective.count)
        )

    async def sync(self) -> tuple[int, int]:
        """Sync the recording of all messages that were handled, and of what their handlers published.

        Returns how many messages were handled, and how many the recording has then. Raises `RecordingFailed`.
        """
        position = self.position
        if self._subscriber is not None:
            await asyncio.to_thread(self._receive_sent)
        return position, await asyncio.wrap_future(self._recorder.sync())

    async def settle(self) -> None:
        """Wait until the agent's devices have answered their commands, so that the recording has the answers.

        A run that is not played to its end, or without a device that is present, has none to wait for. First each
        device has to carry out its commands, for `JOB_PACE.idle` at most. Then the job's topics have to be silent for
        `JOB_PACE.quiet`, within `JOB_PACE.longest_quiet`.
        """
        is_played = self._objective is None or self.position >= self._objective.count
        if not is_played or self._subscriber is None or not await asyncio.to_thread(self._wait_for_devices):
            return
        self._heard_at = now = time.monotonic()
        until = now + JOB_PACE.longest_quiet
        while not self._closing and now < min(self._heard_at + JOB_PACE.quiet, until):
            await asyncio.sleep(min(self._heard_at + JOB_PACE.quiet, until) - now)
            now = time.monotonic()

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

    async def _save_regularly(self, ledger: Ledger) -> None:
        _playing.set("")  # in this task: it is no handler, so its timer says nothing of one
        saved = self.position
        while True:
            await asyncio.sleep(JOB_PACE.saving)
            if self.position > saved:
                saved = await self._save(ledger)

    async def _save(self, ledger: Ledger) -> int:
        """Sync the recording, then save the position; returns it. A run that is closed saves nothing."""
        position, messages = await self.sync()
        if not self._closing:
            await ledger.set_position(self.liability.address, position, recorded=messages)
        return position

    async def _publish_regularly(self) -> None:
        _playing.set("")  # in this task: it is no handler, so its timer says nothing of one
        published = None
        while True:
            if self.position != published:
                published = self.position
                self._publish_position()
            await asyncio.sleep(JOB_PACE.publishing)

    def _publish_position(self) -> None:
        assert self.playback is not None, "a run without an objective only records"
        self._put(str(ProgressKey(self._agent, self.liability.address)), self.playback.encode(), JSON)

    async def _publish_messages(self) -> None:
        assert self._objective is not None, "a run without an objective only records"
        async for step in play(self._objective, speed=self.speed, start_index=self.position):
            message = step.message
            while self._recorder.is_behind:
                await asyncio.wrap_future(self._recorder.sync())
            if self._is_recorded(message.topic):
                self._recorder.record(message.topic, message.payload, message.type, role="objective")
            key, kind = str(ObjectiveTopicKey(self._agent, self.liability.address, message.topic)), message.type
            attachment = None
            if payload_type(kind.zenoh_encoding) != kind:  # the name alone does not say what it is
                attachment = self._definitions.attachment(b"", key, kind, time.monotonic()) or None
            self._put(key, message.payload, kind, attachment)
            await self._queue.put(message)
        await self._queue.put(None)

    async def _handle_all(self, handle: Handle | None) -> None:
        while (message := await self._queue.get()) is not None and not self._closing:
            if handle is not None:
                self.playing = message
                await self._handle_one(handle, message)
            self.position += 1

    def _wait_for_devices(self) -> bool:
        """Return when the devices that are present are idle; False if none is present."""
        with contextlib.suppress(zenoh.ZError):
            present = device_selector(self._agent, topic=PRESENT)
            if not present_keys(self._session, present, timeout=JOB_PACE.presence):
                return False
            idle = device_selector(self._agent, topic=IDLE)
            target, consolidation = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.NONE
            for _ in self._session.get(idle, target=target, consolidation=consolidation, timeout=JOB_PACE.idle):
                """Each device answers when it is idle."""
        return True

    def _receive(self, sample: zenoh.Sample) -> None:
        """Zenoh's callback: record a message on the job's topics, or take the run's own marker."""
        encoding = str(sample.encoding)
        if encoding == FLUSH and (flushed := self._markers.pop(sample.payload.to_bytes(), None)) is not None:
            flushed.set()
            return
        try:
            key = parse_agent_key(str(sample.key_expr))
            if isinstance(key, LiabilityTopicKey):
                self._heard_at = time.monotonic()
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
        if attachment is None or kind.schema_data or len(self._types) >= 4096:
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


class JobRecordings:
    """The recordings of unfinished jobs, in `folder`. Those of `topics` (None: of all) are recorded."""

    def __init__(self, folder: Path, agent: str, topics: frozenset[str] | None = None) -> None:
        self._folder = folder
        self._agent = agent
        self._topics = topics
        self.recorders = Recorders()

    async def open(self, liability: Liability) -> Recorder:
        """An open recorder, which continues the recording of an interrupted run.

        It is closed if this is cancelled meanwhile: the thread that opens it can't be stopped.
        """
        opening = asyncio.ensure_future(asyncio.to_thread(self._open, liability))
        try:
            return await asyncio.shield(opening)
        except asyncio.CancelledError:
            await asyncio.wait([opening])
            if opening.exception() is None:
                await asyncio.to_thread(opening.result().close)
            raise

    def _open(self, liability: Liability) -> Recorder:
        finished, unfinished, _ = self._files(liability.address)
        if finished.exists():  # it was closed, but a crash came before the Result was in the ledger
            finished.replace(unfinished)
        about = RecordingAbout(
            liability=liability.address,
            agent=self._agent,
            lighthouse=liability.lighthouse,
            objective=liability.objective,
            software=f"aira-mesh {mesh.__version__}",
            topics=",".join(sorted(self._topics or ())),
        )
        return self.recorders.open(finished, about)

    def to_bag(self, address: str, recording: Path) -> Path:
        """A finished recording as a bag of the legacy network: a job's topics are below `/liability/eth_ADDRESS`.

        It exists until `discard`. Blocks on the disk. Raises as `convert` does.
        """
        folder = self._folder / f"{address}.bag"
        shutil.rmtree(folder, ignore_errors=True)  # of a run that was killed here
        make_private_folder(folder)

        def rename(topic: str) -> str:
            return topic if topic == NOTE_TOPIC else legacy_topic(address, topic)

        return convert(recording, folder / "result.bag", to="bag", rename=rename).path

    def addresses(self) -> set[str]:
        """The addresses of the liabilities that have a recording here. Blocks on the disk."""
        return {path.name.partition(".")[0] for path in self._folder.glob("*.mcap*")}

    def discard(self, address: str, *, sync: bool = False) -> None:
        """Delete what an earlier run of the liability at `address` has recorded. Blocks on the disk.

        Without `sync`, a power loss may bring it back.
        """
        shutil.rmtree(self._folder / f"{address}.bag", ignore_errors=True)
        for leftover in self._files(address):
            leftover.unlink(missing_ok=True)
        if sync and self._folder.exists():
            sync_directory(self._folder)

    def _files(self, address: str) -> tuple[Path, Path, Path]:
        """The recording when it is finished, while it is written, and while an interrupted one is continued."""
        finished = self._folder / f"{address}.mcap"
        return finished, finished.with_name(f"{finished.name}.part"), finished.with_name(f"{finished.name}.cut")


_playing: ContextVar[str] = ContextVar("playing", default="")
"""The job whose playback, or handler, is the running code."""


def job_of_handler() -> str:
    """The job (address) whose playback, or handler, is the running code; empty outside of one."""
    return _playing.get()


class Executor:
    """Does the jobs of one agent: `run` in a task, `prepare` each new job.

    With `handlers` a ready job starts and finishes by itself, in the order of arrival; without, it waits for `start`
    and `finish`. `on_phase` is called when a job has moved to a phase.
    """

    def __init__(
        self,
        parts: AgentComponents,
        *,
        objectives: Objectives,
        handlers: TopicHandlers | None,
        on_phase: OnPhase,
        on_stop: Sequence[StopHandler] = (),
        is_paid_when_stopped: bool = False,
        parallel: int = 1,
    ) -> None:
        self.parallel = parallel
        self._ledger, self._outbox, self._store, self._signer = parts.ledger, parts.outbox, parts.store, parts.signer
        self._session = parts.network.session
        self._chain, self._head, self._outages = parts.chain, parts.chain_head, parts.outages
        self._objectives = objectives
        self._handlers = handlers
        self._on_phase = on_phase
        self._on_stop = on_stop
        self._is_paid_when_stopped = is_paid_when_stopped
        self._holds_when_stopped = parts.settings.hold_when_stopped
        self.hold = Hold(stop_folder(parts.settings), parts.signer.address)
        """While it is held, no job begins."""
        self._speed = AT_ONCE if parts.settings.playback == "at-once" else 1.0
        names = (name.strip() for name in parts.settings.recording_topics.split(","))
        self._recorded = frozenset(name for name in names if name) or None
        self._bag_results = parts.settings.bag_results
        if self._bag_results:
            with needs_extra("ros", "bag_results"):
                import rosbags.rosbag1  # noqa: F401
        self.recordings = JobRecordings(parts.recordings, parts.signer.address, self._recorded)
        self.preparing: Final[dict[str, asyncio.Task[None]]] = {}
        """The tasks that fetch and check objectives, by the address of the job."""
        self.runs: Final[dict[str, JobRun]] = {}
        """The open runs, by the address of the job."""
        self.at_hand: Final[set[str]] = set()
        """The jobs whose work is not done, by address: those that are fetched, wait, or run."""
        self.created_in: Final[dict[str, int]] = {}
        """The blocks with the contracts of the jobs that are not ready yet."""
        self._playing: dict[str, asyncio.Task[None]] = {}
        """The tasks that play them."""
        self._stopping: dict[str, asyncio.Event] = {}
        """The jobs that were stopped and have not ended; no other job begins meanwhile."""
        self._fetched: dict[str, Objective] = {}
        self._ready: asyncio.Queue[str] = asyncio.Queue()
        self._tasks: asyncio.TaskGroup | None = None
        self._opened = asyncio.Event()
        self._changing = asyncio.Lock()

    async def run(self) -> None:
        """Continue the jobs of the ledger, then serve new ones, until cancelled. A running job can be resumed later."""
        unfinished = await self._ledger.jobs(TO_BE_DONE)
        await self._release_ended()
        try:
            async with asyncio.TaskGroup() as self._tasks:
                for job in unfinished:
                    if await self._ledger.stopped(job.liability.address) is not None:
                        self._stopping[job.liability.address] = asyncio.Event()
                    self.prepare(job.liability)
                self._opened.set()
                for number in range(1, self.parallel):
                    self._tasks.create_task(self._serve(), name=f"jobs {number}")
                await self._serve()
        finally:
            self._tasks = None
            for address in tuple(self.runs):
                with liability_context(address):
                    try:
                        await self._suspend(address)
                    except AiraError as error:
                        facts = log_event("position-not-saved", code=error.code)
                        log.error("can't save the job's position: %s", error, extra=facts)

    @property
    def is_running(self) -> bool:
        """Whether `run` serves."""
        return self._tasks is not None

    async def wait_until_open(self) -> None:
        """Return when `run` has taken up the jobs of the ledger."""
        await self._opened.wait()

    def prepare(self, liability: Liability, *, created: int | None = None) -> None:
        """Fetch and check a job's objective in a task. Then the job is ready, or complete without success.

        It is ready when the block in which its contract was `created` counts, by default the last that was handled.
        """
        address = liability.address
        self.created_in[address] = self._head.head if created is None else created
        self.at_hand.add(address)
        task = self._task_group().create_task(self._fetch(liability), name=f"prepare {address}")
        _keep_task(self.preparing, address, task)

    @asynccontextmanager
    async def halted(self, address: str) -> AsyncIterator[JobRecord | None]:
        """Stop a job, and let nothing change it meanwhile. Yields its record, None for a liability without a job.

        Its files are kept, and released afterwards if the job is gone or has ended.
        """
        async with self._changing:
            job = await self._ledger.job(address)
            if job is not None:
                await self._suspend(address)
                self._fetched.pop(address, None)
            self.at_hand.discard(address)
            yield job
            if job is not None:
                await self._release(address)

    async def owe_result(self, address: str, *, success: bool, result: str, note: str, is_pinned: bool = False) -> None:
        """Complete a job in the ledger, together with its signed Result, which is sent until the chain has it."""
        if not is_pinned:  # it was released if a reorganisation reverted the job
            await asyncio.to_thread(self._store.pin, result, address)
        signed = self._signer.sign(Result(liability=address, result=result, success=success))
        await self._ledger.complete(address, success=success, result=result, note=note, outgoing=Outgoing.of(signed))

    @with_liability_context
    async def start(self, address: str) -> None:
        """Play the objective of a ready job. Returns when the playback has begun. Raises `WrongPhase`."""
        await self._wait_until_prepared(address)
        async with self._changing:
            await self._begin(await self._startable(address, asked="start", phases=(Phase.READY,)))

    @with_liability_context
    async def restart(self, address: str) -> None:
        """Play the objective of a running or ready job from its first message, with a new recording."""
        await self._wait_until_prepared(address)
        async with self._changing:
            job = await self._startable(address, asked="restart")
            await self._suspend(address)
            # In this order: after a crash in between, the position must not be past what the recording holds.
            await self._ledger.set_position(address, 0, recorded=0)
            await asyncio.to_thread(self.recordings.discard, address, sync=True)
            await self._begin(replace(job, position=0, recorded=0))

    @with_liability_context
    async def resume(self, address: str) -> None:
        """Continue an interrupted job at the position in the ledger, and its recording."""
        await self._wait_until_prepared(address)
        async with self._changing:
            job = await self._startable(address, asked="resume")
            if address in self.runs:
                raise WrongPhase(address, asked="resume", phase=job.phase)
            await self._begin(job)

    @with_liability_context
    async def stop(self, address: str, *, why: str, by: str, code: str = "") -> tuple[DeviceStop, ...]:
        """Stop a job for good, also after a restart, and return what its devices say: each has heard it, or why not.

        `by` is the account that asks, which the caller has checked. The devices hear it first, then the handlers are
        cancelled. After that the handlers of `on_stop` bring the robot to a safe state, and the job ends with the code
        `stopped`, or `robot-stopped` if not the customer asks: this does not wait for it. With another `code` the robot
        hands the job back: it is not held. To stop a job again tells the devices again. Raises `WrongPhase` for a job
        that has ended otherwise.
        """
        telling = self._halt(address, why)  # before anything that takes its time
        await self.wait_until_open()
        async with self._changing:
            asked = "hand back" if code else "stop"
            job, stopped = await self._job(address, asked=asked), await self._ledger.stopped(address)
            if stopped is None:
                if job.phase not in TO_BE_DONE:
                    raise WrongPhase(address, asked=asked, phase=job.phase)
                whose = STOPPED if by == job.liability.promisee else ROBOT_STOPPED
                await self._ledger.stop(address, Stop(why, code or whose))
                if self._holds_when_stopped and not code:
                    await asyncio.to_thread(self.hold.hold, why)
                self._fetched.pop(address, None)
                if (preparing := self.preparing.get(address)) is not None:
                    preparing.cancel()
                telling = telling or self._halt(address, why)  # it has just begun
                self._task_group().create_task(self._end_stopped(address), name=f"stop {address}")
        devices = () if telling is None else await telling
        if stopped is not None and telling is None:  # nothing heard it that had not heard it
            return devices
        unheard = ", ".join(f"{one.device}: {one.detail}" for one in devices if not one.heard)
        facts = log_event("job-stopped", by=by, unheard=unheard)
        log.warning("stopped by %s: %s%s", by, why, f"; not heard by {unheard}" if unheard else "", extra=facts)
        return devices

    async def hand_back(self, address: str, *, code: str, why: str) -> tuple[DeviceStop, ...]:
        """Stop a job that the robot can't do, with a `code` of its own. As `stop`.

        A handler of the job that calls it is cancelled here, and the job is stopped all the same.
        """
        context = copy_context()
        context.run(_playing.set, "")
        stopping = self.stop(address, why=why, by=self._signer.address, code=code)
        return await asyncio.shield(asyncio.create_task(stopping, name=f"hand back {address}", context=context))

    def _halt(self, address: str, why: str) -> asyncio.Future[tuple[DeviceStop, ...]] | None:
        """Begin to tell the devices of a job that has begun to stop, and cancel its playback; None if it has not."""
        if (run := self.runs.get(address)) is None:
            return None
        run.stopped = True
        self._stopping.setdefault(address, asyncio.Event())
        if (playing := self._playing.get(address)) is not None:
            playing.cancel()
        telling = partial(stop_devices, self._session, self._signer.address, why)
        return asyncio.wrap_future(in_daemon_thread(telling, f"stop {address}"))

    @with_liability_context
    async def _end_stopped(self, address: str) -> None:
        """Bring the robot of a stopped job that had begun to a safe state, and end the job."""
        ended = self._stopping.setdefault(address, asyncio.Event())
        try:
            if (playing := self._playing.get(address)) is not None:
                await asyncio.wait([playing], timeout=JOB_STOP_PACE.leaving)
            job, stop = await self._ledger.job(address), await self._ledger.stopped(address)
            assert stop is not None, "only stopped jobs end like this"
            if job is not None and job.phase is Phase.RUNNING:
                await self._make_safe(job, stop.why)
            await self._unless_ended(self.finish(address, success=False))
        finally:
            self._stopping.pop(address, None)
            ended.set()

    async def _make_safe(self, job: JobRecord, why: str) -> None:
        """Call the handlers of `on_stop` while what the devices say is still recorded."""
        address = job.liability.address
        async with self._changing:
            if (run := self.runs.get(address)) is None:  # the agent was restarted since
                run = self.runs[address] = await self.create_run(job)
                run.open()
                telling = self._halt(address, why)
                assert telling is not None
                await telling
        STOPPING.set(address)
        seconds = JOB_STOP_PACE.safe
        for handler in self._on_stop:
            try:
                async with asyncio.timeout(seconds):
                    await call(handler, run, why)
            except TimeoutError:
                facts = log_event("stop-handler-late", seconds=seconds)
                log.error("a handler of on_stop took more than %g s", seconds, extra=facts)
        STOPPING.set("")

    async def read(self, address: str) -> Liability:
        """The record of a job's liability as the ledger has it. Raises `WrongPhase` for a liability without a job."""
        job = await self._job(address, asked="read")
        ended = {"is_success": bool(job.success), "is_finalized": job.phase is Phase.FINALIZED}
        return replace(job.liability, result=job.result or job.liability.result, **ended)

    @with_liability_context
    async def finish(self, address: str, *, success: bool, note: str = "") -> str:
        """End a job: close the recording, put it in the store, sign and send the Result. Returns the result's CID.

        With success it first waits until devices have answered their commands (`JobRun.settle`). `note` says why the
        job failed, in the recording and the ledger. A job whose recording lacks what was played ends without
        success. That of a job that its customer stopped is what the model's description says. Raises `WrongPhase` if
        the job has ended already.
        """
        if success and (run := self.runs.get(address)) is not None:
            await run.settle()
        async with self._changing:
            job = await self._job(address, asked="finish")
            advance(address, job.phase, Phase.COMPLETE)
            if (stop := await self._ledger.stopped(address)) is not None:
                is_customers = stop.code == STOPPED  # who stops its own work is not paid for it
                success = self._is_paid_when_stopped and is_customers and job.phase is Phase.RUNNING
                note = note_of_stop(stop)
            ended = await self._stop(address) or await self.create_run(job)
            summary = await ended.close(note, sync=False)  # its copy in the store is synced
            if success and (missing := ended.missing + summary.lost_played):
                success, note = False, note_of(incomplete(address, missing))
                log.error("%s", note, extra=log_event("recording-incomplete", missing=missing))
            cid = recording = await asyncio.to_thread(self._store.put_file, summary.path, pin=address)
            if self._bag_results:
                cid = await asyncio.to_thread(self._put_bag, job.liability, summary.path) or recording
            await self.owe_result(address, success=success, result=cid, note=note, is_pinned=True)
            await asyncio.to_thread(self.recordings.discard, address)
            self._fetched.pop(address, None)
            self.at_hand.discard(address)
        facts = log_event("job-finished", success=success, result=cid, recording=recording, messages=summary.messages)
        log.info("complete, success %s, result %s, %d messages", success, cid, summary.messages, extra=facts)
        await self._on_phase(Phase.COMPLETE, replace(job.liability, result=cid, is_success=success))
        await self._outbox.send_new()
        return cid

    def _put_bag(self, liability: Liability, recording: Path) -> str:
        """Put the recording of a job into the store as a bag, if its objective is one, with the names of the legacy
        network. Returns the bag's CID; empty if there is none. Blocks on the disk.
        """
        address = liability.address
        try:
            objective = self._store.path(liability.objective)
            if objective is None or not is_bag(objective):
                return ""
            return self._store.put_file(self.recordings.to_bag(address, recording), pin=address)
        except InputError as error:
            facts = log_event("result-not-a-bag", code=error.code)
            log.warning("the result is not a bag, but the recording itself: %s", error, extra=facts)
            return ""

    @with_liability_context
    async def _fetch(self, liability: Liability) -> None:
        """Fetch and check the objective of a job: then it is ready, or complete without success."""
        address = liability.address
        if await self._ledger.stopped(address) is not None:  # before a restart
            await self._end_stopped(address)
            return
        try:
            await asyncio.to_thread(self._store.pin, liability.objective, address, sync=False)
            objective = await self._objectives.examine(liability.objective)
        except (ContentError, InputError) as error:
            self.created_in.pop(address, None)
            log.warning("the objective is refused: %s", error, extra=log_event("objective-refused", code=error.code))
            await self._unless_ended(self.finish(address, success=False, note=note_of(error)))
            return
        await self._until_counted(address)
        async with self._changing:
            job = await self._ledger.job(address)
            if job is None or job.phase not in TO_BE_DONE or await self._ledger.stopped(address) is not None:
                return
            if job.phase is Phase.INCOMING:
                await self._ledger.set_phase(address, Phase.READY)
            self._fetched[address] = objective
        if job.phase is Phase.INCOMING:
            log.info("ready, %d messages to play", objective.count, extra=log_event("job-ready", count=objective.count))
            await self._on_phase(Phase.READY, liability)
        self._ready.put_nowait(address)

    async def _until_counted(self, address: str) -> None:
        """Return when the block with the contract of a job counts; one that was ready has counted before."""
        job, is_told = await self._ledger.job(address), False
        while job is not None and job.phase is Phase.INCOMING:
            block = self.created_in[address]
            if self._head.head < block:  # its events are handled at this moment
                await self._head.reached(block)
            counted = partial(self._chain.node.counted, self._head.head)
            if await self._chain.retrying(counted, outages=self._outages) >= block:
                break
            if not is_told:
                is_told = True
                facts = log_event("job-waits", block=block)
                log.info("the job waits until its contract in block %d counts", block, extra=facts)
            await asyncio.sleep(self._chain.node.timing.poll_interval)
            job = await self._ledger.job(address)
        self.created_in.pop(address, None)

    async def _serve(self) -> None:
        """Do ready jobs, one after the other. Without handlers, others start them."""
        while True:
            address = await self._ready.get()
            await self._until_allowed()
            if self._handlers is not None:
                with liability_context(address):
                    await self._unless_ended(self._resume_to_end(address))

    async def _resume_to_end(self, address: str) -> None:
        """Resume a job and wait for its end. It may be restarted in between."""
        await self.resume(address)
        while True:
            async with self._changing:
                playback = self._playing.get(address)
            if playback is None:
                return
            await asyncio.wait([playback])

    async def _until_allowed(self) -> None:
        """Return when no stopped job is being ended, and nothing holds the agent."""
        while self._stopping or self.hold.is_held:
            for ended in tuple(self._stopping.values()):
                await ended.wait()
            if self.hold.is_held:
                await asyncio.sleep(0.5)

    async def create_run(self, job: JobRecord, objective: Objective | None = None) -> JobRun:
        """A run of `objective` from the job's position; without an objective, one that only records.

        It continues the recording of an interrupted run of the same job.
        """
        return JobRun(
            self._session,
            self._signer.address,
            job,
            await self.recordings.open(job.liability),
            objective=objective,
            speed=self._speed,
            recorded=self._recorded,
        )

    async def _begin(self, job: JobRecord) -> None:
        """Open a run of a job, write to the ledger that it is running, and play it in a task."""
        address, position, tasks = job.liability.address, job.position, self._task_group()
        objective = self._fetched[address]
        facts = log_event("job-started", position=position, count=objective.count)
        log.info("running, from message %d of %d", position, objective.count, extra=facts)
        run = self.runs[address] = await self.create_run(job, objective)
        await self._ledger.set_phase(address, Phase.RUNNING, position=position)
        run.open()
        if run.stopped:  # meanwhile
            return
        context = copy_context()
        context.run(_playing.set, address)
        task = tasks.create_task(self._run_job(run), name=f"play {address}", context=context)
        _keep_task(self._playing, address, task)

    async def _stop(self, address: str) -> JobRun | None:
        """Cancel the playback of a job and wait for its end, unless it is the caller. Returns its run, still open."""
        if _playing.get() != address and (task := self._playing.pop(address, None)) is not None:
            task.cancel()
            if (run := self.runs.get(address)) is None or not run.stopped:  # a stopped one's handlers had their time
                await asyncio.wait([task])
        return self.runs.pop(address, None)

    async def _suspend(self, address: str) -> None:
        """Stop the run of a job so that another run can continue it."""
        if (run := await self._stop(address)) is not None:
            await run.suspend(self._ledger)

    async def _run_job(self, run: JobRun) -> None:
        """Play a run. With handlers, or when it fails, the job then finishes; else the run stays open."""
        address, success, note = run.liability.address, True, ""
        try:
            await self._on_phase(Phase.RUNNING, run.liability)
            await run.play_and_save(None if self._handlers is None else self._handlers.handle, self._ledger)
        except (LedgerUnusable, RecordingFailed):  # the job continues when the disk is usable
            raise
        except Exception as error:
            success, note = False, note_of(error)
            facts = log_event("job-failed", code=getattr(error, "code", ""))
            log.warning("the job failed: %s", note, exc_info=not isinstance(error, AiraError), extra=facts)
        if self._handlers is not None or not success:
            await self._unless_ended(self.finish(address, success=success, note=note))

    async def _release(self, address: str) -> None:
        """Delete what a job that has ended has recorded here; let the store evict its files if it is paid, or gone."""
        job = await self._ledger.job(address)
        if job is not None and job.phase not in TO_BE_DONE:
            await asyncio.to_thread(self.recordings.discard, address)
        if job is None or job.phase is Phase.FINALIZED:
            await asyncio.to_thread(self._store.release, address)

    async def _release_ended(self) -> None:
        """The same for all jobs: a crash may have come between their end and `_release`."""
        pins = await asyncio.to_thread(self._store.pins)
        recorded = await asyncio.to_thread(self.recordings.addresses)
        for label in recorded.union(*pins.values()):
            with contextlib.suppress(InvalidAddress):  # it is not of a job: somebody has pinned a file
                await self._release(parse_address(label))

    async def _job(self, address: str, *, asked: str) -> JobRecord:
        job = await self._ledger.job(address)
        if job is None:
            raise WrongPhase(address, asked=asked, phase=None)
        return job

    async def _startable(self, address: str, *, asked: str, phases: tuple[Phase, ...] = STARTABLE) -> JobRecord:
        job = await self._job(address, asked=asked)
        if job.phase not in phases or address not in self._fetched:
            raise WrongPhase(address, asked=asked, phase=job.phase)
        return job

    async def _wait_until_prepared(self, address: str) -> None:
        """Wait until the objective of a startable job is there: after a restart it is checked again first."""
        await self.wait_until_open()
        job, preparing = await self._ledger.job(address), self.preparing.get(address)
        if job is not None and job.phase in STARTABLE and address not in self._fetched and preparing is not None:
            await asyncio.wait([preparing])

    def _task_group(self) -> asyncio.TaskGroup:
        if self._tasks is None:
            raise ClosedError("the executor is not running")
        return self._tasks

    async def _unless_ended(self, ending: Awaitable[object]) -> None:
        """Await `ending`; if something else has ended the job meanwhile, only log it."""
        try:
            await ending
        except WrongPhase as error:
            log.info("%s", error, extra=log_event("job-ended-already", phase=error.phase))


def _keep_task(tasks: dict[str, asyncio.Task[None]], address: str, task: asyncio.Task[None]) -> None:
    """Keep a task among those of jobs until it has ended."""

    def drop(ended: asyncio.Task[None]) -> None:
        if tasks.get(address) is ended:
            del tasks[address]

    tasks[address] = task
    task.add_done_callback(drop)
