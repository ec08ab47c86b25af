"""rosserial: codec, types, and the dialect, with a board played by the test and a clock that it sets."""

from __future__ import annotations

import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridges.serial.dialect import (
    BoardLogged,
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
from bridges.serial.rosserial import (
    ASK_TOPICS,
    KNOWN_TYPES,
    ROSSERIAL_PACE,
    RosserialDecoder,
    RosserialDialect,
    RosserialId,
    RosserialMessage,
    decode_log,
    decode_parameter_name,
    decode_topic_info,
    encode_message,
    encode_parameter,
    encode_time,
    longest_frame,
)
from schemas.errors import InvalidPayload
from schemas.payloads import String

messages = st.builds(RosserialMessage, st.integers(0, 0xFFFF), st.binary(max_size=300))


def text(value: str) -> bytes:
    return len(value).to_bytes(4, "little") + value.encode()


@pytest.mark.parametrize(
    ("message", "line"),
    [
        (RosserialMessage(RosserialId.PUBLISHER), "ff fe 00 00 ff 00 00 ff"),
        (RosserialMessage(100), "ff fe 00 00 ff 64 00 9b"),
        (RosserialMessage(125, String("abc").encode()), "ff fe 07 00 f8 7d 00 03 00 00 00 61 62 63 59"),
        (RosserialMessage(RosserialId.STOP), "ff fe 00 00 ff 0b 00 f4"),
    ],
)
def test_messages_are_the_bytes_of_rosserial(message: RosserialMessage, line: str) -> None:
    assert encode_message(message).hex(" ") == line
    assert RosserialDecoder(LineCounters()).feed(bytes.fromhex(line)) == [message]


def test_the_request_for_topics_is_an_empty_message() -> None:
    assert encode_message(RosserialMessage(RosserialId.PUBLISHER)) == ASK_TOPICS


@given(st.lists(messages, max_size=4), st.integers(1, 50))
def test_messages_are_found_again_in_pieces_of_any_size(sent: list[RosserialMessage], size: int) -> None:
    line = b"".join(map(encode_message, sent))
    decoder = RosserialDecoder(LineCounters())
    found = [each for start in range(0, len(line), size) for each in decoder.feed(line[start : start + size])]
    assert found == sent


@given(messages, st.integers(1, 4))
def test_a_message_after_an_incomplete_one_is_found(message: RosserialMessage, cut: int) -> None:
    cut_off = encode_message(RosserialMessage(200, b"x" * 4))[:cut]
    assert RosserialDecoder(LineCounters()).feed(cut_off + encode_message(message)) == [message]


@given(st.integers(0, 14), st.integers(1, 255))
def test_no_single_damaged_byte_of_a_string_passes(place: int, difference: int) -> None:
    line = bytearray(encode_message(RosserialMessage(125, String("abc").encode())))
    line[place] ^= difference
    counters = LineCounters()
    assert RosserialDecoder(counters).feed(bytes(line) + bytes(400)) == []
    assert counters.noise > 0


def test_a_stray_ff_before_a_message_is_one_byte_of_noise() -> None:
    counters = LineCounters()
    assert RosserialDecoder(counters).feed(b"\xff" + encode_message(RosserialMessage(100))) == [RosserialMessage(100)]
    assert counters.noise == 1


def test_an_announcement_is_decoded() -> None:
    data = (125).to_bytes(2, "little") + text("chatter") + text("std_msgs/String") + text("992ce8a1") + b"\x18\x01\0\0"
    info = decode_topic_info(data)
    assert (info.id, info.name, info.type, info.md5, info.buffer) == (
        125,
        "chatter",
        "std_msgs/String",
        "992ce8a1",
        280,
    )
    for cut in range(len(data)):
        with pytest.raises(InvalidPayload):
            decode_topic_info(data[:cut])
    with pytest.raises(InvalidPayload):
        decode_topic_info(data + b"x")


def test_a_log_line_that_is_not_text_is_decoded_with_replacements() -> None:
    assert decode_log(b"\x02" + text("hot")) == (logging.WARNING, "hot")
    assert decode_log(b"\x03\x02\0\0\0\xff\xfe") == (logging.ERROR, "\ufffd\ufffd")
    assert decode_log(b"") == (logging.INFO, "")


def test_the_time_is_seconds_and_nanoseconds() -> None:
    assert encode_time(1.5).data == (1).to_bytes(4, "little") + (500_000_000).to_bytes(4, "little")


@pytest.mark.parametrize(
    ("value", "data"),
    [
        (7, "01000000 07000000 00000000 00000000"),
        (-1, "01000000 ffffffff 00000000 00000000"),
        (0.5, "00000000 01000000 0000003f 00000000"),
        ("ab", "00000000 00000000 01000000 02000000 6162"),
        ([1, 0.5], "00000000 02000000 0000803f 0000003f 00000000"),
        (None, "00000000 00000000 00000000"),
    ],
)
def test_parameters_are_lists_of_integers_floats_and_texts(value: object, data: str) -> None:
    assert encode_parameter(value).data == bytes.fromhex(data)


def test_a_parameter_is_requested_by_name() -> None:
    assert decode_parameter_name(text("~rate")) == "~rate"
    with pytest.raises(InvalidPayload):
        decode_parameter_name(b"\x05\0\0\0ab")


@pytest.mark.parametrize(("baud", "characters"), [(57_600, 111), (115_200, 220)])
def test_the_longest_string_is_the_one_measured_on_a_board(baud: int, characters: int) -> None:
    assert len(encode_message(RosserialMessage(100, String("x" * characters).encode()))) == longest_frame(baud)


def test_the_types_have_the_md5_sums_of_ros() -> None:
    sums = {
        "std_msgs/Empty": "d41d8cd98f00b204e9800998ecf8427e",
        "std_msgs/String": "992ce8a1687cec8c8bd883ec73ca41d1",
        "std_msgs/Bool": "8b94c1b53db61fb6aed406028ad6332a",
    }
    for name, digest in sums.items():
        assert KNOWN_TYPES[name].md5 == digest
    assert "sensor_msgs/Range" not in KNOWN_TYPES


def test_a_payload_of_the_wrong_length_is_invalid() -> None:
    number, string = KNOWN_TYPES["std_msgs/UInt16"], KNOWN_TYPES["std_msgs/String"]
    number.check(b"\0\0")
    string.check(String("ä").encode())
    with pytest.raises(InvalidPayload):
        number.check(b"\0")
    with pytest.raises(InvalidPayload):
        string.check(b"\x02\0\0\0a")


STRING_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"
EMPTY_MD5 = "d41d8cd98f00b204e9800998ecf8427e"

NOW = 1000.5


def info(topic: int, name: str, kind: str, md5: str, *, buffer: int = 280) -> bytes:
    return topic.to_bytes(2, "little") + text(name) + text(kind) + text(md5) + buffer.to_bytes(4, "little")


CHATTER = (RosserialId.PUBLISHER, info(125, "chatter", "std_msgs/String", STRING_MD5))
BLINK = (RosserialId.SUBSCRIBER, info(100, "blink_led", "std_msgs/Empty", EMPTY_MD5))
HEAR = (RosserialId.SUBSCRIBER, info(101, "hear", "std_msgs/String", STRING_MD5))
TOPICS = (CHATTER, BLINK, HEAR)


class Bench:
    """The dialect, and a board played by the test."""

    def __init__(self, *, baud: int = 57_600) -> None:
        self.now = 100.0
        self.dialect = RosserialDialect(baud=baud, parameters={"rate": 7}, clock=lambda: NOW)
        self._line = RosserialDecoder(LineCounters())

    def sent(self) -> list[RosserialMessage]:
        """The messages that the host has sent."""
        return self._line.feed(self.dialect.outgoing())

    def receive(self, topic: int, data: bytes = b"") -> None:
        """Receive a message of the board."""
        self.dialect.receive(encode_message(RosserialMessage(topic, data)), self.now)

    def get_ready(self, *topics: tuple[int, bytes]) -> None:
        """Receive announcements of all topics, twice: then the host knows that these are all."""
        for _ in range(2):
            self.announce(*topics)
        self.after(ROSSERIAL_PACE.settle)

    def announce(self, *topics: tuple[int, bytes]) -> None:
        """Receive announcements of topics."""
        self.receive(RosserialId.TIME)
        for kind, data in topics:
            self.receive(kind, data)

    def after(self, seconds: float) -> list[RosserialMessage]:
        """Let time pass; returns what the host sends."""
        self.now += seconds
        self.dialect.tick(self.now)
        return self.sent()

    def command(self, topic: str = "/blink_led", payload: bytes = b"", seconds: float = 60.0) -> Command:
        """Submit a command."""
        command = Command(topic, payload, self.now + seconds)
        self.dialect.submit(command, self.now)
        return command


def ready(*topics: tuple[int, bytes], baud: int = 57_600) -> Bench:
    """A bench whose board is ready and has these topics."""
    bench = Bench(baud=baud)
    bench.dialect.opened(bench.now)
    bench.get_ready(*(topics or TOPICS))
    [happening] = bench.dialect.events()
    assert isinstance(happening, BoardReady)
    bench.sent()
    return bench


def test_a_board_that_is_starting_is_asked_repeatedly() -> None:
    bench = Bench()
    bench.dialect.opened(bench.now)
    assert bench.sent() == [RosserialMessage(RosserialId.PUBLISHER)]
    assert [bench.after(0.6) for _ in range(3)] == [[RosserialMessage(RosserialId.PUBLISHER)]] * 3


def test_a_board_is_ready_when_it_has_announced_its_topics() -> None:
    about = ready().dialect.info
    assert about is not None
    assert [(each.name, each.flow, each.id) for each in about.topics] == [
        ("/chatter", Flow.PUBLISHES, 125),
        ("/blink_led", Flow.SUBSCRIBES, 100),
        ("/hear", Flow.SUBSCRIBES, 101),
    ]


def test_a_slow_line_has_time_for_each_announcement() -> None:
    bench = Bench(baud=9_600)
    bench.dialect.opened(bench.now)
    assert bench.sent() == [RosserialMessage(RosserialId.PUBLISHER)]
    topics = [
        (RosserialId.PUBLISHER, info(125 + number, f"t{number}", "std_msgs/String", STRING_MD5)) for number in range(15)
    ]
    requests = 0
    for topic in topics * 2:
        assert bench.dialect.events() == []
        bench.announce(topic)
        sent = bench.sent() + bench.after(0.12)  # which an announcement of 115 bytes takes
        requests += sent.count(RosserialMessage(RosserialId.PUBLISHER))
    assert requests == 1  # each one more would make the line busy for 1.8 s
    bench.after(1.0)
    [happening] = bench.dialect.events()
    assert isinstance(happening, BoardReady)
    assert len(happening.info.topics) == len(topics)


def test_a_board_that_pauses_between_its_topics_is_not_ready_before_it_has_announced_all() -> None:
    bench = Bench()
    bench.dialect.opened(bench.now)
    bench.announce(CHATTER)
    bench.after(1.0)
    bench.announce(BLINK, HEAR)
    assert RosserialMessage(RosserialId.PUBLISHER) in bench.after(1.0)
    assert bench.dialect.events() == []
    assert bench.dialect.next_tick > bench.now
    bench.announce(*TOPICS)
    bench.after(ROSSERIAL_PACE.settle)
    [happening] = bench.dialect.events()
    assert isinstance(happening, BoardReady)
    assert len(happening.info.topics) == len(TOPICS)


def test_a_request_for_the_time_is_answered_at_once() -> None:
    bench = ready()
    bench.receive(RosserialId.TIME)
    assert bench.sent() == [
        RosserialMessage(RosserialId.TIME, (1000).to_bytes(4, "little") + (500_000_000).to_bytes(4, "little"))
    ]


def test_a_topic_with_a_wrong_md5_id_or_name_is_rejected(caplog: pytest.LogCaptureFixture) -> None:
    wrong = (
        (RosserialId.SUBSCRIBER, info(102, "other", "std_msgs/String", EMPTY_MD5)),
        (RosserialId.SUBSCRIBER, info(5, "low", "std_msgs/Empty", EMPTY_MD5)),
        (RosserialId.SUBSCRIBER, info(103, "a b", "std_msgs/Empty", EMPTY_MD5)),
    )
    with caplog.at_level(logging.WARNING):
        bench = ready(*TOPICS, *wrong)
    assert bench.dialect.info is not None
    assert len(bench.dialect.info.topics) == len(TOPICS)
    assert [record.event for record in caplog.records] == ["topic-rejected"] * len(wrong)  # type: ignore[attr-defined]


def test_a_command_is_followed_by_a_request_that_shows_when_it_was_read() -> None:
    bench = ready()
    command = bench.command()
    assert bench.sent() == [RosserialMessage(100), RosserialMessage(RosserialId.PUBLISHER)]
    bench.announce(*TOPICS)
    [ended] = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert (ended.command, ended.status) == (command, CallStatus.READ)


def test_the_next_command_waits_for_all_announcements() -> None:
    bench = ready()
    bench.command()
    bench.command("/hear", String("next").encode())
    bench.sent()
    assert bench.after(0.1) == []
    bench.receive(*CHATTER)
    assert bench.sent() == []
    bench.receive(*BLINK)
    bench.receive(*HEAR)
    assert bench.sent()[0] == RosserialMessage(101, String("next").encode())


def test_answers_to_repeated_requests_release_one_command_only() -> None:
    bench = ready()
    for number in range(3):
        bench.command("/hear", String(str(number)).encode())
    bench.sent()
    assert bench.after(0.3) == [RosserialMessage(RosserialId.PUBLISHER)]
    bench.announce(*TOPICS)
    assert RosserialMessage(101, String("1").encode()) not in bench.sent()
    bench.announce(*TOPICS)
    assert RosserialMessage(101, String("1").encode()) in bench.sent()
    assert bench.after(0.1) == []


def test_requests_behind_one_command_do_not_fill_the_board() -> None:
    bench = ready()
    bench.command()
    sent = bench.sent()
    for _ in range(50):
        sent += bench.after(1.0)
    assert sent.count(RosserialMessage(RosserialId.PUBLISHER)) <= ROSSERIAL_PACE.requests
    assert sum(len(encode_message(message)) for message in sent) <= 64


@pytest.mark.parametrize(("baud", "most"), [(57_600, 111), (115_200, 220)])
def test_a_message_too_long_for_the_line_is_never_sent(baud: int, most: int) -> None:
    bench = ready(baud=baud)
    bench.command("/hear", String("x" * most).encode())
    with pytest.raises(CommandRefused):
        bench.command("/hear", String("x" * (most + 1)).encode())


def test_a_message_that_does_not_fit_buffer_topic_or_type_is_never_sent() -> None:
    bench = ready((RosserialId.SUBSCRIBER, info(100, "small", "std_msgs/String", STRING_MD5, buffer=8)))
    bench.command("/small", String("four").encode())
    bench.sent()
    for topic, payload in (("/small", String("fiver").encode()), ("/small", b"four"), ("/unknown", b"")):
        with pytest.raises(CommandRefused):
            bench.command(topic, payload)
    assert bench.sent() == []


def test_commands_wait_for_an_absent_board_and_expire() -> None:
    bench = Bench()
    bench.command(seconds=5.0)
    later = bench.command("/hear", String("later").encode(), seconds=60.0)
    bench.now += 6.0
    bench.dialect.tick(bench.now)
    [ended] = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert ended.reason == "expired"
    bench.dialect.opened(bench.now)
    bench.get_ready(*TOPICS)
    assert later.begun


def test_a_lost_board_leaves_its_command_in_doubt() -> None:
    bench = ready()
    bench.command()
    bench.dialect.closed(bench.now)
    ended, gone = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert ended.reason == "doubt"
    assert isinstance(gone, BoardLost)


def test_a_silent_board_is_asked_for_its_topics_and_then_lost() -> None:
    bench = ready()
    assert bench.after(3.5) == [RosserialMessage(RosserialId.PUBLISHER)]
    bench.after(ROSSERIAL_PACE.lost)
    assert [type(each) for each in bench.dialect.events()] == [BoardLost]


def test_messages_are_delivered_if_they_are_of_their_type() -> None:
    bench = ready()
    bench.receive(125, String("hi").encode())
    bench.receive(125, b"\x09\0\0\0hi")
    bench.receive(126, b"")
    [said] = bench.dialect.events()
    assert isinstance(said, MessageReceived)
    assert said.payload == String("hi").encode()
    assert (bench.dialect.counters.refused, bench.dialect.counters.stray) == (1, 1)


def test_parameters_are_answered_and_logs_delivered() -> None:
    bench = ready()
    bench.receive(RosserialId.PARAMETER, text("~rate"))
    bench.receive(RosserialId.PARAMETER, text("other"))
    assert [message.data[0] for message in bench.sent()] == [1, 0]
    bench.receive(RosserialId.LOG, b"\x02" + text("hot"))
    assert bench.dialect.events() == [BoardLogged(logging.WARNING, "hot")]


def test_a_service_of_the_board_answers_a_call_without_a_request_behind_it() -> None:
    trigger = "937c9679a518e3a18d831e57125ea522"
    bench = ready(
        (RosserialId.SERVER_PUBLISHER, info(125, "open", "std_srvs/Trigger", trigger)),
        (RosserialId.SERVER_SUBSCRIBER, info(100, "open", "std_srvs/Trigger", EMPTY_MD5)),
    )
    bench.command("/open")
    assert bench.sent() == [RosserialMessage(100)]
    bench.receive(125, b"\x01\0\0\0\0")
    [ended] = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert (ended.status, ended.payload) == (CallStatus.DONE, b"\x01\0\0\0\0")


def test_a_request_of_the_board_is_delivered_and_its_response_sent() -> None:
    bench = ready(
        (RosserialId.CLIENT_PUBLISHER, info(125, "weather", "std_srvs/Empty", EMPTY_MD5)),
        (RosserialId.CLIENT_SUBSCRIBER, info(100, "weather", "std_srvs/Empty", EMPTY_MD5, buffer=4)),
    )
    bench.receive(125, b"?")
    [said] = bench.dialect.events()
    assert isinstance(said, MessageReceived)
    assert (said.topic.flow, said.payload) == (Flow.REQUESTS, b"?")
    bench.dialect.respond(said.topic, b"rain", bench.now)
    bench.dialect.respond(said.topic, b"sunshine", bench.now)
    assert bench.sent() == [RosserialMessage(100, b"rain")]


def test_other_topics_than_before_are_another_board() -> None:
    bench = ready()
    bench.get_ready((RosserialId.SUBSCRIBER, info(101, "hear", "std_msgs/Empty", EMPTY_MD5)))
    gone, again = bench.dialect.events()
    assert isinstance(gone, BoardLost)
    assert isinstance(again, BoardReady)
    assert [topic.name for topic in again.info.topics] == ["/hear"]


TWINS = (
    (RosserialId.PUBLISHER, info(126, "chatter", "std_msgs/String", STRING_MD5)),
    (RosserialId.SUBSCRIBER, info(102, "/hear", "std_msgs/String", STRING_MD5)),
)


def test_several_publishers_of_a_topic_are_one_topic_with_the_messages_of_all() -> None:
    bench = ready(*TOPICS, *TWINS)
    assert bench.dialect.info is not None
    assert [topic.name for topic in bench.dialect.info.topics] == ["/chatter", "/blink_led", "/hear"]
    for topic in (125, 126):
        bench.receive(topic, text(str(topic)))
    said = bench.dialect.events()
    assert [(each.topic.name, each.payload) for each in said if isinstance(each, MessageReceived)] == [
        ("/chatter", text("125")),
        ("/chatter", text("126")),
    ]


def test_each_subscriber_of_a_topic_gets_a_command_after_the_one_before_has_read_it() -> None:
    bench = ready(*TOPICS, *TWINS)
    command = bench.command("/hear", text("go"))
    bench.command()
    assert bench.sent() == [RosserialMessage(101, text("go")), RosserialMessage(RosserialId.PUBLISHER)]
    bench.announce(*TOPICS, *TWINS)
    assert bench.sent()[1:] == [RosserialMessage(102, text("go")), RosserialMessage(RosserialId.PUBLISHER)]
    assert not bench.dialect.events()
    bench.announce(*TOPICS, *TWINS)
    [ended] = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert (ended.command, ended.status) == (command, CallStatus.READ)
    assert bench.sent()[1:] == [RosserialMessage(100), RosserialMessage(RosserialId.PUBLISHER)]


def test_a_topic_at_another_id_once_all_are_known_is_another_board() -> None:
    bench = ready()
    bench.receive(RosserialId.PUBLISHER, info(130, "chatter", "std_msgs/String", STRING_MD5))
    [gone] = bench.dialect.events()
    assert isinstance(gone, BoardLost)


def test_each_client_of_a_service_gets_its_own_answer() -> None:
    kind = "rosserial_arduino/Test"
    clients = [
        (flow, info(topic, "weather", kind, "0825d95fdfa2c8f4bbb4e9c74bccd3fd"))
        for flow, topic in (
            (RosserialId.CLIENT_PUBLISHER, 125),
            (RosserialId.CLIENT_PUBLISHER, 126),
            (RosserialId.CLIENT_SUBSCRIBER, 100),
            (RosserialId.CLIENT_SUBSCRIBER, 101),
        )
    ]
    bench = ready(*clients)
    for topic, answers in ((126, 101), (125, 100)):
        bench.receive(topic, b"?")
        [said] = bench.dialect.events()
        assert isinstance(said, MessageReceived)
        bench.dialect.respond(said.topic, b"rain", bench.now)
        assert bench.sent() == [RosserialMessage(answers, b"rain")]


def unplugged() -> tuple[Bench, Command]:
    """A bench whose cable was pulled for a second, a second after a command was sent."""
    bench = ready()
    command = bench.command()
    assert bench.sent()
    bench.after(1.0)
    bench.dialect.closed(bench.now)
    assert bench.dialect.events() == [BoardLost("the line is closed")]
    bench.after(1.0)
    bench.dialect.opened(bench.now)
    return bench, command


@pytest.mark.parametrize("kind", [RosserialId.TIME, 125], ids=["a question for the time", "a message"])
def test_a_board_that_speaks_unasked_after_an_unplugged_cable_has_not_restarted(kind: int) -> None:
    bench, command = unplugged()
    assert bench.after(3.0) == []  # asked for its topics, a board that was restarted would speak too
    bench.receive(kind, b"" if kind == RosserialId.TIME else text("on"))
    happenings = bench.dialect.events()
    assert isinstance(happenings[0], BoardReady)
    assert [type(each) for each in happenings[1:]] == ([] if kind == RosserialId.TIME else [MessageReceived])
    assert RosserialMessage(RosserialId.PUBLISHER) in bench.sent()
    bench.announce(*TOPICS)
    [ended] = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert (ended.command, ended.status) == (command, CallStatus.READ)


def test_an_announcement_after_an_unplugged_cable_answers_the_request_behind_the_command() -> None:
    bench, command = unplugged()
    bench.announce(*TOPICS)
    ended = bench.dialect.events()[-1]
    assert isinstance(ended, CommandFinished)
    assert (ended.command, ended.status) == (command, CallStatus.READ)


def test_a_board_that_stays_silent_after_an_unplugged_cable_leaves_the_command_in_doubt() -> None:
    bench, command = unplugged()
    bench.receive(RosserialId.LOG, b"\x01" + text("setup"))  # a sketch may log before it was asked
    bench.dialect.events()
    while not (sent := bench.after(0.1)):
        assert bench.now < 120.0 + ROSSERIAL_PACE.forgets
        assert bench.dialect.next_tick > bench.now
    assert bench.now >= 100.0 + ROSSERIAL_PACE.forgets
    [ended] = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert (ended.command, ended.reason) == (command, "doubt")
    assert sent == [RosserialMessage(RosserialId.PUBLISHER)]
    bench.get_ready(*TOPICS)
    assert isinstance(bench.dialect.events()[0], BoardReady)


def test_a_command_that_an_unplugged_cable_may_have_cut_off_is_in_doubt_at_once() -> None:
    bench = ready()
    command = bench.command()
    bench.after(ROSSERIAL_PACE.cut_off / 2)
    bench.dialect.closed(bench.now)
    [ended, lost] = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert (ended.command, ended.reason) == (command, "doubt")
    assert isinstance(lost, BoardLost)


def test_a_command_that_waits_for_its_board_ends_at_its_deadline() -> None:
    bench = ready()
    command = bench.command(seconds=5.0)
    bench.after(1.0)
    bench.dialect.closed(bench.now)
    bench.dialect.events()
    bench.after(4.0)
    [ended] = bench.dialect.events()
    assert isinstance(ended, CommandFinished)
    assert (ended.command, ended.reason) == (command, "doubt")


def test_a_board_that_is_busy_for_long_does_not_make_the_line_busy() -> None:
    bench = ready()
    bench.command()
    for _ in range(100):
        bench.after(0.1)
        assert bench.dialect.next_tick > bench.now


def test_a_late_answer_to_an_earlier_request_does_not_end_the_next_command() -> None:
    bench = ready()
    bench.command()
    bench.after(ROSSERIAL_PACE.repeat)  # so the board has two requests
    bench.announce(*TOPICS)
    later = bench.command("/hear", text("on"))
    bench.after(0.3)
    begun = [later.begun]
    bench.announce(*TOPICS)
    assert [*begun, later.begun] == [False, True]
    assert later not in [event.command for event in bench.dialect.events() if isinstance(event, CommandFinished)]


def ended(bench: Bench) -> list[Command]:
    """The commands that have ended since the last look."""
    return [event.command for event in bench.dialect.events() if isinstance(event, CommandFinished)]


def test_the_answer_to_a_request_of_a_quiet_board_does_not_end_a_command() -> None:
    bench = ready()
    assert bench.after(ROSSERIAL_PACE.quiet) == [RosserialMessage(RosserialId.PUBLISHER)]
    later = bench.command("/hear", text("on"))
    assert bench.sent() == []  # it waits for the answer
    bench.announce(*TOPICS)
    assert (later.begun, ended(bench)) == (True, [])
    bench.announce(*TOPICS)
    assert ended(bench) == [later]


def test_an_answer_that_is_later_than_a_command_waits_does_not_end_it() -> None:
    """A board on a busy machine; or the answer is lost, and the command ends with that to its repeated request."""
    bench = ready()
    bench.after(ROSSERIAL_PACE.quiet)
    later = bench.command("/hear", text("on"))
    bench.after(ROSSERIAL_PACE.missing)
    assert later.begun
    bench.announce(*TOPICS)
    assert ended(bench) == []
    assert RosserialMessage(RosserialId.PUBLISHER) in bench.after(ROSSERIAL_PACE.repeat)
    bench.announce(*TOPICS)
    assert ended(bench) == [later]
