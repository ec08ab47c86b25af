"""All verdicts on tampered and on honest recordings, for tests and benchmarks."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NamedTuple

import zenoh

from tests.support.routers import client_config
from tests.support.validator.faults import Place
from tests.support.validator.honest import KINDS
from tests.support.validator.lamps import LEVELS, THIEF, LampRobot, order
from tests.support.validator.tampered_claims import tampered, tamperings
from tests.support.validator.tampering import Others

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.validator.judging import Judgement
    from tests.support.validator.honest import HonestKind
    from tests.support.validator.lamps import FinishedJob
    from tests.support.validator.tampering import Tampering

AT_A_TIME = 4
"""Honest jobs that are done at once."""


class TamperedVerdict(NamedTuple):
    """How a tampered recording was judged."""

    tampering: Tampering
    judgement: Judgement


async def judge_tampered(endpoint: str, folder: Path) -> list[TamperedVerdict]:
    """Do jobs with sessions at a router's endpoint, tamper with the recording of one in each way, and judge that.

    The juror has judged the jobs of the others before, which were honest.
    """
    objective, easier = order(folder / "objective.mcap"), order(folder / "easier.mcap", LEVELS[:8])
    with zenoh.open(client_config(endpoint)) as session:
        robot, thief = LampRobot(session, folder / "robot"), LampRobot(session, folder / "thief", robot=THIEF)
        job = await robot.work("ours", objective)
        others = Others(
            await robot.work("another", objective),
            await thief.work("thief's", objective),
            await robot.work("easy", easier),
        )
    judged: dict[str, str] = {}
    for honest in (job, others.same_robot, others.other_robot):
        judgement = honest.judge({} if honest is job else judged)
        assert judgement.success, judgement.failures
    return [
        TamperedVerdict(one, tampered(job, one, folder / str(number)).judge(dict(judged)))
        for number, one in enumerate(tamperings(others))
    ]


class HonestVerdict(NamedTuple):
    """How an honest job was judged."""

    kind: HonestKind
    job: FinishedJob
    judgement: Judgement


async def judge_honest(endpoint: str, folder: Path, *, of_each: int = 100) -> list[HonestVerdict]:
    """Do a hundred jobs under faults with sessions at a router's endpoint, and judge them by one juror.

    `of_each` is the most jobs of a kind.
    """
    at_a_time = asyncio.Semaphore(AT_A_TIME)
    with zenoh.open(client_config(endpoint)) as session:
        place = Place(endpoint, session, folder)

        async def work(one: HonestKind, number: int) -> tuple[HonestKind, FinishedJob]:
            async with at_a_time:
                return one, await one.work(place, f"{one.work.__name__}-{number}")

        jobs = await asyncio.gather(*(work(one, number) for one in KINDS for number in range(min(one.jobs, of_each))))
    judged: dict[str, str] = {}
    return [HonestVerdict(kind, job, job.judge(judged)) for kind, job in jobs]
