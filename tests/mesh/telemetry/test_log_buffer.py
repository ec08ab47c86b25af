"""The last events of a process: bounded, numbered, read on from anywhere."""

from __future__ import annotations

from mesh.telemetry.logs import LogBuffer
from schemas.records import MAX_RECORD_SIZE
from schemas.status import LogEvent, LogsRead, ReadLogs
from tests.support.orders import ROBOT, STRANGER


def event(message: str = "x", *, level: str = "info", liability: str = "", address: str = "") -> LogEvent:
    time = "2026-01-01T00:00:00.000Z"
    return LogEvent(time=time, level=level, logger="t", message=message, liability=liability, address=address)


def filled(count: int, buffer: LogBuffer | None = None) -> LogBuffer:
    buffer = LogBuffer() if buffer is None else buffer
    for number in range(1, count + 1):
        buffer.add(event(f"event {number}"))
    return buffer


def words(reply: LogsRead) -> list[str]:
    return [entry.message for entry in reply.entries]


def test_the_oldest_events_are_dropped_beyond_the_number() -> None:
    buffer = filled(30, LogBuffer(max_events=10))
    assert len(buffer) == 10
    assert words(buffer.read(ReadLogs())) == [f"event {number}" for number in range(21, 31)]


def test_the_oldest_events_are_dropped_beyond_the_bytes() -> None:
    buffer = LogBuffer(max_bytes=5_000)
    for _ in range(50):
        buffer.add(event("x" * 900))
    assert 3_000 < buffer.size <= 5_000
    assert len(buffer) == 5
    assert buffer.size == sum(len(entry.encode()) for entry in buffer.read(ReadLogs()).entries)


def test_events_are_numbered_from_one_on() -> None:
    reply = filled(3).read(ReadLogs())
    assert [entry.sequence for entry in reply.entries] == [1, 2, 3]
    assert reply.last == 3


def test_a_first_read_gets_the_newest_events() -> None:
    buffer = filled(10)
    assert words(buffer.read(ReadLogs(lines=2))) == ["event 9", "event 10"]
    nothing = buffer.read(ReadLogs(lines=0))
    assert (nothing.entries, nothing.last, nothing.missed) == ((), 10, 0)


def test_a_later_read_gets_the_new_events() -> None:
    buffer = filled(3)
    last = buffer.read(ReadLogs()).last
    filled(2, buffer)
    reply = buffer.read(ReadLogs(after={buffer.instance: last}, lines=1))
    assert (words(reply), reply.last, reply.missed) == (["event 1", "event 2"], 5, 0)
    assert buffer.read(ReadLogs(after={buffer.instance: 5})).entries == ()


def test_events_dropped_between_two_reads_are_counted() -> None:
    buffer = filled(4, LogBuffer(max_events=10))
    filled(16, buffer)
    reply = buffer.read(ReadLogs(after={buffer.instance: 4}))
    assert (len(reply.entries), reply.missed, reply.entries[0].sequence) == (10, 6, 11)


def test_the_sequence_number_of_another_run_is_ignored() -> None:
    reply = filled(5).read(ReadLogs(after={"another run": 4}))
    assert (len(reply.entries), reply.missed) == (5, 0)


def test_a_reply_fits_into_a_record_and_the_next_continues() -> None:
    buffer = LogBuffer()
    seen: list[int] = []
    after: dict[str, int] = {}
    for number in range(200):
        buffer.add(event(f"{number} " + "é" * 1_000))
    while True:
        reply = buffer.read(ReadLogs(after=after, lines=200))
        assert LogsRead.decode(reply.encode()) == reply
        assert len(reply.encode()) <= MAX_RECORD_SIZE
        seen += [entry.sequence for entry in reply.entries]
        after = {buffer.instance: reply.last}
        if not reply.more:
            break
    assert seen == list(range(1, 201))


def test_a_level_and_a_contract_select() -> None:
    buffer = LogBuffer()
    for level in ("debug", "info", "warning", "error", "critical"):
        buffer.add(event(level, level=level, liability=ROBOT.address))
    buffer.add(event("another's", level="error", liability=STRANGER.address))
    assert words(buffer.read(ReadLogs(level="warning", liability=ROBOT.address.lower()))) == [
        "warning",
        "error",
        "critical",
    ]
    assert words(buffer.read(ReadLogs(lines=1, level="error", liability=ROBOT.address))) == ["critical"]


def test_events_that_are_filtered_out_count_as_read() -> None:
    buffer = filled(5)
    reply = buffer.read(ReadLogs(level="error"))
    assert (reply.entries, reply.last, reply.more) == ((), 5, False)


def test_each_account_of_a_process_serves_its_own_events() -> None:
    buffer = LogBuffer()
    for message, address in (("mine", ROBOT.address), ("another's", STRANGER.address), ("of all", "")):
        buffer.add(event(message, address=address))
    assert words(buffer.read(ReadLogs(), address=ROBOT.address)) == ["mine", "of all"]
    assert len(buffer.read(ReadLogs()).entries) == 3


def test_two_runs_have_different_names() -> None:
    assert LogBuffer().instance != LogBuffer().instance
