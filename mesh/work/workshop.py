"""What an executor works with, and how it gets from a liability to an objective in hand and a run of it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import mesh
from mesh.errors import InputError
from mesh.recording import AtOnce, Limits, RecordedTimes, Recorder, Recorders, RecordingAbout, preflight
from mesh.settings import LONGEST
from mesh.work.job import Job, Plan
from mesh.work.lifecycle import Phase
from mesh.work.outbox import outgoing
from schemas import Result

if TYPE_CHECKING:
    from pathlib import Path

    import zenoh

    from mesh.content import Exchange, Store
    from mesh.recording import Objective
    from mesh.settings import Settings
    from mesh.work.job import TopicHandler
    from mesh.work.ledger import Ledger
    from mesh.work.outbox import Outbox
    from schemas import Liability, Signer


class UnfitObjective(InputError):
    """An objective can't be played here; `reason` is preflight's machine-readable word."""

    code = "unfit-objective"

    def __init__(self, cid: str, reason: str, detail: str) -> None:
        super().__init__(f"objective {cid} can't be played ({reason}): {detail}")
        self.cid = cid
        self.reason = reason


@dataclass(frozen=True, kw_only=True)
class Workshop:
    """The parts that an executor works with, all open, each the caller's to close.

    `recordings` is the folder of recordings that are being made; finished ones are in the store.
    """

    session: zenoh.Session
    signer: Signer
    ledger: Ledger
    outbox: Outbox
    store: Store
    exchange: Exchange
    settings: Settings
    recordings: Path
    recorders: Recorders = field(default_factory=Recorders)

    async def pin(self, cid: str, address: str) -> None:
        """Let the store keep a file, which need not be there yet, for the liability at `address` until `unpin`."""
        await asyncio.to_thread(self.store.pin, cid, address)

    async def unpin(self, address: str) -> None:
        """The liability at `address` needs no file any more, if it has ended; else nothing happens."""
        job = await self.ledger.job(address)
        if job is None or job.phase is Phase.FINALIZED:
            await asyncio.to_thread(self.store.release, address)

    async def unpin_ended(self) -> None:
        """The same for all liabilities, as a crash may have come between their end and `unpin`."""
        pins = await asyncio.to_thread(self.store.pins)
        for label in frozenset().union(*pins.values()):
            if label.startswith("0x"):  # other labels are not ours
                await self.unpin(label)

    async def fetch(self, cid: str, *, patience: float = LONGEST) -> Path:
        """Where the file of an objective is: in the store, or fetched from the mesh. Raises a `ContentError`.

        Gives up after `patience`, or the settings' `fetch_timeout`, seconds without a new block.
        """
        settings = self.settings
        held = await asyncio.to_thread(self.store.checked, cid)
        return held or await self.exchange.fetch(
            cid, size_limit=settings.objective_size_limit, timeout=min(patience, settings.fetch_timeout)
        )

    async def examine(self, cid: str, path: Path, *, performer: TopicHandler | None) -> Objective:
        """The objective of that CID, which is at `path`, found fit to be played by the performer, or by anybody.

        Raises `UnfitObjective`.
        """
        limits = Limits(size=self.settings.objective_size_limit, expanded=self.settings.objective_expanded_limit)
        topics, obstacle = (None, None) if performer is None else (performer.topics, performer.obstacle)
        outcome = await asyncio.to_thread(preflight, path, limits, topics=topics, obstacle=obstacle)
        if outcome.objective is None or not outcome.ok:
            raise UnfitObjective(cid, outcome.reason, outcome.detail)
        return outcome.objective

    async def new_run(self, liability: Liability, *, objective: Objective | None = None, position: int = 0) -> Job:
        """A run of `objective` from message `position` on; without an objective, one that only records.

        What an interrupted run of the same liability has recorded is gone on with.
        """
        chosen = self._chosen_topics()
        pace = AtOnce() if self.settings.playback == "at-once" else RecordedTimes()
        plan = Plan(liability=liability, objective=objective, pace=pace, position=position, topics=chosen or None)
        recorder = await asyncio.to_thread(self._new_recorder, liability)
        return Job(self.session, self.signer.address, plan, recorder)

    async def owe_result(self, address: str, *, success: bool, result: str, note: str) -> None:
        """Write down how the job at `address` has ended, and its signed Result, to be sent until the chain has it."""
        signed = self.signer.sign(Result(liability=address, result=result, success=success))
        await self.ledger.complete(address, success=success, result=result, note=note, outgoing=outgoing(signed))

    def discard_recording(self, address: str) -> None:
        """Forget what an earlier run of the liability at `address` has recorded. Blocks on the disk."""
        for leftover in self._recording_files(address):
            leftover.unlink(missing_ok=True)

    def _chosen_topics(self) -> frozenset[str]:
        """The topics to record; none for all."""
        return frozenset(name.strip() for name in self.settings.recording_topics.split(",") if name.strip())

    def _new_recorder(self, liability: Liability) -> Recorder:
        finished, partial, _ = self._recording_files(liability.address)
        if finished.exists():  # closed, but a crash came before the Result was written down
            finished.replace(partial)
        about = RecordingAbout(
            liability=liability.address,
            agent=self.signer.address,
            lighthouse=liability.lighthouse,
            objective=liability.objective,
            software=f"aira-mesh {mesh.__version__}",
            topics=",".join(sorted(self._chosen_topics())),
        )
        return self.recorders.open(finished, about)

    def _recording_files(self, address: str) -> tuple[Path, Path, Path]:
        """Where the recording is when it is whole, while it is being made, and while it is gone on with."""
        finished = self.recordings / f"{address}.mcap"
        return finished, finished.with_name(f"{finished.name}.part"), finished.with_name(f"{finished.name}.cut")
