"""The executor: takes the liabilities that name this agent as promisor through every phase, to a signed Result.

Objectives of several jobs are fetched at once; jobs run one at a time. A missing or bad objective fails its own job
only. The ledger has each change before anyone is notified.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from mesh.errors import AiraError, ClosedError, ContentError, InputError
from mesh.log_context import liability_context, log_event, with_liability_context
from mesh.recording import RecordingFailed
from mesh.work.database import LedgerUnusable
from mesh.work.notes import note_of
from mesh.work.outbox import outgoing
from mesh.work.phases import STARTABLE, TO_BE_DONE, Phase, WrongPhase, advance
from mesh.work.run import RecordingIncomplete
from schemas import Result

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from mesh.content import Store
    from mesh.recording import Objective
    from mesh.work.ledger import JobRecord, Ledger
    from mesh.work.objectives import Objectives
    from mesh.work.outbox import Outbox
    from mesh.work.playbacks import Playbacks
    from mesh.work.run import JobRun
    from mesh.work.topic_handlers import TopicHandlers
    from schemas import Liability, Signer

    OnPhase = Callable[[Phase, Liability], Awaitable[None]]

log = logging.getLogger(__name__)


class Executor:
    """Does the jobs of one agent: `run` in a task, `prepare` each new job.

    With `handlers` a ready job starts and finishes by itself, in the order of arrival; without, it waits for `start`
    and `finish`. `on_phase` is called when a job has moved to a phase.
    """

    def __init__(
        self,
        *,
        ledger: Ledger,
        outbox: Outbox,
        store: Store,
        signer: Signer,
        objectives: Objectives,
        playbacks: Playbacks,
        handlers: TopicHandlers | None,
        on_phase: OnPhase,
    ) -> None:
        self._ledger = ledger
        self._outbox = outbox
        self._store = store
        self._signer = signer
        self._objectives = objectives
        self._playbacks = playbacks
        self._handlers = handlers
        self._on_phase = on_phase
        self.preparing: Final[dict[str, asyncio.Task[None]]] = {}
        """The tasks that fetch and check objectives, by the address of the job."""
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
                    self.prepare(job.liability)
                self._opened.set()
                await self._serve()
        finally:
            self._tasks = None
            await self._playbacks.suspend_all()

    @property
    def is_running(self) -> bool:
        """Whether `run` serves."""
        return self._tasks is not None

    async def wait_until_open(self) -> None:
        """Return when `run` has taken up the jobs of the ledger."""
        await self._opened.wait()

    def prepare(self, liability: Liability) -> None:
        """Fetch and check a job's objective in a task. Then the job is ready, or complete without success."""
        address = liability.address
        task = self._task_group().create_task(self._fetch(liability), name=f"prepare {address}")
        self.preparing[address] = task
        task.add_done_callback(partial(self._drop_task, address))

    @asynccontextmanager
    async def halted(self, address: str) -> AsyncIterator[JobRecord | None]:
        """Stop a job, and let nothing change it meanwhile. Yields its record, None for a liability without a job.

        Its files are kept, and released afterwards if the job is gone or has ended.
        """
        async with self._changing:
            job = await self._ledger.job(address)
            if job is not None:
                await self._playbacks.suspend(address)
                self._fetched.pop(address, None)
            yield job
            if job is not None:
                await self._release(address)

    async def owe_result(self, address: str, *, success: bool, result: str, note: str, is_pinned: bool = False) -> None:
        """Complete a job in the ledger, together with its signed Result, which is sent until the chain has it."""
        if not is_pinned:  # it was released if a reorganisation reverted the job
            await asyncio.to_thread(self._store.pin, result, address)
        signed = self._signer.sign(Result(liability=address, result=result, success=success))
        await self._ledger.complete(address, success=success, result=result, note=note, outgoing=outgoing(signed))

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
            await self._playbacks.suspend(address)
            # In this order: after a crash in between, the position must not be past what the recording holds.
            await self._ledger.set_position(address, 0, recorded=0)
            await asyncio.to_thread(self._playbacks.discard_recording, address, sync=True)
            await self._begin(replace(job, position=0, recorded=0))

    @with_liability_context
    async def resume(self, address: str) -> None:
        """Continue an interrupted job at the position in the ledger, and its recording."""
        await self._wait_until_prepared(address)
        async with self._changing:
            job = await self._startable(address, asked="resume")
            if self._playbacks.run(address) is not None:
                raise WrongPhase(address, asked="resume", phase=job.phase)
            await self._begin(job)

    async def read(self, address: str) -> Liability:
        """The record of a job's liability as the ledger has it. Raises `WrongPhase` for a liability without a job."""
        job = await self._job(address, asked="read")
        ended = {"is_success": bool(job.success), "is_finalized": job.phase is Phase.FINALIZED}
        return replace(job.liability, result=job.result or job.liability.result, **ended)

    @with_liability_context
    async def finish(self, address: str, *, success: bool, note: str = "") -> str:
        """End a job: close the recording, put it in the store, sign and send the Result. Returns the recording's CID.

        `note` says why the job failed, in the recording and the ledger. A job whose recording lacks what was played
        ends without success. Raises `WrongPhase` if the job has ended already.
        """
        async with self._changing:
            job = await self._job(address, asked="finish")
            advance(address, job.phase, Phase.COMPLETE)
            run = await self._playbacks.stop(address) or await self._playbacks.create(job)
            summary = await run.close(note, sync=False)  # its copy in the store is synced
            if success and (missing := run.missing + summary.lost_played):
                success, note = False, note_of(RecordingIncomplete(address, missing))
                log.error("%s", note, extra=log_event("recording-incomplete", missing=missing))
            cid = await asyncio.to_thread(self._store.put_file, summary.path, pin=address)
            await self.owe_result(address, success=success, result=cid, note=note, is_pinned=True)
            await asyncio.to_thread(self._playbacks.discard_recording, address)
            self._fetched.pop(address, None)
        facts = log_event("job-finished", success=success, result=cid, messages=summary.messages)
        log.info("complete, success %s, result %s, %d messages", success, cid, summary.messages, extra=facts)
        await self._on_phase(Phase.COMPLETE, replace(job.liability, result=cid, is_success=success))
        await self._outbox.send_new()
        return cid

    @with_liability_context
    async def _fetch(self, liability: Liability) -> None:
        """Fetch and check the objective of a job: then it is ready, or complete without success."""
        address = liability.address
        try:
            await asyncio.to_thread(self._store.pin, liability.objective, address, sync=False)
            objective = await self._objectives.examine(liability.objective)
        except (ContentError, InputError) as error:
            log.warning("the objective is refused: %s", error, extra=log_event("objective-refused", code=error.code))
            await self._unless_ended(self.finish(address, success=False, note=note_of(error)))
            return
        async with self._changing:
            job = await self._ledger.job(address)
            if job is None or job.phase not in TO_BE_DONE:
                return
            if job.phase is Phase.INCOMING:
                await self._ledger.set_phase(address, Phase.READY)
            self._fetched[address] = objective
        if job.phase is Phase.INCOMING:
            log.info("ready, %d messages to play", objective.count, extra=log_event("job-ready", count=objective.count))
            await self._on_phase(Phase.READY, liability)
        self._ready.put_nowait(address)

    async def _serve(self) -> None:
        """Do ready jobs, one at a time. Without handlers, others start them."""
        while True:
            address = await self._ready.get()
            if self._handlers is not None:
                with liability_context(address):
                    await self._unless_ended(self._resume_to_end(address))

    async def _resume_to_end(self, address: str) -> None:
        """Resume a job and wait for its end. It may be restarted in between."""
        await self.resume(address)
        while True:
            async with self._changing:
                playback = self._playbacks.task(address)
            if playback is None:
                return
            await asyncio.wait([playback])

    async def _begin(self, job: JobRecord) -> None:
        objective = self._fetched[job.liability.address]
        await self._playbacks.begin(job, objective, play=self._run_job, tasks=self._task_group())

    async def _run_job(self, run: JobRun) -> None:
        """Play a run. With handlers, or when it fails, the job then finishes; else the run stays open."""
        address, success, note = run.liability.address, True, ""
        try:
            await self._on_phase(Phase.RUNNING, run.liability)
            await self._playbacks.play_and_save(run, None if self._handlers is None else self._handlers.handle)
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
            await asyncio.to_thread(self._playbacks.discard_recording, address)
        if job is None or job.phase is Phase.FINALIZED:
            await asyncio.to_thread(self._store.release, address)

    async def _release_ended(self) -> None:
        """The same for all jobs: a crash may have come between their end and `_release`."""
        pins, recorded = await asyncio.to_thread(self._store.pins), await asyncio.to_thread(self._playbacks.recorded)
        for label in (one for one in recorded.union(*pins.values()) if one.startswith("0x")):  # others are not of jobs
            await self._release(label)

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

    def _drop_task(self, address: str, task: asyncio.Task[None]) -> None:
        if self.preparing.get(address) is task:
            del self.preparing[address]

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
