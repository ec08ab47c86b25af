from __future__ import annotations

from mesh.recording import Played, rates_of
from schemas.payloads import RAW


def at(topic: str, *times: int) -> list[Played]:
    return [Played(topic, b"", time, time, 0, RAW) for time in times]


def test_messages_are_counted_in_equal_spans_from_the_first_to_the_last() -> None:
    messages = at("/a", 100, 101, 149, 150, 199, 200) + at("/b", 200)
    rates = rates_of(messages, start_ns=100, duration_ns=100, spans=2)
    assert rates.counts == {"/a": [4, 2], "/b": [0, 1]}
    assert rates.span_ns == 51


def test_a_single_moment_is_one_span() -> None:
    rates = rates_of(at("/a", 7, 7), start_ns=7, duration_ns=0, spans=4)
    assert rates.counts == {"/a": [2, 0, 0, 0]}


def test_counts_become_messages_a_second() -> None:
    rates = rates_of(at("/a", 0, 1, 999_999_999), start_ns=0, duration_ns=999_999_999, spans=2)
    assert rates.per_second("/a") == [4.0, 2.0]
