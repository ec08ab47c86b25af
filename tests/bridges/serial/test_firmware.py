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
from tests.support.boards import COUNTER, DIMMER, ECHO, ROSSERIAL_ECHO, board, firmware
from tests.support.lines import LineClient

BAUD = 57_600
FLASH, RAM = 3000, 500
"""The most bytes that an echo may use of an Uno."""


def frames(uno: SimulatedBoard) -> LineClient:
    return LineClient(uno, FramesDialect(baud=BAUD, session=1234))


def rosserial(uno: SimulatedBoard) -> LineClient:
    return LineClient(uno, RosserialDialect(baud=BAUD, parameters={"loud": 7}))


def test_an_echo_uses_little_of_an_uno() -> None:
    flash, ram = size_of(firmware(ECHO))
    assert flash <= FLASH
    assert ram <= RAM


def test_text_that_a_sketch_prints_between_frames_does_no_harm() -> None:
    with board(DIMMER, "CHATTY") as uno, frames(uno) as client:
        assert client.call("/dim", b"64").status is CallStatus.DONE
        assert client.dialect.counters.damaged > 0  # the text


@pytest.mark.full
def test_a_thousand_calls_are_done_once_each_over_a_line_that_damages_one_byte_in_a_hundred() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        uno.add_noise(0.01, seed=3)
        for number in range(1, 1001):
            ended = client.call("/add", b"1")
            assert (ended.status, ended.payload) == (CallStatus.DONE, str(number).encode())
        assert client.dialect.counters.damaged > 0
        assert client.dialect.counters.repeated > 0


def test_values_of_all_types_cross_both_ways() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        for given in (b'[-70000,-1.5,true,"abc"]', b'[200,0.25,false,""]', b'[-5,1e+30,true,"0123456789"]'):
            ended = client.call("/values", given)
            assert ended.status is CallStatus.DONE
            integer, real, *rest = _json(given)
            returned = _json(ended.payload)
            assert [returned[0], *returned[2:]] == [integer, *rest]
            assert returned[1] == pytest.approx(real)
        refused = client.call("/values", b'[1,2,3,"x"]')
        assert (refused.reason, refused.detail) == ("refused", "[integer, real, boolean, text] is wanted")


def test_a_long_call_is_done_once_and_publishes_one_event() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        assert client.call("/slow", b"5").payload == b"5"
        assert client.call("/sum").payload == b"5"
        assert [each.payload for each in client.events if isinstance(each, MessageReceived)] == [b"5"]


def test_a_call_during_which_the_board_reads_nothing_is_done_once_and_so_is_the_next() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        assert client.call("/block", b"5").payload == b"5"
        assert client.dialect.counters.repeated > 0
        assert client.call("/add", b"1").payload == b"6"


def test_a_board_that_keeps_running_while_unplugged_finishes_the_call_once() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        sent = client.submit("/slow", b"5")
        client.next(MessageReceived)
        uno.unplug()
        client.next(BoardLost)
        uno.plug()
        ended = client.ended(sent)  # on a busy machine perhaps before the cable was pulled
        assert (ended.status, ended.payload) == (CallStatus.DONE, b"5")
        assert client.call("/sum").payload == b"5"


def test_a_call_during_which_the_board_is_reset_is_in_doubt_and_later_ones_are_done() -> None:
    with board(COUNTER) as uno, frames(uno) as client:
        client.submit("/slow", b"5")
        client.submit("/add", b"2")
        client.next(MessageReceived)
        uno.reset()
        assert client.next(CommandFinished).reason == "doubt"
        ended = client.next(CommandFinished)
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
        with frames(uno) as client:
            assert client.call("/sum").payload == b"0"


def test_a_board_that_resets_when_opened_is_found() -> None:
    with SimulatedBoard(firmware(COUNTER), resets=True) as uno, frames(uno) as client:
        assert client.call("/add", b"1").payload == b"1"


def flashes(uno: SimulatedBoard) -> list[bool]:
    """The levels of the lamp since it was first lit."""
    levels = [change.high for change in uno.changes(13)]
    return levels[levels.index(True) :] if True in levels else []


def test_rosserial_commands_are_queued_and_all_of_them_run() -> None:
    # On a busy machine the board runs slower than its line: allow it more time to announce its topics.
    patient = RosserialDialect(baud=BAUD, settle_time=8.0)
    with board(ROSSERIAL_ECHO) as uno, LineClient(uno, patient) as client:
        for _ in range(12):
            client.submit("/work", seconds=200)
        assert [client.next(CommandFinished).status for _ in range(12)] == [CallStatus.READ] * 12
        uno.wait_until(lambda: flashes(uno) == [True, False] * 12, what="twelve flashes")


def test_rosserial_services_parameters_and_logs_work() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        assert client.call("/twice").status is CallStatus.DONE
        client.submit("/ask")
        assert client.next(MessageReceived).payload == String("loud").encode()
        assert client.next(BoardLogged).text == "asked"


def test_a_request_of_a_rosserial_board_is_answered() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        client.submit("/inquire")
        asked = client.next(MessageReceived)
        assert (asked.topic.name, asked.topic.flow, asked.payload) == (
            "/weather",
            Flow.REQUESTS,
            String("how is it?").encode(),
        )
        answer = String("it rains").encode()
        client.line.call_soon(lambda: client.dialect.respond(asked.topic, answer, time.monotonic()))
        assert client.next(MessageReceived).payload == answer


def test_messages_on_unannounced_ids_are_counted_and_garbled_logs_are_text() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        client.submit("/garble")
        logged = client.next(BoardLogged)
        assert (logged.level, logged.text) == (logging.ERROR, "\ufffd(hot\ufffd")
        assert client.dialect.counters.stray == 1
        assert client.call("/hear", String("still here").encode()).status is CallStatus.READ


def test_a_message_on_an_unannounced_topic_never_reaches_a_rosserial_board() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        refused = client.call("/unknown", b"")
        assert (refused.status, refused.reason) == (CallStatus.FAILED, "unfit")
        assert client.call("/hear", String("still here").encode()).status is CallStatus.READ


def test_the_longest_string_reaches_a_rosserial_board() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        longest = String("x" * 111).encode()
        client.submit("/hear", longest)
        assert client.next(MessageReceived).payload == longest
        assert client.call("/hear", String("x" * 112).encode()).reason == "unfit"


def test_a_rosserial_board_that_was_reset_is_found_again() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        uno.unplug()
        client.next(BoardLost)
        uno.reset()
        uno.plug()
        client.next(BoardReady)
        assert client.call("/hear", String("again").encode()).status is CallStatus.READ


@pytest.mark.full
def test_a_damaged_message_of_a_rosserial_board_is_never_accepted() -> None:
    with board(ROSSERIAL_ECHO) as uno, rosserial(uno) as client:
        uno.add_noise(0.01, seed=5)
        texts = [String(f"message {number:03}").encode() for number in range(100)]
        for text in texts:
            client.submit("/hear", text)
        for _ in texts:
            client.next(CommandFinished)
        said = [each.payload for each in client.events if isinstance(each, MessageReceived)]
        assert set(said) <= set(texts)
        assert len(said) > 10
        assert client.dialect.counters.damaged > 0


def _json(data: bytes) -> list[object]:
    values: list[object] = json.loads(data)
    return values
