"""Own frames from the host's side, with a board that the test plays and a clock that it sets."""

from __future__ import annotations

import msgspec
import pytest

from bridges.serial.dialect import (
    QUEUE_SIZE,
    BoardLost,
    BoardReady,
    CallStatus,
    Command,
    CommandFinished,
    Flow,
    LineCounters,
    MessageReceived,
)
from bridges.serial.errors import BoardBusy, InvalidBoardMessage
from bridges.serial.frames import BOARD_ID, Frame, FrameDecoder, FrameKind, encode_frame
from bridges.serial.frames_dialect import LOST, FramesDialect

SESSION = 7
TOPICS = ([True, "/echo", "json"], [False, "said", "std_msgs/String"], [True, "/lamp", "std_msgs/Empty"])


class Bench:
    """The dialect, and what a board would do."""

    def __init__(self) -> None:
        self.now = 100.0
        self.dialect = FramesDialect(baud=57_600, session=SESSION)
        self.session = 0
        self._line = FrameDecoder(LineCounters())

    def open(self) -> None:
        """Open the line and answer all the questions by which a host gets to know a board."""
        self.dialect.opened(self.now)
        while frames := self.heard():
            for frame in frames:
                self.introduce(frame)

    def heard(self) -> list[Frame]:
        """What the host has sent."""
        return self._line.feed(self.dialect.outgoing())

    def say(self, kind: FrameKind, sequence: int, topic: int, payload: bytes = b"") -> None:
        """A frame of the board's."""
        self.dialect.receive(encode_frame(Frame(kind, sequence, topic, payload)), self.now)

    def introduce(self, frame: Frame) -> None:
        """The board's answer to a question."""
        match frame.kind, frame.id:
            case FrameKind.ASK, id if id == BOARD_ID:
                about = msgspec.msgpack.encode([1, "echo", "1.0", self.session, len(TOPICS)])
                self.say(FrameKind.BOARD, frame.sequence, BOARD_ID, about)
            case FrameKind.ASK, topic:
                self.say(FrameKind.TOPIC, frame.sequence, topic, msgspec.msgpack.encode(TOPICS[topic]))
            case FrameKind.OPEN, _:
                self.session = int.from_bytes(frame.payload, "little")
                self.say(FrameKind.OPENED, frame.sequence, BOARD_ID)

    def after(self, seconds: float) -> list[Frame]:
        """Let time pass; what the host sends."""
        self.now += seconds
        self.dialect.tick(self.now)
        return self.heard()

    def call(self, topic: str = "/echo", payload: bytes = b"1", seconds: float = 30.0) -> Command:
        """A new call."""
        command = Command(topic, payload, self.now + seconds)
        self.dialect.submit(command, self.now)
        return command

    def ended(self) -> list[CommandFinished]:
        """The calls that have come to their end."""
        return [each for each in self.dialect.events() if isinstance(each, CommandFinished)]


@pytest.fixture
def bench() -> Bench:
    """A board that is known and ready."""
    bench = Bench()
    bench.open()
    bench.dialect.events()
    return bench


def test_a_board_says_what_it_is() -> None:
    bench = Bench()
    bench.open()
    [ready] = bench.dialect.events()
    assert isinstance(ready, BoardReady)
    assert (ready.info.name, ready.info.version) == ("echo", "1.0")
    assert [(each.name, each.flow) for each in ready.info.topics] == [
        ("/echo", Flow.SUBSCRIBES),
        ("/said", Flow.PUBLISHES),
        ("/lamp", Flow.SUBSCRIBES),
    ]
    assert bench.session == SESSION


def test_questions_are_asked_again_until_they_are_answered() -> None:
    bench = Bench()
    bench.dialect.opened(bench.now)
    first = bench.heard()
    again = bench.after(0.5)
    assert first == again
    assert bench.dialect.counters.repeated == 1


def test_a_call_ends_with_what_the_board_answers(bench: Bench) -> None:
    command = bench.call(payload=b'{"a":[1,2.5]}')
    [frame] = bench.heard()
    assert (frame.kind, frame.id) == (FrameKind.CALL, 0)
    assert msgspec.msgpack.decode(frame.payload) == {"a": [1, 2.5]}
    bench.say(FrameKind.DONE, frame.sequence, 0, msgspec.msgpack.encode("well"))
    [ended] = bench.ended()
    assert (ended.command, ended.status, ended.payload) == (command, CallStatus.DONE, b'"well"')


def test_a_call_that_is_not_answered_is_repeated_as_the_same(bench: Bench) -> None:
    bench.call()
    [first] = bench.heard()
    assert bench.after(0.2) == [first]
    assert bench.after(1.0) == [first]


def test_one_call_is_under_way_at_a_time(bench: Bench) -> None:
    bench.call(payload=b"1")
    bench.call(payload=b"2")
    [first] = bench.heard()
    bench.say(FrameKind.DONE, first.sequence, 0)
    [second] = bench.heard()
    assert (second.payload, second.sequence) == (b"\x02", (first.sequence + 1) % 16)


def test_a_late_answer_to_an_earlier_call_is_not_the_answer_to_this_one(bench: Bench) -> None:
    bench.call(payload=b"1")
    [first] = bench.heard()
    bench.say(FrameKind.DONE, first.sequence, 0)
    bench.call(payload=b"2")
    bench.heard()
    bench.ended()
    bench.say(FrameKind.DONE, first.sequence, 0)
    assert bench.ended() == []
    assert bench.dialect.counters.stray == 1


def test_what_the_board_refuses_is_told_with_its_reason(bench: Bench) -> None:
    bench.call()
    [frame] = bench.heard()
    bench.say(FrameKind.FAILED, frame.sequence, 0, msgspec.msgpack.encode("too hot"))
    [ended] = bench.ended()
    assert (ended.status, ended.reason, ended.detail) == (CallStatus.FAILED, "refused", "too hot")


def test_a_restart_leaves_the_call_under_way_in_doubt_and_the_next_one_waits(bench: Bench) -> None:
    bench.call(payload=b"1")
    bench.call(payload=b"2")
    bench.heard()
    bench.session = 0
    bench.say(FrameKind.BOARD, 0, BOARD_ID, msgspec.msgpack.encode([1, "echo", "1.0", 0, len(TOPICS)]))
    happened = bench.dialect.events()
    assert [type(each) for each in happened] == [CommandFinished, BoardLost]
    assert isinstance(happened[0], CommandFinished)
    assert happened[0].reason == "doubt"
    frames = bench.heard()
    while frames and frames[0].kind is not FrameKind.CALL:
        bench.introduce(frames[0])
        frames = bench.heard()
    assert frames[0].payload == b"\x02"


def test_a_board_that_ran_on_while_the_cable_was_out_is_asked_for_the_same_call(bench: Bench) -> None:
    bench.call()
    [call] = bench.heard()
    bench.dialect.closed(bench.now)
    bench.after(5.0)
    bench.open()
    assert [type(each) for each in bench.dialect.events()] == [BoardLost, BoardReady]
    bench.after(1.0)
    bench.say(FrameKind.DONE, call.sequence, 0)
    assert [ended.status for ended in bench.ended()] == [CallStatus.DONE]


def test_a_call_that_was_never_begun_expires_and_one_that_was_is_in_doubt(bench: Bench) -> None:
    begun, waiting = bench.call(seconds=2.0), bench.call(seconds=1.0)
    bench.after(3.0)
    reasons = {ended.command: ended.reason for ended in bench.ended()}
    assert reasons == {begun: "doubt", waiting: "expired"}


def test_after_a_call_in_doubt_a_new_session_begins_so_that_its_number_is_no_other_calls(bench: Bench) -> None:
    bench.call(seconds=1.0)
    bench.heard()
    frames = bench.after(2.0)
    bench.call(payload=b"2")
    while frames and frames[-1].kind is not FrameKind.CALL:
        bench.introduce(frames[-1])
        frames = bench.heard()
    assert bench.session == SESSION + 1
    assert frames[-1].payload == b"\x02"


def test_a_board_at_work_is_asked_seldom(bench: Bench) -> None:
    bench.call()
    [frame] = bench.heard()
    bench.say(FrameKind.TAKEN, frame.sequence, 0)
    assert bench.after(0.2) == []
    assert bench.after(0.1) == [frame]


def test_a_silent_board_is_asked_and_then_gone(bench: Bench) -> None:
    assert [frame.id for frame in bench.after(2.5)] == [BOARD_ID]
    bench.after(LOST)
    assert [type(each) for each in bench.dialect.events()] == [BoardLost]


def test_events_arrive_and_gaps_in_them_are_counted(bench: Bench) -> None:
    for sequence in (14, 15, 2):
        bench.say(FrameKind.EVENT, sequence, 1, msgspec.msgpack.encode("hi"))
    said = [each for each in bench.dialect.events() if isinstance(each, MessageReceived)]
    assert [each.payload for each in said] == [b"\x02\0\0\0hi"] * 3
    assert bench.dialect.counters.missed == 2


def test_an_event_that_is_not_of_its_type_is_counted_and_not_told(bench: Bench) -> None:
    bench.say(FrameKind.EVENT, 0, 1, msgspec.msgpack.encode(5))
    bench.say(FrameKind.EVENT, 1, 0, b"")
    assert bench.dialect.events() == []
    assert (bench.dialect.counters.refused, bench.dialect.counters.stray) == (1, 1)


def test_what_does_not_fit_is_never_sent(bench: Bench) -> None:
    bench.call(payload=b'"' + b"x" * 100 + b'"')
    bench.call(payload=b"{")
    bench.call("/lamp", b"1")
    assert [ended.reason for ended in bench.ended()] == ["unfit"] * 3
    with pytest.raises(InvalidBoardMessage):
        bench.call("/said")
    assert bench.heard() == []


@pytest.mark.parametrize("payload", [b"", b"\x91\x01", b"\x95\x02\xa1a\xa1b\x00\x00", b"\xc1"])
def test_a_board_that_makes_no_sense_is_not_taken_for_one(payload: bytes) -> None:
    bench = Bench()
    bench.dialect.opened(bench.now)
    [ask] = bench.heard()
    bench.say(FrameKind.BOARD, ask.sequence, BOARD_ID, payload)
    assert bench.dialect.events() == []
    assert bench.dialect.counters.refused == 1


def test_calls_beyond_those_that_are_kept_are_refused_and_none_of_the_others_is_lost(bench: Bench) -> None:
    for _ in range(QUEUE_SIZE + 1):  # one is under way
        bench.call()
    with pytest.raises(BoardBusy):
        bench.call()
    assert bench.ended() == []
