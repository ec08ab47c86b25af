"""The tables in docs/reference/tampered-recordings.md are those of what the tests run."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from mesh.validator.judging import POLICIES
from tests.support.validator.jobs import make_job
from tests.support.validator.tables import PAGE, honest_table, in_page, tampered_table
from tests.support.validator.trials import Trial

if TYPE_CHECKING:
    from pathlib import Path


def test_the_documented_tampering_is_what_the_tests_judge(tmp_path: Path) -> None:
    assert in_page(PAGE.read_text(), "tampering") == tampered_table(tmp_path)


def test_the_documented_honest_jobs_are_what_the_tests_judge() -> None:
    assert in_page(PAGE.read_text(), "fault") == honest_table()


def test_every_shipped_policy_is_documented_with_what_it_demands() -> None:
    documented = in_page((PAGE.parent / "policies.md").read_text(), "policy")
    assert [line.split("`")[1] for line in documented.splitlines()[2:]] == list(POLICIES)
    for name in ("complete", "schema"):
        assert POLICIES[name].description in documented


def test_every_finding_is_documented(tmp_path: Path) -> None:
    job = make_job(tmp_path)
    codes = (PAGE.parent / "checks.md").read_text().split("## Findings")[1]
    first_cells = [line.partition(" | ")[0] for line in codes.splitlines() if line.startswith("| `")]
    documented = {name for cell in first_cells for name in re.findall(r"`([a-z-]+)`", cell)}
    found = {finding.name for finding in job.verify().findings}
    found |= {finding.code for finding in Trial(job).judge(*POLICIES.values()).findings}
    assert found <= documented
    assert documented - found == {"model", "check", "check-failed", "check-timeout"}
