"""Limits that strangers share: rates, queues and counts of drops."""

from __future__ import annotations

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mesh.base.flood import BoundedDict, Drops, FairQueue, Rate, RateLimiter, forget_oldest
from tests.support.clocks import SECOND, SetClock


def test_each_sender_has_a_share_and_all_have_a_total() -> None:
    clock = SetClock()
    limiter = RateLimiter(per_sender=Rate(1, 2), total=Rate(2, 3), clock=clock)
    assert [limiter.allow("a") for _ in range(3)] == [True, True, False]
    assert [limiter.allow("b"), limiter.allow("c")] == [True, False]  # the total is used up
    clock.pass_by(SECOND)
    assert [limiter.allow("a"), limiter.allow("a"), limiter.allow("c")] == [True, False, True]


@given(st.lists(st.tuples(st.sampled_from("abc"), st.floats(0, 5)), max_size=200))
def test_nobody_gets_more_than_the_rate(calls: list[tuple[str, float]]) -> None:
    clock = SetClock()
    begun = clock.monotonic()
    limiter = RateLimiter(per_sender=Rate(1, 2), total=Rate(2, 4), clock=clock)
    allowed = []
    for sender, wait in calls:
        clock.pass_by(int(wait * SECOND))
        if limiter.allow(sender):
            allowed.append(sender)
    passed = clock.monotonic() - begun
    assert len(allowed) <= 4 + 2 * passed + 1e-6
    assert all(allowed.count(sender) <= 2 + passed + 1e-6 for sender in "abc")


async def test_senders_are_served_in_turn_and_a_flood_displaces_itself() -> None:
    queue: FairQueue[str] = FairQueue(per_sender=3, total=4)
    assert [queue.put("flood", f"f{n}") for n in range(4)] == [[], [], [], ["f3"]]
    assert queue.put("alice", "a0") == []
    assert queue.put("bob", "b0") == ["f2"]
    assert [await queue.get() for _ in range(4)] == ["f0", "a0", "b0", "f1"]
    waiting = asyncio.ensure_future(queue.get())
    await asyncio.sleep(0)
    queue.put("bob", "b1")
    assert await waiting == "b1"


async def test_a_higher_priority_goes_first_and_the_lowest_is_dropped() -> None:
    queue: FairQueue[str] = FairQueue(per_sender=3, total=3)
    assert (queue.top, len(queue)) == (None, 0)
    for sender in ("f1", "f2", "f3"):
        queue.put(sender, sender)
    assert queue.put("alice", "a0", priority=7) == ["f1"]
    assert queue.put("f4", "f4", priority=-1) == ["f4"]
    assert queue.top == 7
    assert [queue.get_nowait() for _ in range(3)] == ["a0", "f2", "f3"]
    with pytest.raises(IndexError):
        queue.get_nowait()


async def test_a_batch_is_what_waits_up_to_a_limit() -> None:
    queue: FairQueue[int] = FairQueue(per_sender=9, total=9)
    for number in range(5):
        queue.put("alice", number)
    assert [await queue.get_batch(3), await queue.get_batch(3)] == [[0, 1, 2], [3, 4]]


@given(st.lists(st.tuples(st.sampled_from("abcd"), st.booleans(), st.integers(0, 2)), max_size=300))
def test_the_queue_stays_within_its_limits(steps: list[tuple[str, bool, int]]) -> None:
    queue: FairQueue[int] = FairQueue(per_sender=3, total=6)
    inside: set[int] = set()
    for number, (sender, takes, priority) in enumerate(steps):
        if takes and inside:
            inside.remove(queue.get_nowait())
        else:
            inside.add(number)
            inside.difference_update(queue.put(sender, number, priority=priority))
        assert len(queue) == len(inside) <= 6


def test_the_heaviest_senders_are_known_among_many() -> None:
    drops = Drops(senders=8)
    for number in range(1000):
        drops.count("garbage", f"fresh{number}")
        drops.count("garbage", "heavy")
    drops.count("too-large")
    assert drops.heaviest("garbage", 1)[0][0] == "heavy"
    assert drops.totals() == {"garbage": 2000, "too-large": 1}
    assert drops.report()
    assert not drops.report()


def test_a_bounded_dict_keeps_the_keys_that_were_set_last() -> None:
    kept: BoundedDict[str, int] = BoundedDict(2)
    kept["a"], kept["b"], kept["a"], kept["c"] = 1, 2, 3, 4

    assert dict(kept) == {"a": 3, "c": 4}


def test_the_oldest_keys_are_forgotten_and_half_of_the_limit_is_kept() -> None:
    kept: dict[int, int] = {}
    for number in range(100):
        kept[number] = -number
        forget_oldest(kept, 10)
        assert all(one in kept for one in range(max(0, number - 4), number + 1))
        assert len(kept) <= 10
