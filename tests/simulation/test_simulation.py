"""A few histories of the simulator in the suite; `make simulate` runs as many as one likes."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

from tests.simulation.mutations import MUTATIONS

FAULTS = "crash,crash_every,delay,drop,duplicate,late,leave_out,lost_after_sending,partition_every,preempt"


def simulate(*arguments: str) -> tuple[dict[str, Any], str]:
    """Run histories; the printed object, and what was printed of failures."""
    command = [sys.executable, "-m", "tests.simulation", "--json", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert ended.stdout, ended.stderr
    found: dict[str, Any] = json.loads(ended.stdout)
    return found, ended.stderr


def test_in_a_quiet_market_every_job_ends() -> None:
    """Some of the jobs fail, so that not all are paid."""
    found, said = simulate("--seed", "1", "--jobs", "2", "--only", "none")
    assert (found["paid"] + found["refunded"], found["violations"], found["faults"]) == (2, [], {}), said
    assert found["paid"] > 0


def test_a_seed_always_gives_the_same_trace() -> None:
    arguments = ("--seed", "7", "--jobs", "1", "--only", "crash,delay,duplicate,late,preempt,reorganise_every")
    first, second = simulate(*arguments)[0], simulate(*arguments)[0]
    assert first["trace"] == second["trace"]
    assert first["simulated_s"] == second["simulated_s"]


def test_no_invariant_is_violated() -> None:
    found, said = simulate("--seed", "24", "--jobs", "6", "--only", FAULTS)
    assert found["violations"] == [], said
    assert found["lost"] == found["paid_twice"] == 0
    assert found["faults"]


def test_planted_bugs_fit_the_sources() -> None:
    for mutation in MUTATIONS:
        compile(mutation.source(), mutation.name, "exec")


def test_a_planted_bug_is_found() -> None:
    command = [sys.executable, "-m", "tests.simulation", "--mutants", "--seed", "1", "--mutant", "before the objective"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "1 of 1 planted bugs found" in ended.stdout
