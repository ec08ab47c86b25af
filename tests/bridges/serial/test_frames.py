"""Our own frames: the codec, and the dialect, with a board played by the test and a clock that it sets."""

from __future__ import annotations

import re

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridges.serial.dialect import (
    COMMAND_LIMITS,
    BoardLost,
    BoardReady,
    CallStatus,
    Command,
    CommandFinished,
    CommandRefused,
    Flow,
    LineCounters,
    MessageReceived,
)
from bridges.serial.frames import (
    FRAME,
    FRAMES_PACE,
    Frame,
    FrameDecoder,
    FrameKind,
    FramesDialect,
    crc16,
    decode_frame,
    encode_frame,
)
from tests.support.content import ROOT
from tests.support.raising import raises_with

frames = st.builds(
    Frame, st.sampled_from(FrameKind), st.integers(0, 15), st.integers(0, 255), st.binary(max_size=FRAME.payload)
)


def test_the_library_and_the_specification_have_the_same_kinds() -> None:
    kinds = {kind.name: kind.value for kind in FrameKind}
    library = (ROOT / "examples/firmware/AiraFrames/src/AiraFrames.h").read_text()
    listed = library.partition("enum Kind")[2].partition("}")[0]
    assert {name: int(value) for name, value in re.findall(r"(\w+) = (\d+)", listed)} == kinds
    page = (ROOT / "docs/reference/frames.md").read_text().partition("## Kinds")[2]
    assert {name: int(value) for value, name in re.findall(r"\| (\d+) \| (?:host|board) \| (\w+)", page)} == kinds


def test_the_checksum_is_crc_16_ccitt_false() -> None:
    assert crc16(b"123456789") == 0x29B1


def test_a_frame_is_encoded_as_in_its_specification() -> None:
    assert encode_frame(Frame(FrameKind.CALL, 1, 0, b"\xa3red")).hex(" ") == "02 31 07 a3 72 65 64 03 7b 00"


@given(st.lists(frames, max_size=5), st.integers(1, 40))
def test_frames_are_found_again_in_pieces_of_any_size(sent: list[Frame], size: int) -> None:
    line = b"".join(map(encode_frame, sent))
    decoder = FrameDecoder(LineCounters())
    found = [frame for start in range(0, len(line), size) for frame in decoder.feed(line[start : start + size])]
    assert found == sent


@given(frames, st.integers(0, 10_000), st.integers(1, 255))
def test_no_single_damaged_byte_passes(frame: Frame, place: int, difference: int) -> None:
    line = bytearray(encode_frame(frame))
    line[place % (len(line) - 1)] ^= difference
    assert frame not in FrameDecoder(LineCounters()).feed(bytes(line))
    assert decode_frame(bytes(line[:-1])) is None or 0 in line[:-1]


@given(st.binary(max_size=600), frames)
def test_the_frame_after_noise_and_its_end_is_found(noise: bytes, frame: Frame) -> None:
    counters = LineCounters()
    assert FrameDecoder(counters).feed(noise + b"\0" + encode_frame(frame))[-1] == frame


def test_damaged_frames_are_counted() -> None:
    counters = LineCounters()
    line = bytearray(encode_frame(Frame(FrameKind.EVENT, 0, 1, b"abc")))
    line[3] ^= 1
    assert FrameDecoder(counters).feed(bytes(line)) == []
    assert (counters.damaged, counters.received) == (1, 0)


def test_a_payload_that_is_too_long_is_refused() -> None:
    with pytest.raises(ValueError, match="97 bytes"):
        encode_frame(Frame(FrameKind.CALL, 0, 0, bytes(97)))


def test_noise_without_an_end_costs_no_memory() -> None:
    counters = LineCounters()
    decoder = FrameDecoder(counters)
    for _ in range(1000):
        decoder.feed(b"\x55" * 100)
    assert decoder.pending < 1000
    assert counters.noise > 90_000


SESSION = 7
TOPICS = ([True, "/echo", "json"], [False, "said", "std_msgs/String"], [True, "/lamp", "std_msgs/Empty"])


class Bench:
    """The dialect, and a board played by the test."""

    def __init__(self) -> None:
        self.now = 100.0
        self.dialect = FramesDialect(baud=57_600, session=SESSION)
        self.session = 0
        self._line = FrameDecoder(LineCounters())

    def open(self) -> None:
        """Open the line and answer the handshake."""
        self.dialect.opened(self.now)
        while frames := self.sent():
            for frame in frames:
                self.answer_handshake(frame)

    def sent(self) -> list[Frame]:
        """The frames that the host has sent."""
        return self._line.feed(self.dialect.outgoing())

    def receive(self, kind: FrameKind, sequence: int, topic: int, payload: bytes = b"") -> None:
        """Receive a frame of the board."""
        self.dialect.receive(encode_frame(Frame(kind, sequence, topic, payload)), self.now)

    def answer_handshake(self, frame: Frame) -> None:
        """Answer a frame of the handshake."""
        match frame.kind, frame.id:
            case FrameKind.ASK, id if id == FRAME.board:
                about = msgspec.msgpack.encode([1, "echo", "1.0", self.session, len(TOPICS)])
                self.receive(FrameKind.BOARD, frame.sequence, FRAME.board, about)
            case FrameKind.ASK, topic:
                self.receive(FrameKind.TOPIC, frame.sequence, topic, msgspec.msgpack.encode(TOPICS[topic]))
            case FrameKind.OPEN, _:
                self.session = int.from_bytes(frame.payload, "little")
                self.receive(FrameKind.OPENED, frame.sequence, FRAME.board)

    def after(self, seconds: float) -> list[Frame]:
        """Let time pass; returns what the host sends."""
        self.now += seconds
        self.dialect.tick(self.now)
        return self.sent()

    def call(self, topic: str = "/echo", payload: bytes = b"1", seconds: float = 30.0) -> Command:
        """Submit a call."""
        command = Command(topic, payload, self.now + seconds)
        self.dialect.submit(command, self.now)
        return command

    def finished(self) -> list[CommandFinished]:
        """The calls that have finished."""
        return [each for each in self.dialect.events() if isinstance(each, CommandFinished)]


@pytest.fixture
def bench() -> Bench:
    """A board that is known and ready."""
    bench = Bench()
    bench.open()
    bench.dialect.events()
    return bench


def test_the_handshake_reports_the_board_and_its_topics() -> None:
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


def test_requests_are_repeated_until_they_are_answered() -> None:
    bench = Bench()
    bench.dialect.opened(bench.now)
    first = bench.sent()
    again = bench.after(0.5)
    assert first == again
    assert bench.dialect.counters.repeated == 1


def test_a_call_ends_with_the_boards_answer(bench: Bench) -> None:
    command = bench.call(payload=b'{"a":[1,2.5]}')
    [frame] = bench.sent()
    assert (frame.kind, frame.id) == (FrameKind.CALL, 0)
    assert msgspec.msgpack.decode(frame.payload) == {"a": [1, 2.5]}
    bench.receive(FrameKind.DONE, frame.sequence, 0, msgspec.msgpack.encode("well"))
    [ended] = bench.finished()
    assert (ended.command, ended.status, ended.payload) == (command, CallStatus.DONE, b'"well"')


def test_an_unanswered_call_is_repeated_unchanged(bench: Bench) -> None:
    bench.call()
    [first] = bench.sent()
    assert bench.after(0.2) == [first]
    assert bench.after(1.0) == [first]


def test_one_call_is_pending_at_a_time(bench: Bench) -> None:
    bench.call(payload=b"1")
    bench.call(payload=b"2")
    [first] = bench.sent()
    bench.receive(FrameKind.DONE, first.sequence, 0)
    [second] = bench.sent()
    assert (second.payload, second.sequence) == (b"\x02", (first.sequence + 1) % 16)


def test_a_late_answer_to_an_earlier_call_is_not_the_answer_to_this_one(bench: Bench) -> None:
    bench.call(payload=b"1")
    [first] = bench.sent()
    bench.receive(FrameKind.DONE, first.sequence, 0)
    bench.call(payload=b"2")
    bench.sent()
    bench.finished()
    bench.receive(FrameKind.DONE, first.sequence, 0)
    assert bench.finished() == []
    assert bench.dialect.counters.stray == 1


def test_a_call_refused_by_the_board_has_its_reason(bench: Bench) -> None:
    bench.call()
    [frame] = bench.sent()
    bench.receive(FrameKind.FAILED, frame.sequence, 0, msgspec.msgpack.encode("too hot"))
    [ended] = bench.finished()
    assert (ended.status, ended.reason, ended.detail) == (CallStatus.FAILED, "refused", "too hot")


def test_a_restart_leaves_the_pending_call_in_doubt_and_the_next_one_queued(bench: Bench) -> None:
    bench.call(payload=b"1")
    bench.call(payload=b"2")
    bench.sent()
    bench.session = 0
    bench.receive(FrameKind.BOARD, 0, FRAME.board, msgspec.msgpack.encode([1, "echo", "1.0", 0, len(TOPICS)]))
    happened = bench.dialect.events()
    assert [type(each) for each in happened] == [CommandFinished, BoardLost]
    assert isinstance(happened[0], CommandFinished)
    assert happened[0].reason == "doubt"
    frames = bench.sent()
    while frames and frames[0].kind is not FrameKind.CALL:
        bench.answer_handshake(frames[0])
        frames = bench.sent()
    assert frames[0].payload == b"\x02"


def test_a_board_that_kept_running_while_unplugged_gets_the_same_call_again(bench: Bench) -> None:
    bench.call()
    [call] = bench.sent()
    bench.dialect.closed(bench.now)
    bench.after(5.0)
    bench.open()
    assert [type(each) for each in bench.dialect.events()] == [BoardLost, BoardReady]
    bench.after(1.0)
    bench.receive(FrameKind.DONE, call.sequence, 0)
    assert [ended.status for ended in bench.finished()] == [CallStatus.DONE]


def test_a_late_call_that_was_not_sent_expires_and_one_that_was_sent_is_in_doubt(bench: Bench) -> None:
    begun, waiting = bench.call(seconds=2.0), bench.call(seconds=1.0)
    bench.after(3.0)
    reasons = {ended.command: ended.reason for ended in bench.finished()}
    assert reasons == {begun: "doubt", waiting: "expired"}


def test_after_a_call_in_doubt_a_new_session_begins(bench: Bench) -> None:
    bench.call(seconds=1.0)
    bench.sent()
    frames = bench.after(2.0)
    bench.call(payload=b"2")
    while frames and frames[-1].kind is not FrameKind.CALL:
        bench.answer_handshake(frames[-1])
        frames = bench.sent()
    assert bench.session == SESSION + 1
    assert frames[-1].payload == b"\x02"


def test_a_working_board_is_asked_less_often(bench: Bench) -> None:
    bench.call()
    [frame] = bench.sent()
    bench.receive(FrameKind.TAKEN, frame.sequence, 0)
    assert bench.after(0.2) == []
    assert bench.after(0.1) == [frame]


def test_a_silent_board_is_asked_and_then_lost(bench: Bench) -> None:
    assert [frame.id for frame in bench.after(2.5)] == [FRAME.board]
    bench.after(FRAMES_PACE.lost)
    assert [type(each) for each in bench.dialect.events()] == [BoardLost]


def test_events_arrive_and_gaps_in_them_are_counted(bench: Bench) -> None:
    for sequence in (14, 15, 2):
        bench.receive(FrameKind.EVENT, sequence, 1, msgspec.msgpack.encode("hi"))
    said = [each for each in bench.dialect.events() if isinstance(each, MessageReceived)]
    assert [each.payload for each in said] == [b"\x02\0\0\0hi"] * 3
    assert bench.dialect.counters.missed == 2


def test_an_event_that_is_not_of_its_type_is_counted_and_dropped(bench: Bench) -> None:
    bench.receive(FrameKind.EVENT, 0, 1, msgspec.msgpack.encode(5))
    bench.receive(FrameKind.EVENT, 1, 0, b"")
    assert bench.dialect.events() == []
    assert (bench.dialect.counters.refused, bench.dialect.counters.stray) == (1, 1)


def test_an_invalid_payload_is_never_sent(bench: Bench) -> None:
    bench.call(payload=b'"' + b"x" * 100 + b'"')
    bench.call(payload=b"{")
    bench.call("/lamp", b"1")
    assert [ended.reason for ended in bench.finished()] == ["unfit"] * 3
    with raises_with(CommandRefused, code="invalid-board-message"):
        bench.call("/said")
    assert bench.sent() == []


@pytest.mark.parametrize("payload", [b"", b"\x91\x01", b"\x95\x02\xa1a\xa1b\x00\x00", b"\xc1"])
def test_a_board_with_an_invalid_description_is_not_ready(payload: bytes) -> None:
    bench = Bench()
    bench.dialect.opened(bench.now)
    [ask] = bench.sent()
    bench.receive(FrameKind.BOARD, ask.sequence, FRAME.board, payload)
    assert bench.dialect.events() == []
    assert bench.dialect.counters.refused == 1


def test_a_full_queue_refuses_further_calls_and_loses_none(bench: Bench) -> None:
    for _ in range(COMMAND_LIMITS.waiting + 1):  # one is under way
        bench.call()
    with raises_with(CommandRefused, code="board-busy"):
        bench.call()
    assert bench.finished() == []
