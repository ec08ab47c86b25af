"""An honest job, and what is found wrong in a forged one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.mesh.evidence.jobs import JobFiles, made

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.evidence import Verdict


@pytest.fixture
def job(tmp_path: Path) -> JobFiles:
    return made(tmp_path)


def wrong(verdict: Verdict) -> dict[str, str]:
    """What does not hold, with its detail."""
    return {finding.name: finding.detail for finding in verdict.findings if finding.holds is False}
