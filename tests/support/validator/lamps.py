"""A robot with a lamp that does real jobs: what it is ordered, how it works, and what its recordings must show."""

from __future__ import annotations

import asyncio
import math
import shutil
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
from msgspec import Meta

from mesh.agent.jobs import JobRecordings, JobRun
from mesh.agent.ledger import Ledger
from mesh.base.clock import SYSTEM_CLOCK
from mesh.recording import AT_ONCE, Recorders, open_objective
from mesh.validator.judging import Case, Judgement, judge, own_policy, policy_of
from schemas import (
    Liability,
    Result,
    Signer,
    checksum_address,
    cid_of_file,
    encode,
    keccak256,
)
from schemas.model import ModelDescription, ModelTopic, ValueSchema
from tests.support.objectives import MILLISECOND, timed

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator
    from pathlib import Path

    import zenoh

    from mesh.agent.handlers import Job
    from mesh.base.clock import Clock
    from mesh.recording import Played
    from mesh.validator.judging import Evidence, Policy

    Handler = Callable[[Job, Played], Awaitable[object]]

ROBOT: Final = Signer(b"\x01" * 32)
THIEF: Final = Signer(b"\x02" * 32)
LIGHTHOUSE: Final = "0x" + "2" * 40
VALIDATOR: Final = "0x" + "4" * 40
SLACK_NS: Final = 60 * 10**9
"""How wrong a robot's clock may be."""
LEVELS: Final = tuple(number / 20 for number in range(20))
MODEL: Final = ModelDescription(
    title="A lamp",
    objective=(ModelTopic(topic="/lamp"),),
    result=(
        ModelTopic(topic="/lamp/state", required=True),
        ModelTopic(topic="/lamp/temperature", required=True, value=ValueSchema(type="number", minimum=-20, maximum=80)),
    ),
)


class LampState(msgspec.Struct):
    """What the lamp says after each command."""

    level: Annotated[float, Meta(ge=0, le=1)]
    mode: str = "on"


class Crashed(Exception):
    """The robot's process ends here, as by `kill -9`, and is started again."""


class Stopped(Exception):
    """The robot's process is stopped here in order, and started again."""


def follows_levels(evidence: Evidence) -> Iterator[str]:
    """The lamp shows the levels that it was told to, in order; those of a crash may be shown twice."""
    told = [message.value for message in evidence.objective.on("/lamp")]
    shown = list(dict.fromkeys(message.value["level"] for message in evidence.device.on("/lamp/state")))
    if shown != told:
        yield f"the lamp showed the levels {shown}, not {told}"


SHIPPED: Final = (
    "acknowledged:command=/lamp:answer=/lamp/state:within=6s",
    "schema",
    "rate:topic=/lamp/temperature:min=2.5:max=1000:gap=6s",
)
OWN: Final = own_policy("levels", "The lamp shows each level that it was told to.", follows_levels)
POLICIES: Final[tuple[Policy, ...]] = (*map(policy_of, SHIPPED), OWN)


def order(path: Path, levels: tuple[float, ...] = LEVELS, *, step_ns: int = 5 * MILLISECOND) -> Path:
    """Write an objective with these levels on `/lamp`."""
    path.write_bytes(timed(("/lamp", level, number * step_ns) for number, level in enumerate(levels)))
    return path


def contract(name: str, objective: Path, *, robot: Signer = ROBOT) -> Liability:
    """The contract of the job called `name`."""
    return Liability.of_nobody(
        address=checksum_address(keccak256(name.encode())[:20]),
        model=MODEL.cid,
        objective=cid_of_file(objective),
        promisor=robot.address,
        lighthouse=LIGHTHOUSE,
        cost=1,
        validator=VALIDATOR,
    )


async def shine(job: Job, message: Played) -> None:
    """Do what a command on `/lamp` says."""
    level = message.value
    job.publish("/lamp/temperature", 20.5 + math.sin(level))
    job.publish("/lamp/state", LampState(level))


@dataclass
class FinishedJob:
    """A job whose recording is closed, with what a juror gets of it. Times are in nanoseconds of Unix time."""

    liability: Liability
    objective: Path
    recording: Path
    message: bytes
    since_ns: int
    until_ns: int
    claimed: bool = True
    objective_cid: str = ""
    recording_cid: str = ""

    def judge(
        self, judged: dict[str, str], policies: tuple[Policy, ...] = POLICIES, *, model: ModelDescription | None = MODEL
    ) -> Judgement:
        """Judge it as a juror that has judged those recordings, and remembers this one if it counts."""
        address = self.liability.address

        def owner_of(mark: str) -> str:
            owner = judged.get(mark, "")
            return "" if owner == address else owner

        case = Case(
            liability=self.liability,
            claimed=self.claimed,
            message=self.message,
            since_ns=self.since_ns,
            until_ns=self.until_ns,
            owner_of=owner_of,
            model=model,
            objective_cid=self.objective_cid,
            recording_cid=self.recording_cid,
        )
        judgement = judge(case, objective=self.objective, recording=self.recording, policies=policies)
        if judgement.success:
            judged.update((mark, address) for mark in judgement.marks)
        return judgement


def signed_by(robot: Signer, liability: str, recording: str, *, success: bool = True) -> bytes:
    """An encoded Result."""
    return encode(robot.sign(Result(liability=liability, result=recording, success=success)))


class LampRobot:
    """Does jobs as an agent does: with its ledger, runs and recorder, on a session with a router."""

    def __init__(
        self, session: zenoh.Session, folder: Path, *, robot: Signer = ROBOT, clock: Clock = SYSTEM_CLOCK
    ) -> None:
        self._session = session
        self._robot = robot
        self._clock = clock
        self.folder = folder
        self.before_end: Callable[[JobRun], Awaitable[object]] | None = None
        """Is awaited between the last command and the end of a job's run."""

    async def work(
        self,
        name: str,
        objective: Path,
        handler: Handler | None = shine,
        *,
        topics: str = "",
        playback: str = "recorded",
        liability: Liability | None = None,
    ) -> FinishedJob:
        """Do the job called `name`, and continue it after each `Crashed` and `Stopped` that the handler raises.

        What an earlier call has left in the folder is continued, too. Without a `liability` it invents one.
        """
        liability, since = liability or contract(name, objective, robot=self._robot), time.time_ns()
        self.folder.mkdir(parents=True, exist_ok=True)
        recorded = frozenset(topics.split(",")) if topics else None
        speed = AT_ONCE if playback == "at-once" else 1.0
        async with Ledger(self.folder / "ledger.sqlite") as ledger:
            await ledger.add_job(liability)
            recording = None
            while recording is None:
                with suppress(Crashed, Stopped):
                    recording = await self._run(ledger, speed, recorded, liability, objective, handler)
        return FinishedJob(
            liability=liability,
            objective=objective,
            recording=recording,
            message=signed_by(self._robot, liability.address, cid_of_file(recording)),
            since_ns=since - SLACK_NS,
            until_ns=time.time_ns() + SLACK_NS,
        )

    async def _run(
        self,
        ledger: Ledger,
        speed: float,
        topics: frozenset[str] | None,
        liability: Liability,
        objective: Path,
        handler: Handler | None,
    ) -> Path:
        """One run from the ledger's position. Raises `Crashed` with the files as a killed process leaves them."""
        job = await ledger.job(liability.address)
        assert job is not None
        recordings = JobRecordings(self.folder / "recordings", self._robot.address, topics)
        recordings.recorders = Recorders(clock=self._clock)
        run = JobRun(
            self._session,
            self._robot.address,
            job,
            await recordings.open(liability),
            objective=await asyncio.to_thread(open_objective, objective),
            speed=speed,
            recorded=topics,
        )
        run.open()
        try:
            await run.play_and_save(handler, ledger)
        except Stopped:
            await run.suspend(ledger)
            raise
        except Crashed:
            await self._crash(run)
            raise
        if self.before_end is not None:
            await self.before_end(run)
        return (await run.close(sync=False)).path

    async def _crash(self, run: JobRun) -> None:
        """Leave the recording as it is on the disk now, without what the recorder would write when it is closed."""
        recordings, aside = self.folder / "recordings", self.folder / "aside"
        shutil.copytree(recordings, aside)
        await run.close()
        shutil.rmtree(recordings)
        aside.rename(recordings)
