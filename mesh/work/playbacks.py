"""What is played now: a run for each job under way, its playback in a task, and how far it has come in the ledger."""

from __future__ import annotations

import asyncio
import logging
import time
from contextvars import ContextVar
from typing import TYPE_CHECKING, Final, Protocol

from mesh.errors import AiraError
from mesh.telemetry.context import liability_context
from mesh.work.database import LedgerUnusable
from mesh.work.lifecycle import Phase

if TYPE_CHECKING:
    from mesh.recording import Objective
    from mesh.work.job import Job, TopicHandler
    from mesh.work.ledger import JobRecord
    from mesh.work.lifecycle import PhaseListener
    from mesh.work.workshop import Workshop

log = logging.getLogger(__name__)

PROGRESS: Final = 0.5
"""Seconds between two notes of a playback's position in the ledger."""

_playing: ContextVar[str] = ContextVar("playing", default="")
"""The job that the running code plays, or is a handler of."""


class Finish(Protocol):
    """What is to be done when a playback has come to its end."""

    async def __call__(self, address: str, *, success: bool, note: str) -> None: ...


class Playbacks:
    """The runs under way, by the address of their liability. Who calls sees to it that one call changes a job at once.

    With a `performer`, or when it fails, a playback ends with `finish`; else its run stays open.
    """

    def __init__(
        self, shop: Workshop, *, performer: TopicHandler | None, witness: PhaseListener, finish: Finish
    ) -> None:
        self._shop = shop
        self._performer = performer
        self._witness = witness
        self._finish = finish
        self._runs: dict[str, Job] = {}
        self._plays: dict[str, asyncio.Task[None]] = {}

    def __contains__(self, address: str) -> bool:
        return address in self._runs

    def __getitem__(self, address: str) -> Job:
        return self._runs[address]

    async def begin(self, job: JobRecord, objective: Objective, tasks: asyncio.TaskGroup, *, position: int) -> None:
        """Open a run of the job and play its objective from a message on, as one of `tasks`."""
        address = job.liability.address
        run = self._runs[address] = await self._shop.new_run(job.liability, objective=objective, position=position)
        await self._shop.ledger.set_phase(address, Phase.RUNNING, position=position)
        run.open()
        log.info("running, from message %d of %d", position, objective.count)
        self._plays[address] = tasks.create_task(self._play(run), name=f"play {address}")

    def under_way(self, address: str) -> asyncio.Task[None] | None:
        """The playback of a job, if it goes on."""
        if (playing := self._plays.get(address)) is not None and playing.done():
            del self._plays[address]
            return None
        return playing

    async def stop(self, address: str) -> Job | None:
        """End the playback of a job and give its run, which is the caller's to close; None if there is none."""
        await self._stop_playing(address)
        return self._runs.pop(address, None)

    async def abandon(self, address: str) -> None:
        """Stop whatever runs for a job, keeping its files."""
        await self._stop_playing(address)
        if address in self._runs:
            await self._put_away(address)

    async def suspend(self) -> None:
        """Leave the running jobs as another run of the agent can go on with them; their playbacks have ended."""
        for address in tuple(self._runs):
            with liability_context(address):
                try:
                    await self._put_away(address)
                except AiraError as error:
                    log.error("how far it has come is not written down: %s", error)

    async def _play(self, run: Job) -> None:
        """Play to the end; with a performer, finish as it went."""
        address = run.liability.address
        _playing.set(address)
        noted, success, note = time.monotonic(), True, ""

        async def progress(position: int) -> None:
            nonlocal noted
            if time.monotonic() - noted >= PROGRESS:
                noted = time.monotonic()
                await self._shop.ledger.set_position(address, position)

        try:
            await self._witness(Phase.RUNNING, run.liability)
            await run.play(self._performer, progress=progress)
        except LedgerUnusable:  # not the job's fault, which is gone on with later
            raise
        except Exception as error:
            success, note = False, str(error) or type(error).__name__
            log.warning("the job failed: %s", note, exc_info=not isinstance(error, AiraError))
        await self._shop.ledger.set_position(address, run.position)
        if self._performer is not None or not success:
            await self._finish(address, success=success, note=note)

    async def _put_away(self, address: str) -> None:
        """Note how far a run has come and close it."""
        run = self._runs.pop(address)
        try:
            await self._shop.ledger.set_position(address, run.position)
        finally:
            await run.close()

    async def _stop_playing(self, address: str) -> None:
        """Cancel the playback of a job and wait for its end, unless it is the playback, or its handler, that asks."""
        if _playing.get() != address and (playing := self._plays.pop(address, None)) is not None:
            playing.cancel()
            await asyncio.wait([playing])
