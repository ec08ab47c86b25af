"""rosserial from the host's side, with a board that the test plays and a clock that it sets."""

from __future__ import annotations

import logging

import pytest

from bridges.serial.dialect import (
    BoardLogged,
    BoardLost,
    BoardReady,
    CallStatus,
    Command,
    CommandFinished,
    Flow,
    LineCounters,
    MessageReceived,
)
from bridges.serial.errors import InvalidBoardMessage
from bridges.serial.rosserial import (
    CLIENT_PUBLISHER,
    CLIENT_SUBSCRIBER,
    LOG,
    PARAMETER,
    PUBLISHER,
    SERVER_PUBLISHER,
    SERVER_SUBSCRIBER,
    SUBSCRIBER,
    TIME,
    RosserialDecoder,
    RosserialMessage,
    encode_message,
)
from bridges.serial.rosserial_dialect import LOST, MAX_REQUESTS, SETTLE_TIME, RosserialDialect
from schemas.payloads import String

STRING_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"
EMPTY_MD5 = "d41d8cd98f00b204e9800998ecf8427e"
NOW = 1000.5


def text(value: str) -> bytes:
    return len(value).to_bytes(4, "little") + value.encode()


def info(topic: int, name: str, kind: str, md5: str, *, buffer: int = 280) -> bytes:
    return topic.to_bytes(2, "little") + text(name) + text(kind) + text(md5) + buffer.to_bytes(4, "little")


CHATTER = (PUBLISHER, info(125, "chatter", "std_msgs/String", STRING_MD5))
BLINK = (SUBSCRIBER, info(100, "blink_led", "std_msgs/Empty", EMPTY_MD5))
HEAR = (SUBSCRIBER, info(101, "hear", "std_msgs/String", STRING_MD5))
TOPICS = (CHATTER, BLINK, HEAR)


class Bench:
    """The dialect, and what a board would do."""

    def __init__(self, *, baud: int = 57_600) -> None:
        self.now = 100.0
        self.dialect = RosserialDialect(baud=baud, parameters={"rate": 7}, clock=lambda: NOW)
        self._line = RosserialDecoder(LineCounters())

    def heard(self) -> list[RosserialMessage]:
        """What the host has sent."""
        return self._line.feed(self.dialect.outgoing())

    def say(self, topic: int, data: bytes = b"") -> None:
        """A message of the board's."""
        self.dialect.receive(encode_message(RosserialMessage(topic, data)), self.now)

    def announce(self, *topics: tuple[int, bytes]) -> None:
        """What a board says when it is asked for its topics."""
        self.say(TIME)
        for kind, data in topics:
            self.say(kind, data)

    def after(self, seconds: float) -> list[RosserialMessage]:
        """Let time pass; what the host sends."""
        self.now += seconds
        self.dialect.tick(self.now)
        return self.heard()

    def command(self, topic: str = "/blink_led", payload: bytes = b"", seconds: float = 60.0) -> Command:
        """A new command."""
        command = Command(topic, payload, self.now + seconds)
        self.dialect.submit(command, self.now)
        return command


def ready(*topics: tuple[int, bytes], baud: int = 57_600) -> Bench:
    """A board with these topics, known and ready."""
    bench = Bench(baud=baud)
    bench.dialect.opened(bench.now)
    bench.announce(*(topics or TOPICS))
    bench.after(SETTLE_TIME)
    [happening] = bench.dialect.events()
    assert isinstance(happening, BoardReady)
    bench.heard()
    return bench


def test_a_board_that_is_starting_is_asked_again_and_again() -> None:
    bench = Bench()
    bench.dialect.opened(bench.now)
    assert bench.heard() == [RosserialMessage(PUBLISHER)]
    assert [bench.after(0.6) for _ in range(3)] == [[RosserialMessage(PUBLISHER)]] * 3


def test_topics_are_known_when_no_more_are_announced() -> None:
    about = ready().dialect.info
    assert about is not None
    assert [(each.name, each.flow, each.id) for each in about.topics] == [
        ("/chatter", Flow.PUBLISHES, 125),
        ("/blink_led", Flow.SUBSCRIBES, 100),
        ("/hear", Flow.SUBSCRIBES, 101),
    ]


def test_the_time_is_answered_at_once() -> None:
    bench = ready()
    bench.say(TIME)
    assert bench.heard() == [RosserialMessage(TIME, (1000).to_bytes(4, "little") + (500_000_000).to_bytes(4, "little"))]


def test_a_topic_with_another_md5_or_an_impossible_id_or_name_is_not_used(caplog: pytest.LogCaptureFixture) -> None:
    wrong = (
        (SUBSCRIBER, info(102, "other", "std_msgs/String", EMPTY_MD5)),
        (SUBSCRIBER, info(5, "low", "std_msgs/Empty", EMPTY_MD5)),
        (SUBSCRIBER, info(103, "a b", "std_msgs/Empty", EMPTY_MD5)),
    )
    with caplog.at_level(logging.WARNING):
        bench = ready(*TOPICS, *wrong)
    assert bench.dialect.info is not None
    assert len(bench.dialect.info.topics) == len(TOPICS)
    assert len(caplog.records) == len(wrong)


def test_a_command_goes_with_the_question_that_shows_when_it_was_read() -> None:
    bench = ready()
    command = bench.command()
    assert bench.heard() == [RosserialMessage(100), RosserialMessage(PUBLISHER)]
    bench.announce(*TOPICS)
    [ended] = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert (ended.command, ended.status) == (command, CallStatus.READ)


def test_the_next_command_waits_until_the_board_has_answered_all() -> None:
    bench = ready()
    bench.command()
    bench.command("/hear", String("next").encode())
    bench.heard()
    assert bench.after(0.1) == []
    bench.say(*CHATTER)
    assert bench.heard() == []
    bench.say(*BLINK)
    bench.say(*HEAR)
    assert bench.heard()[0] == RosserialMessage(101, String("next").encode())


def test_answers_to_repeated_questions_do_not_let_the_command_after_the_next_out() -> None:
    bench = ready()
    for number in range(3):
        bench.command("/hear", String(str(number)).encode())
    bench.heard()
    assert bench.after(0.3) == [RosserialMessage(PUBLISHER)]
    bench.announce(*TOPICS)
    assert RosserialMessage(101, String("1").encode()) not in bench.heard()
    bench.announce(*TOPICS)
    assert RosserialMessage(101, String("1").encode()) in bench.heard()
    assert bench.after(0.1) == []


def test_questions_behind_one_command_do_not_fill_the_board() -> None:
    bench = ready()
    bench.command()
    sent = bench.heard()
    for _ in range(50):
        sent += bench.after(1.0)
    assert sent.count(RosserialMessage(PUBLISHER)) <= MAX_REQUESTS
    assert sum(len(encode_message(message)) for message in sent) <= 64


@pytest.mark.parametrize(("baud", "most"), [(57_600, 111), (115_200, 220)])
def test_what_the_line_does_not_carry_in_time_is_never_sent(baud: int, most: int) -> None:
    bench = ready(baud=baud)
    bench.command("/hear", String("x" * most).encode())
    with pytest.raises(InvalidBoardMessage):
        bench.command("/hear", String("x" * (most + 1)).encode())


def test_what_is_beyond_the_boards_buffer_or_its_topics_or_their_type_is_never_sent() -> None:
    bench = ready((SUBSCRIBER, info(100, "small", "std_msgs/String", STRING_MD5, buffer=8)))
    bench.command("/small", String("four").encode())
    bench.heard()
    for topic, payload in (("/small", String("fiver").encode()), ("/small", b"four"), ("/unknown", b"")):
        with pytest.raises(InvalidBoardMessage):
            bench.command(topic, payload)
    assert bench.heard() == []


def test_commands_wait_for_a_board_that_is_not_there_and_expire() -> None:
    bench = Bench()
    bench.command(seconds=5.0)
    later = bench.command("/hear", String("later").encode(), seconds=60.0)
    bench.now += 6.0
    bench.dialect.tick(bench.now)
    [ended] = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert ended.reason == "expired"
    bench.dialect.opened(bench.now)
    bench.announce(*TOPICS)
    assert bench.after(SETTLE_TIME)[:0] == []
    assert later.begun


def test_a_board_that_goes_away_leaves_its_command_in_doubt() -> None:
    bench = ready()
    bench.command()
    bench.dialect.closed(bench.now)
    ended, gone = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert ended.reason == "doubt"
    assert isinstance(gone, BoardLost)


def test_a_silent_board_is_asked_for_its_topics_and_then_gone() -> None:
    bench = ready()
    assert bench.after(3.5) == [RosserialMessage(PUBLISHER)]
    bench.after(LOST)
    assert [type(each) for each in bench.dialect.events()] == [BoardLost]


def test_what_the_board_says_is_told_if_it_is_of_its_type() -> None:
    bench = ready()
    bench.say(125, String("hi").encode())
    bench.say(125, b"\x09\0\0\0hi")
    bench.say(126, b"")
    [said] = bench.dialect.events()
    assert isinstance(said, MessageReceived)
    assert said.payload == String("hi").encode()
    assert (bench.dialect.counters.refused, bench.dialect.counters.stray) == (1, 1)


def test_parameters_are_answered_and_logs_told() -> None:
    bench = ready()
    bench.say(PARAMETER, text("~rate"))
    bench.say(PARAMETER, text("other"))
    assert [message.data[0] for message in bench.heard()] == [1, 0]
    bench.say(LOG, b"\x02" + text("hot"))
    assert bench.dialect.events() == [BoardLogged(logging.WARNING, "hot")]


def test_a_service_of_the_board_is_a_call_with_an_answer_and_needs_no_question_behind_it() -> None:
    trigger = "937c9679a518e3a18d831e57125ea522"
    bench = ready(
        (SERVER_PUBLISHER, info(125, "open", "std_srvs/Trigger", trigger)),
        (SERVER_SUBSCRIBER, info(100, "open", "std_srvs/Trigger", EMPTY_MD5)),
    )
    bench.command("/open")
    assert bench.heard() == [RosserialMessage(100)]
    bench.say(125, b"\x01\0\0\0\0")
    [ended] = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert (ended.status, ended.payload) == (CallStatus.DONE, b"\x01\0\0\0\0")


def test_what_the_board_asks_is_told_and_the_answer_sent() -> None:
    bench = ready(
        (CLIENT_PUBLISHER, info(125, "weather", "std_srvs/Empty", EMPTY_MD5)),
        (CLIENT_SUBSCRIBER, info(100, "weather", "std_srvs/Empty", EMPTY_MD5, buffer=4)),
    )
    bench.say(125, b"?")
    [said] = bench.dialect.events()
    assert isinstance(said, MessageReceived)
    assert (said.topic.flow, said.payload) == (Flow.REQUESTS, b"?")
    bench.dialect.respond(said.topic, b"rain", bench.now)
    bench.dialect.respond(said.topic, b"sunshine", bench.now)
    assert bench.heard() == [RosserialMessage(100, b"rain")]


def test_other_topics_than_before_are_another_board() -> None:
    bench = ready()
    bench.say(SUBSCRIBER, info(101, "hear", "std_msgs/Empty", EMPTY_MD5))
    bench.after(SETTLE_TIME)
    gone, again = bench.dialect.events()
    assert isinstance(gone, BoardLost)
    assert isinstance(again, BoardReady)
    assert [topic.name for topic in again.info.topics] == ["/hear"]
