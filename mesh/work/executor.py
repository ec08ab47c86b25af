"""The executor: from a liability that names us to a signed Result, through every phase, one job at a time.

Objectives of several jobs are fetched and examined at once; a bad or missing one fails its own job (which refunds the
promisee) and never holds up the others. What is done is in the ledger before anybody is told.
"""

from __future__ import annotations

import asyncio
import logging
import time
from contextvars import ContextVar
from typing import TYPE_CHECKING, Final, Protocol

import msgspec

from mesh.errors import AiraError, ClosedError, ContentError, InputError
from mesh.work.lifecycle import Phase, WrongPhase, advance
from mesh.work.outbox import outgoing, outgoing_identity
from schemas import Result

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from mesh.recording import Objective
    from mesh.work.ledger import Job
    from mesh.work.run import Performer, Run
    from mesh.work.workshop import Workshop
    from schemas import Liability

log = logging.getLogger(__name__)

FETCHES: Final = 4
"""Objectives fetched and examined at once."""
STARTED: Final = (Phase.READY, Phase.RUNNING)
"""Phases in which a job may be begun anew or gone on with."""
PROGRESS: Final = 0.5
"""Seconds between two notes of a playback's position in the ledger."""

_playing: ContextVar[str] = ContextVar("playing", default="")
"""The job that the running code plays, or is a handler of."""


class Witness(Protocol):
    """Whoever is told that a job has come into a phase (after the ledger knows)."""

    async def __call__(self, phase: Phase, liability: Liability) -> None: ...


class Executor:
    """Does the jobs of one agent: `run` in a task, `accept` each new liability.

    With a `performer` a ready job starts and finishes by itself, in the order of arrival; without one it waits for
    `start` and `finish`.
    """

    def __init__(self, workshop: Workshop, *, performer: Performer | None, witness: Witness) -> None:
        self._shop = workshop
        self._performer = performer
        self._topics = None if performer is None else performer.topics
        self._witness = witness
        self._fetching = asyncio.Semaphore(FETCHES)
        self._ready: asyncio.Queue[str] = asyncio.Queue()
        self._preparing: dict[str, asyncio.Task[None]] = {}
        self._objectives: dict[str, Objective] = {}
        self._runs: dict[str, Run] = {}
        self._plays: dict[str, asyncio.Task[None]] = {}
        self._tasks: asyncio.TaskGroup | None = None
        self._opened = asyncio.Event()
        self._changing = asyncio.Lock()

    async def run(self) -> None:
        """Go on with what the ledger holds, then serve; ends by cancellation. A running job is left to be resumed."""
        left = await self._shop.ledger.jobs((Phase.INCOMING, Phase.READY, Phase.RUNNING))
        try:
            async with asyncio.TaskGroup() as self._tasks:
                for job in left:
                    self._prepare_soon(job.liability)
                self._opened.set()
                await self._serve_ready()
        finally:
            self._tasks = None
            await self._suspend()

    async def accept(self, liability: Liability) -> None:
        """A new liability names us: write it down and prepare it. Known and ended ones are left as they are."""
        await self._opened.wait()
        if not liability.is_finalized and await self._shop.ledger.add_job(liability):
            log.info("%s: incoming, model %s, objective %s", liability.address, liability.model, liability.objective)
            await self._witness(Phase.INCOMING, liability)
            self._prepare_soon(liability)

    async def finalized(self, address: str, *, success: bool) -> None:
        """The chain has finalized the liability at `address`; nothing more is owed. Unknown ones are ignored."""
        async with self._changing:
            job = await self._shop.ledger.job(address)
            if job is None or job.phase is Phase.FINALIZED:
                return
            await self._abandon(address)
            self._objectives.pop(address, None)
            # In this order: after a crash between the two, the same block is handled again and finds the job unended.
            if job.result is not None:
                await self._shop.outbox.settle(outgoing_identity(_result(job)))
            await self._shop.ledger.set_phase(address, advance(address, job.phase, Phase.FINALIZED))
        log.info("%s: finalized, %s", address, "paid" if success else "refunded")
        ended = msgspec.structs.replace(job.liability, is_finalized=True, is_success=success, result=job.result or "")
        await self._witness(Phase.FINALIZED, ended)

    async def start(self, address: str) -> None:
        """Play the objective of a ready job. Returns when the playback has begun. Raises `WrongPhase`."""
        await self._objective_at_hand(address)
        async with self._changing:
            job = await self._startable(address, asked="start")
            if job.phase is not Phase.READY:
                raise WrongPhase(address, asked="start", phase=job.phase)
            await self._begin(job, 0)

    async def restart(self, address: str) -> None:
        """Begin a running or ready job anew: a fresh recording, the objective from its first message."""
        await self._objective_at_hand(address)
        async with self._changing:
            job = await self._startable(address, asked="restart")
            await self._abandon(address)
            await self._shop.ledger.set_position(
                address, 0
            )  # first: a crash may not leave a recording without its head
            await asyncio.to_thread(self._shop.discard_recording, address)
            await self._begin(job, 0)

    async def resume(self, address: str) -> None:
        """Go on with an interrupted job at the position in the ledger, adding to its recording."""
        await self._objective_at_hand(address)
        async with self._changing:
            job = await self._startable(address, asked="resume")
            if address in self._runs:
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

    async def finish(self, address: str, *, success: bool, note: str = "") -> str:
        """End a job: close the recording, keep it under its CID, sign and send the Result. Returns the CID.

        `note` says why it failed, for the recording and the ledger. A job that never started ends with a recording
        that holds no more than the note. Raises `WrongPhase` when it has ended already.
        """
        async with self._changing:
            job = await self._job(address, asked="finish")
            advance(address, job.phase, Phase.COMPLETE)
            await self._stop_playing(address)
            run = self._runs.pop(address, None) or await self._shop.new_run(job.liability)
            summary = await run.close(note)
            cid = await asyncio.to_thread(self._shop.store.put_file, summary.path)
            result = self._shop.signer.sign(Result(liability=address, result=cid, success=success))
            await self._shop.ledger.complete(address, success=success, result=cid, note=note, outgoing=outgoing(result))
            await asyncio.to_thread(summary.path.unlink, missing_ok=True)
            self._objectives.pop(address, None)
        await self._shop.outbox.send()
        log.info("%s: complete, success %s, result %s, %d messages", address, success, cid, summary.messages)
        await self._witness(Phase.COMPLETE, await self.read(address))
        return cid

    async def _job(self, address: str, *, asked: str) -> Job:
        job = await self._shop.ledger.job(address)
        if job is None:
            raise WrongPhase(address, asked=asked, phase=None)
        return job

    async def _startable(self, address: str, *, asked: str) -> Job:
        job = await self._job(address, asked=asked)
        if job.phase not in STARTED or address not in self._objectives:
            raise WrongPhase(address, asked=asked, phase=job.phase)
        return job

    async def _objective_at_hand(self, address: str) -> None:
        """After a restart of the agent, a job that is ready is so before its objective has been examined again."""
        await self._opened.wait()
        preparing = self._preparing.get(address)
        job = await self._shop.ledger.job(address)
        if preparing is not None and job is not None and job.phase in STARTED and address not in self._objectives:
            await asyncio.wait([preparing])

    def _prepare_soon(self, liability: Liability) -> None:
        address = liability.address
        preparing = self._begun().create_task(self._prepare(liability), name=f"prepare {address}")
        self._preparing[address] = preparing
        preparing.add_done_callback(lambda task: self._preparing.pop(address))

    async def _prepare(self, liability: Liability) -> None:
        address = liability.address
        try:
            async with self._fetching:
                objective = await self._shop.examine(liability, topics=self._topics)
        except (ContentError, InputError) as error:
            log.warning("%s: refused: %s", address, error)
            await self._unless_ended(self.finish(address, success=False, note=str(error)))
            return
        async with self._changing:
            job = await self._job(address, asked="prepare")
            if job.phase is Phase.INCOMING:
                await self._shop.ledger.set_phase(address, Phase.READY)
            elif job.phase not in STARTED:
                return
            self._objectives[address] = objective
        if job.phase is Phase.INCOMING:
            log.info("%s: ready, %d messages to play", address, objective.count)
            await self._witness(Phase.READY, liability)
        self._ready.put_nowait(address)

    async def _serve_ready(self) -> None:
        while True:
            address = await self._ready.get()
            if self._performer is not None:
                await self._unless_ended(self._serve(address))

    async def _serve(self, address: str) -> None:
        """Start or resume a job whose code is ours, and wait for its end; it may be restarted in between."""
        await self.resume(address)
        while (playing := await self._play_of(address)) is not None:
            await asyncio.wait([playing])

    async def _play_of(self, address: str) -> asyncio.Task[None] | None:
        """The playback of a job, if it goes on."""
        async with self._changing:
            playing = self._plays.get(address)
            if playing is not None and playing.done():
                del self._plays[address]
                return None
            return playing

    async def _begin(self, job: Job, position: int) -> None:
        address, tasks = job.liability.address, self._begun()
        objective = self._objectives[address]
        run = self._runs[address] = await self._shop.new_run(job.liability, objective=objective, position=position)
        await self._shop.ledger.set_phase(address, Phase.RUNNING, position=position)
        run.open()
        log.info("%s: running, from message %d of %d", address, position, objective.count)
        self._plays[address] = tasks.create_task(self._play(run), name=f"play {address}")

    async def _play(self, run: Run) -> None:
        """Play to the end; with a performer, finish as it went."""
        address = run.liability.address
        _playing.set(address)
        noted = time.monotonic()

        async def progress(position: int) -> None:
            nonlocal noted
            if time.monotonic() - noted >= PROGRESS:
                noted = time.monotonic()
                await self._shop.ledger.set_position(address, position)

        success, note = True, ""
        try:
            await self._witness(Phase.RUNNING, run.liability)
            await run.play(self._performer, progress=progress)
        except Exception as error:
            success, note = False, str(error) or type(error).__name__
            log.warning("%s: the job failed: %s", address, note, exc_info=not isinstance(error, AiraError))
        await self._shop.ledger.set_position(address, run.position)
        if self._performer is not None or not success:
            await self._unless_ended(self.finish(address, success=success, note=note))

    async def _suspend(self) -> None:
        """Leave the running jobs as another run of the agent can go on with them."""
        runs, self._runs = self._runs, {}
        for address, run in runs.items():
            await self._shop.ledger.set_position(address, run.position)
            try:
                await run.close()
            except AiraError as error:
                log.error("%s: %s", address, error)

    async def _abandon(self, address: str) -> None:
        """Stop whatever runs for a job, keeping its files."""
        await self._stop_playing(address)
        run = self._runs.pop(address, None)
        if run is not None:
            await run.close()

    async def _stop_playing(self, address: str) -> None:
        """Cancel the playback of a job and wait for its end, unless it is the playback, or its handler, that asks."""
        if _playing.get() != address and (playing := self._plays.pop(address, None)) is not None:
            playing.cancel()
            await asyncio.wait([playing])

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


def _result(job: Job) -> Result:
    assert job.result is not None
    return Result(liability=job.liability.address, result=job.result, success=bool(job.success))
