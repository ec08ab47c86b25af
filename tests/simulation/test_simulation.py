"""A few histories of the simulator in the suite; `make simulate` runs as many as one likes."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.simulation.fault_plan import KINDS
from tests.simulation.mutations import CANDIDATES, MUTATIONS
from tests.simulation.runs import numbers_in, ranges

FAULTS = (
    "crash,crash_every,delay,drop,duplicate,late,leave_out,lost_after_sending,partition_every,preempt,"
    "withdraw,revoke,short_lived,pair,retry,stop,owner_stop,hand_back"
)


HAPPEN = {
    *("message-cut-off", "message-delayed", "message-dropped", "message-duplicated", "message-replayed"),
    *("answer-spoilt", "node-late", "node-unreachable", "reorganisation", "transaction-left-out"),
    *("clock-jump", "crash-planned", "disk-full", "kill", "partition", "power-failure", "write-refused"),
    *("allowance-revoked", "order-short-lived", "order-withdrawn", "order-paired", "order-retried"),
    *("job-stopped", "robot-stopped", "job-handed-back"),
}
"""Kinds of faults as they are counted."""


def simulate(*arguments: str) -> tuple[dict[str, Any], str]:
    """Run histories; the printed object, and what was printed of failures."""
    command = [sys.executable, "-m", "tests.simulation", "--json", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert ended.stdout, ended.stderr
    found: dict[str, Any] = json.loads(ended.stdout)
    return found, ended.stderr


def test_in_a_quiet_market_every_job_ends() -> None:
    """Some of the jobs fail, so that not all are paid."""
    found, said = simulate("--seed", "2", "--jobs", "4", "--only", "none")
    assert (found["paid"] + found["refunded"], found["violations"], found["faults"]) == (4, [], {}), said
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


def test_sigterm_ends_a_run_with_what_has_happened_so_far() -> None:
    command = [sys.executable, "-m", "tests.simulation", "--seed", "1", "--jobs", "100000", "--workers", "2"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        first = running.stdout.readline()
        histories = children_of(running.pid)
        running.send_signal(signal.SIGTERM)
        said, _ = running.communicate(timeout=60)
    assert first.startswith("seed 1: 6 jobs")
    assert " jobs, " in said.splitlines()[-1]
    assert running.returncode == 0
    assert histories
    assert not any(Path(f"/proc/{history}").exists() for history in histories)


def children_of(process: int) -> list[int]:
    """The numbers of a process's children."""
    return [int(number) for number in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def test_planted_bugs_fit_the_sources() -> None:
    for mutation in (*MUTATIONS, *CANDIDATES):
        compile(mutation.source(), mutation.name, "exec")


@pytest.mark.full
def test_a_planted_bug_is_found() -> None:
    command = [sys.executable, "-m", "tests.simulation", "--mutants", "--seed", "1", "--mutant", "before the objective"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "1 of 1 planted bugs found" in ended.stdout


@pytest.mark.full
def test_faults_of_each_kind_happen() -> None:
    """Which of them a seed draws changes with the code, so it takes a few."""
    happened = set[str]()
    for seed in map(str, range(1, 33)):
        arguments = ("--seed", seed, "--jobs", "4", "--chain", "model", "--only", ",".join(KINDS), "--lasts", "400")
        found, said = simulate(*arguments)
        assert found["violations"] == [], said
        happened |= set(found["faults"])
        if happened >= HAPPEN:
            return
    assert happened >= HAPPEN


def test_a_failing_history_is_reduced_to_what_makes_it_fail() -> None:
    """What is printed plays the smaller history, which fails in the same way."""
    planted = "the result is signed before the objective was played"
    command = [sys.executable, "-m", "tests.simulation", "--plant", planted, "--seed", "1", "--jobs", "4"]
    command += ["--only", "delay,drop,late"]
    ended = subprocess.run([*command, "--shrink", "3"], capture_output=True, text=True, timeout=600, check=False)
    assert ended.returncode == 1
    small = re.findall(r'ARGS="(.*) --trace"', ended.stderr)[-1]
    assert "--jobs 4" not in small
    found, said = simulate(*shlex.split(small))
    assert any("recording-incomplete" in violation for violation in found["violations"]), said


@pytest.mark.parametrize("numbers", [set(), {3}, {0, 1, 2, 7}, {5, 6, 9, 10, 11}])
def test_numbers_of_faults_are_written_as_ranges(numbers: set[int]) -> None:
    assert numbers_in(ranges(frozenset(numbers))) == numbers
