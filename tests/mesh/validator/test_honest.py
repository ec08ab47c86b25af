"""A hundred honest jobs under faults: all are paid."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import zenoh

from mesh.recording import RECOVERED, open_objective
from tests.mesh.validator.honest import KINDS, Place
from tests.mesh.validator.trials import failed
from tests.support.routers import EmbeddedRouter, client_config

if TYPE_CHECKING:
    from pathlib import Path

    from tests.mesh.validator.honest import HonestKind
    from tests.mesh.validator.lamps import FinishedJob


async def test_each_of_a_hundred_honest_jobs_is_paid(router: EmbeddedRouter, tmp_path: Path) -> None:
    assert sum(one.jobs for one in KINDS) == 100
    at_a_time = asyncio.Semaphore(4)
    with zenoh.open(client_config(router.endpoint)) as session:
        place = Place(router.endpoint, session, tmp_path)

        async def work(one: HonestKind, number: int) -> tuple[str, FinishedJob]:
            async with at_a_time:
                return one.kind, await one.work(place, f"{one.work.__name__}-{number}")

        jobs = await asyncio.gather(*(work(one, number) for one in KINDS for number in range(one.jobs)))
    crashed = {kind for kind, job in jobs if RECOVERED in open_objective(job.recording).metadata}
    assert crashed == {one.kind for one in KINDS if one.crashes}
    judged: dict[str, str] = {}
    unpaid = [(kind, failed(judgement)) for kind, job in jobs if not (judgement := job.judge(judged)).success]
    assert unpaid == []
