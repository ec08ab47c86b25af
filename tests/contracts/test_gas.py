"""The bars that transactions must stay below."""

from __future__ import annotations

from tests.contracts.gas import ROWS, exceeded, measure


def test_every_transaction_stays_below_its_bar() -> None:
    assert exceeded(measure()) == []


def test_a_bar_that_is_missed_is_named() -> None:
    gas = {key: {"generation_5": 0, "generation_3": 0} for key in ROWS}
    gas["finalize_cost"]["generation_3"] = 115_001
    assert exceeded(gas) == ["finalize_cost, generation_3: 115,001 is above the bar of 115,000"]
