"""The bars that transactions must stay below."""

from __future__ import annotations

import pytest

from mesh.chain.costs import STEPS
from tests.contracts.gas import GENERATIONS, ROWS, exceeded, measure


def test_every_transaction_stays_below_its_bar() -> None:
    assert exceeded(measure()) == []


def test_a_bar_that_is_missed_is_named() -> None:
    gas = {key: {"generation_5": 0, "generation_3": 0} for key in ROWS}
    gas["finalize_cost"]["generation_3"] = 115_001
    assert exceeded(gas) == ["finalize_cost, generation_3: 115,001 is above the bar of 115,000"]


def test_the_costs_that_people_are_shown_are_those_measured() -> None:
    gas = measure()
    for step in STEPS:
        for generation, column in GENERATIONS.items():
            assert step.gas_in(generation) == pytest.approx(gas[step.name][column], rel=0.01), step.name
