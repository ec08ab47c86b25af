"""The firmware libraries on a simulated Uno, over clean and noisy lines."""

from __future__ import annotations

import json
import logging
import select
import time

import pytest

from bridges.serial.boards import SimulatedBoard
from bridges.serial.dialect import (
    BoardLogged,
    BoardLost,
    BoardReady,
    CallStatus,
    CommandFinished,
    Flow,
    LineCounters,
    MessageReceived,
)
from bridges.serial.firmware import size_of
from bridges.serial.frames import Frame, FrameDecoder, FrameKind, encode_frame
from bridges.serial.frames_dialect import FramesDialect
from bridges.serial.line import SerialPort
from bridges.serial.rosserial_dialect import RosserialDialect
from schemas.payloads import String
from tests.support.boards import COUNTER, ECHO, ROSSERIAL_ECHO, board, firmware
from tests.support.lines import Talk

BAUD = 57_600
FLASH, RAM = 3000, 500
"""The most bytes that an echo may use of an Uno."""


def frames(uno: SimulatedBoard) -> Talk:
    return Talk(uno, FramesDialect(baud=BAUD, session=1234), baud=BAUD)


def rosserial(uno: SimulatedBoard) -> Talk:
    return Talk(uno, RosserialDialect(baud=BAUD, parameters={"loud": 7}), baud=BAUD)


def test_an_echo_uses_little_of_an_uno() -> None:
    flash, ram = size_of(firmware(ECHO))
    assert flash <= FLASH
    assert ram <= RAM


def test_a_thousand_calls_are_done_once_each_over_a_line_that_damages_one_byte_in_a_hundred() -> None:
    with board(COUNTER) as uno, frames(uno) as talk:
        uno.add_noise(0.01, seed=3)
        for number in range(1, 1001):
            ended = talk.call("/add", b"1")
            assert (ended.status, ended.payload) == (CallStatus.DONE, str(number).encode())
        assert talk.dialect.counters.damaged > 0
        assert talk.dialect.counters.repeated > 0


def test_values_of_all_types_cross_both_ways() -> None:
    with board(COUNTER) as uno, frames(uno) as talk:
        for given in (b'[-70000,-1.5,true,"abc"]', b'[200,0.25,false,""]', b'[-5,1e+30,true,"0123456789"]'):
            ended = talk.call("/values", given)
            assert ended.status is CallStatus.DONE
            integer, real, *rest = _json(given)
            returned = _json(ended.payload)
            assert [returned[0], *returned[2:]] == [integer, *rest]
            assert returned[1] == pytest.approx(real)
        refused = talk.call("/values", b'[1,2,3,"x"]')
        assert (refused.reason, refused.detail) == ("refused", "[integer, real, boolean, text] is wanted")


def test_a_long_call_is_done_once_and_publishes_one_event() -> None:
    with board(COUNTER) as uno, frames(uno) as talk:
        assert talk.call("/slow", b"5").payload == b"5"
        assert talk.call("/sum").payload == b"5"
        assert [each.payload for each in talk.happened if isinstance(each, MessageReceived)] == [b"5"]


def test_a_call_during_which_the_board_reads_nothing_is_done_once_and_so_is_the_next() -> None:
    with board(COUNTER) as uno, frames(uno) as talk:
        assert talk.call("/block", b"5").payload == b"5"
        assert talk.dialect.counters.repeated > 0
        assert talk.call("/add", b"1").payload == b"6"


def test_a_board_that_keeps_running_while_unplugged_finishes_the_call_once() -> None:
    with board(COUNTER) as uno, frames(uno) as talk:
        talk.submit("/slow", b"5")
        talk.next(MessageReceived)
        uno.unplug()
        talk.next(BoardLost)
        uno.plug()
        ended = talk.next(CommandFinished)
        assert (ended.status, ended.payload) == (CallStatus.DONE, b"5")
        assert talk.call("/sum").payload == b"5"


def test_a_call_during_which_the_board_is_reset_is_in_doubt_and_later_ones_are_done() -> None:
    with board(COUNTER) as uno, frames(uno) as talk:
        talk.submit("/slow", b"5")
        talk.submit("/add", b"2")
        talk.next(MessageReceived)
        uno.reset()
        assert talk.next(CommandFinished).reason == "doubt"
        ended = talk.next(CommandFinished)
        assert (ended.status, ended.payload) == (CallStatus.DONE, b"2")


def test_a_board_without_a_session_accepts_no_call() -> None:
    line = FrameDecoder(LineCounters())
    with board(COUNTER) as uno:
        port = SerialPort(uno.port, baud=BAUD)
        uno.wait_until(lambda: "opened" in uno.output, what="the opening")
        port.write(b"\0" + encode_frame(Frame(FrameKind.CALL, 1, 0, b"\x05")))
        received: list[Frame] = []
        while not any(frame.sequence == 1 for frame in received):
            assert select.select([port], [], [], 30)[0]
            received += line.feed(port.read())
        port.close()
        assert received[-1].kind is FrameKind.BOARD
        with frames(uno) as talk:
            assert talk.call("/sum").payload == b"0"


def test_a_board_that_resets_when_opened_is_found() -> None:
    with SimulatedBoard(firmware(COUNTER), resets=True) as uno, frames(uno) as talk:
        assert talk.call("/add", b"1").payload == b"1"


def flashes(uno: SimulatedBoard) -> list[bool]:
    """The levels of the lamp since it was first lit."""
    levels = [change.high for change in uno.changes(13)]
    return levels[levels.index(True) :] if True in levels else []


def test_rosserial_commands_are_queued_and_all_of_them_run() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as talk:
        for _ in range(12):
            talk.submit("/work")
        assert [talk.next(CommandFinished).status for _ in range(12)] == [CallStatus.READ] * 12
        uno.wait_until(lambda: flashes(uno) == [True, False] * 12, what="twelve flashes")


def test_rosserial_services_parameters_and_logs_work() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as talk:
        assert talk.call("/twice").status is CallStatus.DONE
        talk.submit("/ask")
        assert talk.next(MessageReceived).payload == String("loud").encode()
        assert talk.next(BoardLogged).text == "asked"


def test_a_request_of_a_rosserial_board_is_answered() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as talk:
        talk.submit("/inquire")
        asked = talk.next(MessageReceived)
        assert (asked.topic.name, asked.topic.flow, asked.payload) == (
            "/weather",
            Flow.REQUESTS,
            String("how is it?").encode(),
        )
        answer = String("it rains").encode()
        talk.line.call_soon(lambda: talk.dialect.respond(asked.topic, answer, time.monotonic()))
        assert talk.next(MessageReceived).payload == answer


def test_messages_on_unannounced_ids_are_counted_and_garbled_logs_are_text() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as talk:
        talk.submit("/garble")
        logged = talk.next(BoardLogged)
        assert (logged.level, logged.text) == (logging.ERROR, "\ufffd(hot\ufffd")
        assert talk.dialect.counters.stray == 1
        assert talk.call("/hear", String("still here").encode()).status is CallStatus.READ


def test_a_message_on_an_unannounced_topic_never_reaches_a_rosserial_board() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as talk:
        refused = talk.call("/unknown", b"")
        assert (refused.status, refused.reason) == (CallStatus.FAILED, "unfit")
        assert talk.call("/hear", String("still here").encode()).status is CallStatus.READ


def test_the_longest_string_reaches_a_rosserial_board() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as talk:
        longest = String("x" * 111).encode()
        talk.submit("/hear", longest)
        assert talk.next(MessageReceived).payload == longest
        assert talk.call("/hear", String("x" * 112).encode()).reason == "unfit"


def test_a_rosserial_board_that_was_reset_is_found_again() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as talk:
        uno.unplug()
        talk.next(BoardLost)
        uno.reset()
        uno.plug()
        talk.next(BoardReady)
        assert talk.call("/hear", String("again").encode()).status is CallStatus.READ


def test_a_damaged_message_of_a_rosserial_board_is_never_accepted() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as talk:
        uno.add_noise(0.01, seed=5)
        texts = [String(f"message {number:03}").encode() for number in range(100)]
        for text in texts:
            talk.submit("/hear", text)
        for _ in texts:
            talk.next(CommandFinished)
        said = [each.payload for each in talk.happened if isinstance(each, MessageReceived)]
        assert set(said) <= set(texts)
        assert len(said) > 10
        assert talk.dialect.counters.damaged > 0


def _json(data: bytes) -> list[object]:
    values: list[object] = json.loads(data)
    return values
