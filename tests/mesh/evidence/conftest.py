"""A complete job with its files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.mesh.evidence.jobs import JobFiles, make_job

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def job(tmp_path: Path) -> JobFiles:
    return make_job(tmp_path)
