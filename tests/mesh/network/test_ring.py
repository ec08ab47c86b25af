"""The ring of received samples: its bounds, and the second chance of what is sent again."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from mesh.network.pump import RING_LIMITS, ReceiveRing


def ring(capacity: int = 4, capacity_bytes: int = 1000, *, second_chance: bool = True) -> ReceiveRing:
    return ReceiveRing(capacity, capacity_bytes, second_chance=second_chance)


def fill(waiting: ReceiveRing, *items: Any, size: int = 1) -> int:
    return waiting.extend(items, [size] * len(items))


def test_the_oldest_are_dropped_beyond_the_number_and_the_bytes() -> None:
    waiting = ring(second_chance=False)
    assert fill(waiting, *range(6)) == 2
    assert waiting.take(10) == [2, 3, 4, 5]

    assert fill(waiting, *range(6), size=400) == 4
    assert waiting.take(10) == [4, 5]
    assert fill(waiting, "larger than the ring", size=2000) == 0
    assert waiting.take(10) == ["larger than the ring"]
    assert len(waiting) == 0


def test_a_copy_goes_first_while_the_first_waits_or_was_dropped() -> None:
    waiting = ring(8)
    fill(waiting, "dropped", 1, "waits", *range(3, 9))
    assert fill(waiting, "dropped", "waits") == 0, "they displace nothing"

    assert waiting.take(2) == ["waits", 1]
    assert waiting.take(3) == ["dropped", "waits", 3]


def test_first_and_second_copies_get_the_same_share_and_what_others_leave() -> None:
    waiting = ring(16)
    fill(waiting, *range(8))
    fill(waiting, *range(4))

    assert waiting.take(4) == [3, 2, 0, 1]
    assert waiting.take(6) == [1, 0, 2, 3, 4, 5]
    assert waiting.take(40) == [6, 7]


def test_an_honest_message_passes_any_flood_of_new_ones_with_its_second_copy() -> None:
    waiting, passed = ring(64), []
    for number in range(1000):
        if number in (100, 120):
            fill(waiting, "honest")
        fill(waiting, *((number, each) for each in range(100)))
        passed += waiting.take(20)

    assert passed.count("honest") == 1


def test_an_honest_message_passes_a_flood_of_second_copies_with_its_third() -> None:
    waiting, passed = ring(64), []
    for number in range(1000):
        if number in (100, 110, 130):
            fill(waiting, "honest")
        for _ in range(2):
            fill(waiting, *((number, each) for each in range(50)))
        passed += waiting.take(20)

    assert passed.count("honest") == 1


def test_what_a_flood_of_new_messages_has_left_behind_delays_nobody() -> None:
    waiting = ring(2 * RING_LIMITS.in_order, 4 * RING_LIMITS.in_order)
    fill(waiting, *range(RING_LIMITS.in_order))
    fill(waiting, "honest")

    assert waiting.take(1) == ["honest"]
    assert waiting.take(2) == [0, 1], "in order again"


def test_what_nobody_sends_again_arrives_in_order() -> None:
    waiting = ring(2 * RING_LIMITS.in_order, 4 * RING_LIMITS.in_order, second_chance=False)
    fill(waiting, *range(2 * RING_LIMITS.in_order))

    assert waiting.take(2) == [0, 1]


def test_dropped_items_are_forgotten_after_a_while() -> None:
    waiting = ring(1)
    fill(waiting, "old", *range(RING_LIMITS.remembered + 2))

    assert len(waiting._copies) <= RING_LIMITS.remembered
    fill(waiting, "old")
    assert waiting.take(1) == ["old"], "the only one in the ring, in place of the last"
    assert len(waiting) == 0


def test_without_second_chance_items_need_no_hash() -> None:
    waiting = ring(1, second_chance=False)
    assert fill(waiting, [1], [2], [1]) == 2
    assert waiting.take(2) == [[1]]


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 600)) | st.integers(1, 5)))
def test_nothing_is_lost_but_what_is_counted_and_the_bounds_hold(steps: list[Any]) -> None:
    waiting, added, taken, dropped = ring(), 0, 0, 0
    for step in steps:
        if isinstance(step, tuple):
            added += 1
            dropped += waiting.extend(*zip(step, strict=True))
        else:
            taken += len(waiting.take(step))
        assert len(waiting) <= 8
        assert added == taken + dropped + len(waiting)
