"""Amounts as people write them and read them."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mesh.amounts import ETH, UNLIMITED, XRT, Unit
from mesh.errors import InputError

PENNY = Unit("PNY", 2)
POINT = Unit("POINT", 0)


@pytest.mark.parametrize(
    ("unit", "text", "amount"),
    [
        (XRT, "1", 10**9),
        (XRT, "1.5", 1_500_000_000),
        (XRT, "1.5 XRT", 1_500_000_000),
        (XRT, "1.5xrt", 1_500_000_000),
        (XRT, ".5", 500_000_000),
        (XRT, "0.000000001", 1),
        (XRT, "1.50000000000000000", 1_500_000_000),
        (XRT, "1500000000wn", 1_500_000_000),
        (XRT, "7 units", 7),
        (XRT, "7.0wn", 7),
        (XRT, "1_000", 1_000 * 10**9),
        (XRT, "0", 0),
        (ETH, "0.1", 10**17),
        (ETH, "3wei", 3),
        (PENNY, "0.25", 25),
        (POINT, "3", 3),
        (POINT, str(UNLIMITED), UNLIMITED),
    ],
)
def test_an_amount_is_read(unit: Unit, text: str, amount: int) -> None:
    assert unit.parse(text) == amount


@pytest.mark.parametrize(
    ("unit", "text", "words"),
    [
        (XRT, "", "is not an amount"),
        (XRT, "-1", "is not an amount"),
        (XRT, "1,5", "is not an amount"),
        (XRT, "1.", "is not an amount"),
        (XRT, "1e9", "is not an amount"),
        (XRT, "\N{ARABIC-INDIC DIGIT ONE}", "is not an amount"),
        (XRT, "nan", "is not an amount"),
        (XRT, "5 ETH", "is not an amount of XRT"),
        (XRT, "5 wei", "is not an amount of XRT"),
        (PENNY, "5wn", "is not an amount of PNY"),
        (XRT, "0.0000000001", "has more than 9 decimals"),
        (XRT, "1.5wn", "has more than 0 decimals"),
        (PENNY, "0.125", "has more than 2 decimals"),
        (POINT, str(UNLIMITED + 1), "is more than a contract can store"),
    ],
)
def test_an_invalid_amount_is_refused_with_an_example(unit: Unit, text: str, words: str) -> None:
    with pytest.raises(InputError) as refused:
        unit.parse(text)
    assert words in str(refused.value)
    assert ("1.5" if unit.decimals else "2units") in refused.value.hint


@pytest.mark.parametrize(
    ("unit", "amount", "text"),
    [
        (XRT, 0, "0 XRT"),
        (XRT, 1, "0.000000001 XRT"),
        (XRT, 1_500_000_000, "1.5 XRT"),
        (XRT, 1_000_000 * 10**9, "1,000,000 XRT"),
        (ETH, 10**18 + 1, "1.000000000000000001 ETH"),
        (POINT, 1_234, "1,234 POINT"),
        (XRT, UNLIMITED, "unlimited XRT"),
    ],
)
def test_an_amount_is_shown_with_all_its_digits(unit: Unit, amount: int, text: str) -> None:
    assert unit.show(amount) == text


@given(amount=st.integers(0, UNLIMITED - 1), decimals=st.integers(0, 30))
def test_a_printed_amount_is_read_as_the_same_amount(amount: int, decimals: int) -> None:
    unit = Unit("TKN", decimals)
    assert unit.parse(unit.show(amount).replace(",", "")) == amount


@pytest.mark.parametrize("unit", [XRT, ETH, Unit("USDT", 6), Unit("ONE", 1)])
def test_the_hint_writes_one_amount_in_two_ways(unit: Unit) -> None:
    found = re.fullmatch(r"one and a half \w+ is ([\d.]+), or (\w+)", unit.hint())
    assert found
    assert unit.parse(found[1]) == unit.parse(found[2]) == 15 * 10**unit.decimals // 10


def test_the_hint_for_a_token_without_decimals_has_whole_numbers() -> None:
    assert POINT.hint() == "two POINT are 2, or 2units"
    assert POINT.parse("2") == POINT.parse("2units") == 2
