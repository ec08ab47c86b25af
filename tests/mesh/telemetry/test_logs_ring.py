"""The last events of a process: bounded, numbered, read on from anywhere."""

from __future__ import annotations

import pytest

from mesh.errors import InputError
from mesh.telemetry.ring import Ring
from schemas.logs import LogEvent, LogsRead, ReadLogs
from schemas.records import MAX_RECORD_SIZE
from tests.support.orders import ROBOT, STRANGER


def event(message: str = "x", *, level: str = "info", liability: str = "", address: str = "") -> LogEvent:
    time = "2026-01-01T00:00:00.000Z"
    return LogEvent(time=time, level=level, logger="t", message=message, liability=liability, address=address)


def filled(count: int, ring: Ring | None = None) -> Ring:
    ring = Ring() if ring is None else ring
    for number in range(1, count + 1):
        ring.add(event(f"event {number}"))
    return ring


def words(reply: LogsRead) -> list[str]:
    return [entry.message for entry in reply.entries]


def test_the_oldest_make_room_by_number() -> None:
    ring = filled(30, Ring(most=10))
    assert len(ring) == 10
    assert words(ring.read(ReadLogs())) == [f"event {number}" for number in range(21, 31)]


def test_the_oldest_make_room_by_bytes() -> None:
    ring = Ring(most_bytes=5_000)
    for _ in range(50):
        ring.add(event("x" * 900))
    assert 3_000 < ring.size <= 5_000
    assert len(ring) == 5
    assert ring.size == sum(len(entry.encode()) for entry in ring.read(ReadLogs()).entries)


def test_events_are_numbered_from_one_on() -> None:
    reply = filled(3).read(ReadLogs())
    assert [entry.sequence for entry in reply.entries] == [1, 2, 3]
    assert reply.last == 3


def test_who_comes_first_gets_the_newest() -> None:
    ring = filled(10)
    assert words(ring.read(ReadLogs(lines=2))) == ["event 9", "event 10"]
    nothing = ring.read(ReadLogs(lines=0))
    assert (nothing.entries, nothing.last, nothing.missed) == ((), 10, 0)


def test_who_comes_again_gets_what_is_new() -> None:
    ring = filled(3)
    last = ring.read(ReadLogs()).last
    filled(2, ring)
    reply = ring.read(ReadLogs(after={ring.instance: last}, lines=1))
    assert (words(reply), reply.last, reply.missed) == (["event 1", "event 2"], 5, 0)
    assert ring.read(ReadLogs(after={ring.instance: 5})).entries == ()


def test_what_fell_out_meanwhile_is_counted() -> None:
    ring = filled(4, Ring(most=10))
    filled(16, ring)
    reply = ring.read(ReadLogs(after={ring.instance: 4}))
    assert (len(reply.entries), reply.missed, reply.entries[0].sequence) == (10, 6, 11)


def test_a_number_of_another_run_means_nothing() -> None:
    reply = filled(5).read(ReadLogs(after={"another run": 4}))
    assert (len(reply.entries), reply.missed) == (5, 0)


def test_a_reply_is_no_longer_than_a_record_may_be_and_the_next_goes_on() -> None:
    ring = Ring()
    seen: list[int] = []
    after: dict[str, int] = {}
    for number in range(200):
        ring.add(event(f"{number} " + "é" * 1_000))
    while True:
        reply = ring.read(ReadLogs(after=after, lines=200))
        assert LogsRead.decode(reply.encode()) == reply
        assert len(reply.encode()) <= MAX_RECORD_SIZE
        seen += [entry.sequence for entry in reply.entries]
        after = {ring.instance: reply.last}
        if not reply.more:
            break
    assert seen == list(range(1, 201))


def test_a_level_and_a_contract_select() -> None:
    ring = Ring()
    for level in ("debug", "info", "warning", "error", "critical"):
        ring.add(event(level, level=level, liability=ROBOT.address))
    ring.add(event("another's", level="error", liability=STRANGER.address))
    assert words(ring.read(ReadLogs(level="warning", liability=ROBOT.address.lower()))) == [
        "warning",
        "error",
        "critical",
    ]
    assert words(ring.read(ReadLogs(lines=1, level="error", liability=ROBOT.address))) == ["critical"]


def test_what_is_filtered_out_is_passed_over() -> None:
    ring = filled(5)
    reply = ring.read(ReadLogs(level="error"))
    assert (reply.entries, reply.last, reply.more) == ((), 5, False)


def test_of_a_process_with_several_accounts_each_tells_its_own() -> None:
    ring = Ring()
    for message, address in (("mine", ROBOT.address), ("another's", STRANGER.address), ("of all", "")):
        ring.add(event(message, address=address))
    assert words(ring.read(ReadLogs(), address=ROBOT.address)) == ["mine", "of all"]
    assert len(ring.read(ReadLogs()).entries) == 3


def test_a_level_that_there_is_not_is_named() -> None:
    with pytest.raises(InputError, match="'loud' is no level"):
        Ring().read(ReadLogs(level="loud"))


def test_two_runs_have_different_names() -> None:
    assert Ring().instance != Ring().instance
