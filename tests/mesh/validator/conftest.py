"""Markets for the tests of validators, and a complete job with its files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.validator.jobs import SampleJob, make_job

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def job(tmp_path: Path) -> SampleJob:
    return make_job(tmp_path)
