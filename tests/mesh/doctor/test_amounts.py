"""Amounts as the doctor asks for them: enough, however little it is."""

from __future__ import annotations

import pytest

from mesh.doctor.account import ETH, XRT, at_least


@pytest.mark.parametrize(
    ("wei", "asked"),
    [(1, "0.000000001 ETH"), (1_000_000_001, "0.000000002 ETH"), (10**18, "1 ETH"), (5 * 10**14, "0.0005 ETH")],
)
def test_what_is_asked_for_is_never_less_than_what_is_needed(wei: int, asked: str) -> None:
    assert at_least(wei, ETH) == asked


def test_a_coin_with_few_decimals_is_asked_for_exactly() -> None:
    assert at_least(1_500_000_001, XRT) == "1.500000001 XRT"
