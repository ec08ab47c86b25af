"""A hundred recordings that were tampered with: none is paid, each for its reason."""

from __future__ import annotations

from typing import TYPE_CHECKING

import zenoh

from tests.mesh.validator.lamps import THIEF, LampRobot, order
from tests.mesh.validator.tampered_claims import tampered, tamperings
from tests.mesh.validator.tampering import Others
from tests.mesh.validator.trials import failed
from tests.support.routers import EmbeddedRouter, client_config

if TYPE_CHECKING:
    from pathlib import Path


async def test_none_of_a_hundred_tampered_recordings_is_paid(router: EmbeddedRouter, tmp_path: Path) -> None:
    objective, easier = order(tmp_path / "objective.mcap"), order(tmp_path / "easier.mcap", (0.0, 0.05, 0.1))
    with zenoh.open(client_config(router.endpoint)) as session:
        robot, thief = LampRobot(session, tmp_path / "robot"), LampRobot(session, tmp_path / "thief", robot=THIEF)
        job = await robot.work("ours", objective)
        others = Others(
            await robot.work("another", objective),
            await thief.work("thief's", objective),
            await robot.work("easy", easier),
        )
    judged: dict[str, str] = {}
    assert failed(job.judge({})) == {}
    assert failed(others.same_robot.judge(judged)) == {}
    assert failed(others.other_robot.judge(judged)) == {}

    kinds = tamperings(others)
    assert len({one.kind for one in kinds}) == len(kinds) >= 100
    wrong = {}
    for number, one in enumerate(kinds):
        judgement = tampered(job, one, tmp_path / str(number)).judge(dict(judged))
        if judgement.success or one.code not in failed(judgement):
            wrong[one.kind] = (one.code, failed(judgement))
    assert wrong == {}
