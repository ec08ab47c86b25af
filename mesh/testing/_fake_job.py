"""A job for an agent's handlers alone: no router, no chain, no waiting."""

from __future__ import annotations

import asyncio
import inspect
import logging
import tempfile
from contextlib import suppress
from contextvars import copy_context
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mesh.agent.agent import require_fit
from mesh.agent.handlers import Job
from mesh.agent.jobs import note_of, reason_in
from mesh.agent.objectives import ObjectiveUnfit
from mesh.base.background import in_daemon_thread
from mesh.base.log_context import log_event
from mesh.errors import AiraError, InputError
from mesh.recording import Limits, pack_values, preflight
from mesh.recording.objective import Played
from mesh.role.models import description_in
from mesh.testing._clock import SimulatedTimeLoop
from mesh.testing._outcomes import CONTRACT, ROBOT, JobRecording, RecordedOutcome
from schemas import Liability, cid_of_file
from schemas.keys import LiabilityTopicKey, parse_agent_key

if TYPE_CHECKING:
    import zenoh

    from mesh.agent.agent import Agent, Messages
    from mesh.recording import Objective
    from schemas.model import ModelDescription
    from schemas.payloads import PayloadType

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FakeJob:
    """What somebody wants done: messages that are played one after the other, `FakeJob([("/lift", 1.5)])`, or a file.

    The messages are what `Agent.order` takes, the file is an MCAP file or a ROS 1 bag.
    """

    objective: Messages | Path


async def run(agent: Agent, job: FakeJob) -> RecordedOutcome:
    """Do a job with the handlers of an agent that is not running; returns how it ended and what was published.

    The objective is checked, and its messages are converted and handled, as in a real job. A handler's `JobFailed`, or
    any other exception, gives a failed outcome with its reason and code, and so does an objective that the handlers, or
    the description of the model in a file, do not accept (`objective-unfit`).

    The handlers run in an event loop of their own, in a thread, whose clock jumps to the next timer when nothing else
    can run: `asyncio.sleep(20)` and `asyncio.timeout(20)` take no time, and `outcome.seconds` says how long the job
    would take. Not simulated: `time.sleep` and other work in threads, which takes its time; `time.monotonic` and
    `time.time`; sockets; the times of messages in a file, which are played at once.

    `job.listen` gives what the handlers themselves publish; there are no devices, no other agents, and handlers of
    `on_demand`, `every` and `on_stop` are not called.

    Raises `InputError` for messages that can't be encoded and for a file that does not exist, `ModelUnfit` for handlers
    that don't fit the model's description, and `AiraError` (`handler-stuck`) if the handlers wait for what nothing here
    does. Cancelling cancels the handlers.
    """
    return await _Run(agent, job).outcome()


class _Run:
    """One run of a fake job."""

    def __init__(self, agent: Agent, job: FakeJob) -> None:
        self._agent = agent
        self._handlers = agent._handlers.topics
        self._job = job
        self._task: asyncio.Task[Any] | None = None
        self._loop: SimulatedTimeLoop | None = None

    async def outcome(self) -> RecordedOutcome:
        running = in_daemon_thread(self._run, "fake job")
        try:
            return await asyncio.wrap_future(running)
        except asyncio.CancelledError:
            if self._loop is not None and self._task is not None:
                with suppress(RuntimeError):  # it has ended
                    self._loop.call_soon_threadsafe(self._task.cancel)
            raise

    def _run(self) -> RecordedOutcome:
        with (
            tempfile.TemporaryDirectory(prefix="aira-fake-job-") as folder,
            asyncio.Runner(loop_factory=SimulatedTimeLoop) as runner,
        ):
            path = self._objective(Path(folder))
            return runner.run(self._play(path), context=copy_context())

    def _objective(self, folder: Path) -> Path:
        if not isinstance(self._job.objective, Path):
            path = folder / "objective.mcap"
            pack_values(self._job.objective, path)
            return path
        if not self._job.objective.is_file():
            raise InputError(f"there is no file {self._job.objective}", code="not-an-objective")
        return self._job.objective

    async def _play(self, path: Path) -> RecordedOutcome:
        """Check the objective and play it to the handlers."""
        loop, self._task = asyncio.get_running_loop(), asyncio.current_task()
        assert isinstance(loop, SimulatedTimeLoop)
        self._loop, failed = loop, ""
        model, run = self._description(), _FakeRun(_liability(self._agent.model, path))
        try:
            objective = self._examined(path, model)
            await self._handle_all(run, objective, loop)
        except Exception as error:
            failed = note_of(error)
            facts = log_event("job-failed", code=getattr(error, "code", ""))
            log.warning("the job failed: %s", failed, exc_info=not isinstance(error, AiraError), extra=facts)
        finally:
            run.end()
        reason = reason_in(failed)
        return RecordedOutcome(
            success=not failed,
            result="",
            reason=reason.text,
            code=reason.code,
            robot=ROBOT,
            contract=CONTRACT,
            recording=JobRecording(run.recorded),
            seconds=loop.time(),
        )

    def _description(self) -> ModelDescription | None:
        """The description in the file that is the agent's model. Raises `ModelUnfit` if the handlers don't fit it."""
        given = self._agent._given_model
        model = description_in(given) if isinstance(given, Path) else None
        if model is not None:
            require_fit(model, self._handlers)
        return model

    def _examined(self, path: Path, model: ModelDescription | None) -> Objective:
        """As before a real job. Raises `ObjectiveUnfit`."""
        topics, obstacle = self._handlers.topics, self._handlers.obstacle
        found = preflight(path, Limits.of(self._agent.settings), topics=topics, obstacle=obstacle, model=model)
        if found.objective is None or not found.ok:
            raise ObjectiveUnfit(cid_of_file(path), found.reason, found.detail)
        return found.objective

    async def _handle_all(self, run: _FakeRun, objective: Objective, loop: SimulatedTimeLoop) -> None:
        run.topics = frozenset(topic.name for topic in objective.topics)
        for message in objective.messages():
            run.playing = message
            run.record(message.topic, message.payload, message.type, "objective")
            handler = self._handlers.find(message.topic)
            is_async = handler is None or inspect.iscoroutinefunction(inspect.unwrap(handler.handler))
            if is_async:
                await run._handle_one(self._handlers.handle, message)
            else:
                with loop.outside():
                    await run._handle_one(self._handlers.handle, message)
            run.position += 1


class _FakeRun(Job):
    """The job as its handlers see it: what they publish is recorded in memory."""

    def __init__(self, liability: Liability) -> None:
        session: zenoh.Session = None  # type: ignore[assignment]  # `_put` does without
        super().__init__(session, ROBOT, liability)
        self._subscriber = self  # it is running
        self._loop = asyncio.get_running_loop()
        self.recorded: list[Played] = []

    def record(self, topic: str, payload: bytes, kind: PayloadType, role: str) -> None:
        """Add a message to the recording."""
        now = round(self._loop.time() * 1e9)
        self.recorded.append(Played(topic, payload, now, now, len(self.recorded), kind, role))

    def end(self) -> None:
        """The job has ended: nothing can be published any more."""
        self._subscriber = None
        self._end_listening()

    def _put(self, key: str, payload: bytes, kind: PayloadType, attachment: bytes | None = None) -> None:
        found = parse_agent_key(key)
        assert isinstance(found, LiabilityTopicKey)
        self.record(found.topic, payload, kind, "device")
        self._deliver(found.topic, payload, kind)


def _liability(model: str, objective: Path) -> Liability:
    """A contract that costs nothing, between addresses of nobody."""
    return Liability.of_nobody(address=CONTRACT, model=model, objective=cid_of_file(objective), promisor=ROBOT)
