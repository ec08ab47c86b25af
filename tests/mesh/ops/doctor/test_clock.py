"""Clocks: which differences pass, and the reports of larger ones."""

from __future__ import annotations

import pytest

from mesh.ops.doctor._machine import compare_chain_clock, compare_clock, duration

NOW = 1_800_000_000.0


@pytest.mark.parametrize("ahead", [-4.9, 0.0, 4.9])
def test_a_difference_of_some_seconds_passes(ahead: float) -> None:
    assert compare_clock(NOW - ahead, NOW, whose="the router's").ok


@pytest.mark.parametrize(
    ("ahead", "words"), [(7_300.0, "2 hours ahead of"), (-600.0, "10 minutes behind"), (9.0, "9 s ahead of")]
)
def test_a_larger_difference_fails_with_its_size_and_direction(ahead: float, words: str) -> None:
    result = compare_clock(NOW - ahead, NOW, whose="the router's")
    assert not result.ok
    assert result.code == "clock-off"
    assert f"{words} the router's clock" in result.message


def test_a_block_from_the_future_means_a_clock_that_is_behind() -> None:
    result = compare_chain_clock(NOW + 2 * 86_400, NOW)
    assert result.code == "clock-behind"
    assert "2 days" in result.message
    assert not compare_chain_clock(NOW + 31, NOW).ok
    assert compare_chain_clock(NOW + 29, NOW).ok


def test_an_old_block_is_no_evidence_about_the_clock() -> None:
    result = compare_chain_clock(NOW - 7_200, NOW)
    assert result.code == "block-too-old"
    assert "2 hours" in result.message


def test_durations_are_printed_in_a_readable_unit() -> None:
    assert [duration(seconds) for seconds in (0.4, 90, 150, 7_300, 3 * 86_400)] == [
        "0 s",
        "90 s",
        "2 minutes",
        "2 hours",
        "3 days",
    ]
