"""The executor: from a liability that names us to a signed Result, through every phase, one job at a time.

Objectives of several jobs are fetched and examined at once; a bad or missing one fails its own job (which refunds the
promisee) and never holds up the others. What is done is in the ledger before anybody is told.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Final

import msgspec

from mesh.errors import ClosedError, ContentError, InputError
from mesh.telemetry.context import liability_context, with_liability_context
from mesh.work.lifecycle import Phase, WrongPhase, advance
from mesh.work.objectives import Objectives
from mesh.work.playbacks import Playbacks

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable

    from mesh.recording import Objective
    from mesh.work.job import TopicHandler
    from mesh.work.ledger import JobRecord
    from mesh.work.lifecycle import PhaseListener
    from mesh.work.workshop import Workshop
    from schemas import Liability

log = logging.getLogger(__name__)

STARTED: Final = (Phase.READY, Phase.RUNNING)
"""Phases in which a job may be begun anew or gone on with."""
PATIENCE: Final = 10.0
"""Seconds without a new block of an objective after which no job is taken on for it."""


class Executor:
    """Does the jobs of one agent: `run` in a task, `prepare` each new one.

    With a `performer` a ready job starts and finishes by itself, in the order of arrival; without one it waits for
    `start` and `finish`.
    """

    def __init__(self, workshop: Workshop, *, performer: TopicHandler | None, witness: PhaseListener) -> None:
        self._shop = workshop
        self._performer = performer
        self._witness = witness
        self._objectives = Objectives(workshop, performer=performer)
        self._ready: asyncio.Queue[str] = asyncio.Queue()
        self._playbacks = Playbacks(workshop, performer=performer, witness=witness, finish=self._end)
        self._tasks: asyncio.TaskGroup | None = None
        self._opened = asyncio.Event()
        self._changing = asyncio.Lock()

    async def run(self) -> None:
        """Go on with what the ledger holds, then serve; ends by cancellation. A running job is left to be resumed."""
        left = await self._shop.ledger.jobs((Phase.INCOMING, Phase.READY, Phase.RUNNING))
        await self._shop.unpin_ended()
        try:
            async with asyncio.TaskGroup() as self._tasks:
                for job in left:
                    self.prepare(job.liability)
                self._opened.set()
                await self._serve_ready()
        finally:
            self._tasks = None
            await self._playbacks.suspend()

    @property
    def is_running(self) -> bool:
        """Whether `run` serves."""
        return self._tasks is not None

    async def opened(self) -> None:
        """Return when `run` has taken up what the ledger holds."""
        await self._opened.wait()

    async def examine(self, cid: str) -> Objective:
        """The objective of that CID, fetched and found fit to be played. Raises `UnfitObjective`, a `ContentError`."""
        return await self._objectives.examine(cid, patience=PATIENCE)

    def prepare(self, liability: Liability) -> None:
        """Fetch and examine a job's objective in a task; then it is ready, or complete without success."""
        self._objectives.prepare(liability.address, self._prepare(liability), self._begun())

    @asynccontextmanager
    async def halted(self, address: str) -> AsyncIterator[JobRecord | None]:
        """Stop whatever runs for a job, keeping its files, and let nothing change meanwhile; gives it if it is ours."""
        async with self._changing:
            job = await self._shop.ledger.job(address)
            if job is not None:
                await self._playbacks.abandon(address)
                self._objectives.forget(address)
            yield job
            if job is not None:
                await self._shop.unpin(address)

    @with_liability_context
    async def start(self, address: str) -> None:
        """Play the objective of a ready job. Returns when the playback has begun. Raises `WrongPhase`."""
        await self._objective_at_hand(address)
        async with self._changing:
            job = await self._startable(address, asked="start")
            if job.phase is not Phase.READY:
                raise WrongPhase(address, asked="start", phase=job.phase)
            await self._begin(job, 0)

    @with_liability_context
    async def restart(self, address: str) -> None:
        """Begin a running or ready job anew: a fresh recording, the objective from its first message."""
        await self._objective_at_hand(address)
        async with self._changing:
            job = await self._startable(address, asked="restart")
            await self._playbacks.abandon(address)
            # In this order: a crash between the two may not leave a position past what the recording holds.
            await self._shop.ledger.set_position(address, 0)
            await asyncio.to_thread(self._shop.discard_recording, address)
            await self._begin(job, 0)

    @with_liability_context
    async def resume(self, address: str) -> None:
        """Go on with an interrupted job at the position in the ledger, adding to its recording."""
        await self._objective_at_hand(address)
        async with self._changing:
            job = await self._startable(address, asked="resume")
            if address in self._playbacks:
                raise WrongPhase(address, asked="resume", phase=job.phase)
            await self._begin(job, job.position)

    async def read(self, address: str) -> Liability:
        """The Liability record of a job, as the ledger has it. Raises `WrongPhase` for what is no job of ours."""
        job = await self._job(address, asked="read")
        return msgspec.structs.replace(
            job.liability,
            result=job.result or job.liability.result,
            is_success=bool(job.success),
            is_finalized=job.phase is Phase.FINALIZED,
        )

    @with_liability_context
    async def finish(self, address: str, *, success: bool, note: str = "") -> str:
        """End a job: close the recording, keep it under its CID, sign and send the Result. Returns the CID.

        `note` says why it failed, for the recording and the ledger. A job that never started ends with a recording
        that holds no more than the note. Raises `WrongPhase` when it has ended already.
        """
        async with self._changing:
            job = await self._job(address, asked="finish")
            advance(address, job.phase, Phase.COMPLETE)
            run = await self._playbacks.stop(address) or await self._shop.new_run(job.liability)
            summary = await run.close(note)
            cid = await asyncio.to_thread(self._shop.store.put_file, summary.path, pin=address)
            await self._shop.owe_result(address, success=success, result=cid, note=note)
            await asyncio.to_thread(summary.path.unlink, missing_ok=True)
            self._objectives.forget(address)
        log.info("complete, success %s, result %s, %d messages", success, cid, summary.messages)
        await self._witness(Phase.COMPLETE, msgspec.structs.replace(job.liability, result=cid, is_success=success))
        await self._shop.outbox.send()
        return cid

    async def _job(self, address: str, *, asked: str) -> JobRecord:
        job = await self._shop.ledger.job(address)
        if job is None:
            raise WrongPhase(address, asked=asked, phase=None)
        return job

    async def _startable(self, address: str, *, asked: str) -> JobRecord:
        job = await self._job(address, asked=asked)
        if job.phase not in STARTED or address not in self._objectives:
            raise WrongPhase(address, asked=asked, phase=job.phase)
        return job

    async def _objective_at_hand(self, address: str) -> None:
        """After a restart of the agent, a job that is ready is so before its objective has been examined again."""
        await self.opened()
        job = await self._shop.ledger.job(address)
        if job is not None and job.phase in STARTED:
            await self._objectives.wait(address)

    @with_liability_context
    async def _prepare(self, liability: Liability) -> None:
        address = liability.address
        try:
            await self._shop.pin(liability.objective, address)
            objective = await self._objectives.examine(liability.objective)
        except (ContentError, InputError) as error:
            log.warning("refused: %s", error)
            await self._end(address, success=False, note=str(error))
            return
        async with self._changing:
            job = await self._shop.ledger.job(address)
            if job is None or job.phase not in (Phase.INCOMING, *STARTED):
                return
            if job.phase is Phase.INCOMING:
                await self._shop.ledger.set_phase(address, Phase.READY)
            self._objectives.keep(address, objective)
        if job.phase is Phase.INCOMING:
            log.info("ready, %d messages to play", objective.count)
            await self._witness(Phase.READY, liability)
        self._ready.put_nowait(address)

    async def _serve_ready(self) -> None:
        while True:
            address = await self._ready.get()
            if self._performer is not None:
                with liability_context(address):
                    await self._unless_ended(self._serve(address))

    async def _serve(self, address: str) -> None:
        """Start or resume a job whose code is ours, and wait for its end; it may be restarted in between."""
        await self.resume(address)
        while (playing := await self._play_of(address)) is not None:
            await asyncio.wait([playing])

    async def _play_of(self, address: str) -> asyncio.Task[None] | None:
        async with self._changing:
            return self._playbacks.under_way(address)

    async def _begin(self, job: JobRecord, position: int) -> None:
        objective = self._objectives[job.liability.address]
        await self._playbacks.begin(job, objective, self._begun(), position=position)

    async def _end(self, address: str, *, success: bool, note: str) -> None:
        """Finish a job, unless somebody else has done so."""
        await self._unless_ended(self.finish(address, success=success, note=note))

    def _begun(self) -> asyncio.TaskGroup:
        if self._tasks is None:
            raise ClosedError("the executor is not running")
        return self._tasks

    async def _unless_ended(self, ending: Awaitable[object]) -> None:
        """Wait for `ending`; that somebody else ended the job meanwhile is no error."""
        try:
            await ending
        except WrongPhase as error:
            log.info("%s", error)
