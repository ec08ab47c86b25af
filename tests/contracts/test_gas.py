"""The bars that transactions must stay below."""

from __future__ import annotations

import pytest

from mesh.cli.chain import STEPS
from tests.support.contracts.gas import GENERATIONS, ROWS, Gas, exceeded, measure

WITHOUT_PERMITS = {
    "create_cost_0": (140_991, 184_372),
    "create_cost": (163_327, 206_699),
    "create_cost_fee": (183_059, 226_448),
    "finalize_cost_0": (82_926, 84_084),
    "finalize_cost": (111_601, 112_747),
    "refund": (78_864, 78_409),
}
"""Gas in generations 5 and 3 of contracts that know no permits."""


@pytest.fixture(scope="module")
def gas() -> Gas:
    return measure()


def test_every_transaction_stays_below_its_bar(gas: Gas) -> None:
    assert exceeded(gas) == []


def test_jobs_without_permits_do_not_pay_for_them(gas: Gas) -> None:
    for key, most in WITHOUT_PERMITS.items():
        for column, bar in zip(GENERATIONS.values(), most, strict=True):
            assert gas[key][column] <= bar, (key, column)


def test_a_job_with_a_permit_takes_at_most_290_000(gas: Gas) -> None:
    assert gas["create_permit"]["generation_5"] + gas["finalize_cost"]["generation_5"] <= 290_000


def test_a_bar_that_is_missed_is_named() -> None:
    gas = {key: {"generation_5": 0, "generation_3": 0} for key in ROWS}
    gas["finalize_cost"]["generation_3"] = 115_001
    assert exceeded(gas) == ["finalize_cost, generation_3: 115,001 is above the bar of 115,000"]


def test_the_costs_that_people_are_shown_are_those_measured(gas: Gas) -> None:
    for step in STEPS:
        for generation, column in GENERATIONS.items():
            assert step.gas_in(generation) == pytest.approx(gas[step.name][column], rel=0.01), step.name
