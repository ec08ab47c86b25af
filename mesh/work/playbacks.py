"""Playbacks: the runs of objectives, opened with a recording, played, suspended, continued."""

from __future__ import annotations

import asyncio
import logging
from contextvars import ContextVar, copy_context
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import mesh
from mesh.background import Background
from mesh.content.files import sync_directory
from mesh.errors import AiraError
from mesh.log_context import liability_context, log_event
from mesh.recording import AtOnce, RecordedTimes, Recorders, RecordingAbout
from mesh.work.phases import Phase
from mesh.work.run import JobRun, RecordingIncomplete

if TYPE_CHECKING:
    from asyncio import TaskGroup
    from collections.abc import Callable, Coroutine
    from pathlib import Path

    import zenoh

    from mesh.recording import Objective, Pace, Recorder
    from mesh.settings import ExecutionSettings
    from mesh.work.ledger import JobRecord, Ledger
    from mesh.work.run import Handle
    from schemas import Liability

log = logging.getLogger(__name__)

PUBLISH_INTERVAL: Final = 0.5
"""Seconds after which a run's position is published, if it has changed."""
SAVE_INTERVAL: Final = 0.5
"""Seconds after which a run's recording is synced and its position saved, again and again: what a crash repeats."""

_playing: ContextVar[str] = ContextVar("playing", default="")
"""The job whose playback, or handler, is the running code."""


class Playbacks:
    """The runs of one agent's jobs, by the address of their liability. Their recordings are written to `folder`.

    The caller makes sure that only one call changes a job at a time.
    """

    def __init__(
        self, session: zenoh.Session, agent: str, ledger: Ledger, settings: ExecutionSettings, folder: Path
    ) -> None:
        self._session = session
        self._agent = agent
        self._ledger = ledger
        self._pace: Pace = AtOnce() if settings.playback == "at-once" else RecordedTimes()
        names = (name.strip() for name in settings.recording_topics.split(","))
        self._recorded = frozenset(name for name in names if name) or None
        self._folder = folder
        self._runs: dict[str, JobRun] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self.recorders = Recorders()

    async def create(self, job: JobRecord, objective: Objective | None = None) -> JobRun:
        """A run of `objective` from the job's position; without an objective, one that only records.

        It continues the recording of an interrupted run of the same job.
        """
        return JobRun(
            self._session,
            self._agent,
            job.liability,
            await self._opened_recorder(job.liability),
            objective=objective,
            pace=self._pace,
            position=job.position,
            recorded=self._recorded,
            earlier=job.recorded,
        )

    async def begin(
        self,
        job: JobRecord,
        objective: Objective,
        *,
        play: Callable[[JobRun], Coroutine[Any, Any, None]],
        tasks: TaskGroup,
    ) -> None:
        """Open a run of a job, write to the ledger that it is running, and `play` it in one of `tasks`."""
        address, position = job.liability.address, job.position
        facts = log_event("job-started", position=position, count=objective.count)
        log.info("running, from message %d of %d", position, objective.count, extra=facts)
        run = self._runs[address] = await self.create(job, objective)
        await self._ledger.set_phase(address, Phase.RUNNING, position=position)
        run.open()
        context = copy_context()
        context.run(_playing.set, address)
        task = self._tasks[address] = tasks.create_task(play(run), name=f"play {address}", context=context)
        task.add_done_callback(partial(self._drop_task, address))

    async def play_and_save(self, run: JobRun, handle: Handle | None) -> None:
        """Play a run to its end, and keep in the ledger how far its recording on the disk reaches.

        Raises what `handle` raises, `RecordingFailed`, `LedgerUnusable`, and at once `RecordingIncomplete`.
        """
        if run.missing:
            raise RecordingIncomplete(run.liability.address, run.missing)
        async with Background() as tasks:
            tasks.start(self._save_regularly(run), f"position {run.liability.address}")
            tasks.start(_publish_regularly(run), f"progress {run.liability.address}")
            await run.play(handle)
        run.publish_position()
        await self._save(run)

    async def _save_regularly(self, run: JobRun) -> None:
        saved = run.position
        while True:
            await asyncio.sleep(SAVE_INTERVAL)
            if run.position > saved:
                saved = await self._save(run)

    async def _save(self, run: JobRun) -> int:
        """Sync the recording of a run, then save its position; returns that. A run that was stopped saves nothing."""
        synced, address = await run.sync(), run.liability.address
        if self._runs.get(address) is run:
            await self._ledger.set_position(address, synced.position, recorded=synced.messages)
        return synced.position

    def run(self, address: str) -> JobRun | None:
        """The open run of a job."""
        return self._runs.get(address)

    def task(self, address: str) -> asyncio.Task[None] | None:
        """The playback of a job that has not ended."""
        return self._tasks.get(address)

    async def stop(self, address: str) -> JobRun | None:
        """Cancel the playback of a job and wait for its end, unless it is the caller. Returns its run, still open."""
        if _playing.get() != address and (task := self._tasks.pop(address, None)) is not None:
            task.cancel()
            await asyncio.wait([task])
        return self._runs.pop(address, None)

    async def suspend(self, address: str) -> None:
        """Stop the run of a job, close it and save its position, so that another run can continue it."""
        run = await self.stop(address)
        if run is not None:
            summary = await run.close()
            await self._ledger.set_position(address, run.position, recorded=summary.messages)

    async def suspend_all(self) -> None:
        """Suspend all runs. A position that can't be saved is logged."""
        for address in tuple(self._runs):
            with liability_context(address):
                try:
                    await self.suspend(address)
                except AiraError as error:
                    facts = log_event("position-not-saved", code=error.code)
                    log.error("can't save the job's position: %s", error, extra=facts)

    def _drop_task(self, address: str, task: asyncio.Task[None]) -> None:
        if self._tasks.get(address) is task:
            del self._tasks[address]

    def recorded(self) -> set[str]:
        """The addresses of the liabilities that have a recording here. Blocks on the disk."""
        return {path.name.partition(".")[0] for path in self._folder.glob("*.mcap*")}

    def discard_recording(self, address: str, *, sync: bool = False) -> None:
        """Delete what an earlier run of the liability at `address` has recorded. Blocks on the disk.

        Without `sync`, a power loss may bring it back.
        """
        for leftover in self._recording_files(address):
            leftover.unlink(missing_ok=True)
        if sync and self._folder.exists():
            sync_directory(self._folder)

    async def _opened_recorder(self, liability: Liability) -> Recorder:
        """An open recorder. It is closed if this is cancelled meanwhile: the thread that opens it can't be stopped."""
        opening = asyncio.ensure_future(asyncio.to_thread(self._open_recorder, liability))
        try:
            return await asyncio.shield(opening)
        except asyncio.CancelledError:
            await asyncio.wait([opening])
            if opening.exception() is None:
                await asyncio.to_thread(opening.result().close)
            raise

    def _open_recorder(self, liability: Liability) -> Recorder:
        finished, partial, _ = self._recording_files(liability.address)
        if finished.exists():  # it was closed, but a crash came before the Result was in the ledger
            finished.replace(partial)
        about = RecordingAbout(
            liability=liability.address,
            agent=self._agent,
            lighthouse=liability.lighthouse,
            objective=liability.objective,
            software=f"aira-mesh {mesh.__version__}",
            topics=",".join(sorted(self._recorded or ())),
        )
        return self.recorders.open(finished, about)

    def _recording_files(self, address: str) -> tuple[Path, Path, Path]:
        """The recording when it is finished, while it is written, and while an interrupted one is continued."""
        finished = self._folder / f"{address}.mcap"
        return finished, finished.with_name(f"{finished.name}.part"), finished.with_name(f"{finished.name}.cut")


async def _publish_regularly(run: JobRun) -> None:
    published = None
    while True:
        if run.position != published:
            published = run.position
            run.publish_position()
        await asyncio.sleep(PUBLISH_INTERVAL)
