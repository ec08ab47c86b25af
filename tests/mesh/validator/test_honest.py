"""A hundred honest jobs under faults: all are paid."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.recording import RECOVERED, open_objective
from tests.support.ci import IN_CI
from tests.support.validator.honest import KINDS
from tests.support.validator.trials import failed
from tests.support.validator.verdicts import judge_honest

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter


async def test_each_of_a_hundred_honest_jobs_is_paid(router: EmbeddedRouter, tmp_path: Path) -> None:
    """A hundred in CI, elsewhere one of each kind."""
    verdicts = await judge_honest(router.endpoint, tmp_path, of_each=100 if IN_CI else 1)
    assert len(verdicts) == (sum(kind.jobs for kind in KINDS) if IN_CI else len(KINDS))
    assert sum(kind.jobs for kind in KINDS) == 100
    assert [(one.kind.kind, failed(one.judgement)) for one in verdicts if not one.judgement.success] == []
    crashed = {one.kind.kind for one in verdicts if RECOVERED in open_objective(one.job.recording).metadata}
    assert crashed == {kind.kind for kind in KINDS if kind.crashes}
