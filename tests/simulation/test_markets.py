"""The markets and chains that seeds choose."""

from __future__ import annotations

import json
from itertools import count
from typing import TYPE_CHECKING

import pytest

from tests.simulation.deployment import (
    CROWDED_JOBS,
    EVM_EVERY,
    JURORS,
    ON_EVM,
    ON_MODEL,
    Deployments,
    MarketPlan,
    market_plan,
)
from tests.simulation.test_simulation import simulate

if TYPE_CHECKING:
    from pathlib import Path


def test_jobs_end_in_a_market_of_generation_5_with_two_providers_and_two_nodes() -> None:
    seed = next(seed for seed in count() if market_plan(seed) == MarketPlan(generation=5, providers=2, nodes=2))
    found, said = simulate("--seed", str(seed), "--jobs", "2", "--only", "unreachable", "--chain", "model")
    assert found["markets"] == {"generation-5": 1, "two-nodes": 1, "two-providers": 1}
    assert (found["violations"], found["lost"], found["paid_twice"]) == ([], 0, 0), said
    assert found["paid"] + found["refunded"] > 0


@pytest.mark.parametrize("chain", [ON_MODEL, ON_EVM])
def test_jobs_end_in_a_market_with_a_validator(chain: str) -> None:
    """Two of three jurors must agree; they crash, too."""
    seed = next(seed for seed in count() if market_plan(seed) == MarketPlan(generation=5, jurors=JURORS))
    found, said = simulate("--seed", str(seed), "--jobs", "3", "--only", "crash_every", "--chain", chain)
    assert found["markets"] == {"generation-5": 1, "validated": 1}
    assert (found["violations"], found["lost"], found["paid_twice"]) == ([], 0, 0), said
    assert found["paid"] > 0


@pytest.mark.full
def test_a_job_ends_on_the_evm_too() -> None:
    found, said = simulate("--seed", "1", "--jobs", "1", "--only", "none", "--chain", "evm")
    assert (found["paid"] + found["refunded"], found["violations"]) == (1, []), said
    assert found["chains"] == {"evm": 1}


def test_the_seed_chooses_the_chain() -> None:
    deployments = Deployments()
    kinds = [deployments.kind(seed) for seed in range(20 * EVM_EVERY)]
    assert 5 < kinds.count(ON_EVM) < 60
    assert Deployments(ON_MODEL).kind(kinds.index(ON_EVM)) == ON_MODEL
    assert deployments.kind(kinds.index(ON_EVM), CROWDED_JOBS) == ON_MODEL


def test_a_history_is_the_same_alone_and_beside_another() -> None:
    options = ("--only", "delay,duplicate,late", "--chain", "model")
    beside = simulate("--seed", "30", "--jobs", "7", "--workers", "2", *options)[0]
    alone = simulate("--seed", "31", "--jobs", "1", *options)[0]
    assert beside["trace"] == alone["trace"]


@pytest.mark.full
def test_a_long_history_ends_too(tmp_path: Path) -> None:
    """It has blocks each 12 s, and perhaps more people, long pauses and long jobs."""
    summary = tmp_path / "summary.json"
    options = ("--history-jobs", "10", "--only", "drop", "--chain", "model", "--summary", str(summary))
    found, said = simulate("--seed", "301", "--jobs", "10", *options)
    assert (found["jobs"], found["violations"], found["lost"]) == (10, [], 0), said
    assert found["markets"]["more-people"] == found["markets"]["long-pauses"] == 1
    assert json.loads(summary.read_text()) == found


def test_all_jobs_of_a_crowded_market_end() -> None:
    """People have many orders open at a time, and blocks many transactions."""
    options = ("--history-jobs", "100", "--only", "drop,reorganise_every", "--chain", "model")
    found, said = simulate("--seed", "1", "--jobs", "100", *options)
    assert (found["jobs"], found["violations"], found["lost"]) == (100, [], 0), said
    assert found["markets"]["crowded"] == 1
    assert found["paid"] > 50
