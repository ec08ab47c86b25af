"""The codec of rosserial, and the types of std_msgs."""

from __future__ import annotations

import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridges.serial.dialect import LineCounters
from bridges.serial.rosserial import (
    ASK_TOPICS,
    PUBLISHER,
    STOP,
    MalformedMessage,
    RosserialDecoder,
    RosserialMessage,
    decode_log,
    decode_parameter_name,
    decode_topic_info,
    encode_message,
    encode_parameter,
    encode_time,
    longest_frame,
)
from bridges.serial.rosserial_topics import known_type
from schemas.errors import InvalidPayload
from schemas.payloads import String

messages = st.builds(RosserialMessage, st.integers(0, 0xFFFF), st.binary(max_size=300))


def text(value: str) -> bytes:
    return len(value).to_bytes(4, "little") + value.encode()


@pytest.mark.parametrize(
    ("message", "line"),
    [
        (RosserialMessage(PUBLISHER), "ff fe 00 00 ff 00 00 ff"),
        (RosserialMessage(100), "ff fe 00 00 ff 64 00 9b"),
        (RosserialMessage(125, String("abc").encode()), "ff fe 07 00 f8 7d 00 03 00 00 00 61 62 63 59"),
        (RosserialMessage(STOP), "ff fe 00 00 ff 0b 00 f4"),
    ],
)
def test_messages_are_the_bytes_of_rosserial(message: RosserialMessage, line: str) -> None:
    assert encode_message(message).hex(" ") == line
    assert RosserialDecoder(LineCounters()).feed(bytes.fromhex(line)) == [message]


def test_the_request_for_topics_is_an_empty_message() -> None:
    assert encode_message(RosserialMessage(PUBLISHER)) == ASK_TOPICS


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
        with pytest.raises(MalformedMessage):
            decode_topic_info(data[:cut])
    with pytest.raises(MalformedMessage):
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
    with pytest.raises(MalformedMessage):
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
        known = known_type(name)
        assert known is not None
        assert known.md5 == digest
    assert known_type("sensor_msgs/Range") is None


def test_a_payload_of_the_wrong_length_is_invalid() -> None:
    number, string = known_type("std_msgs/UInt16"), known_type("std_msgs/String")
    assert number is not None
    assert string is not None
    number.check(b"\0\0")
    string.check(String("ä").encode())
    with pytest.raises(InvalidPayload):
        number.check(b"\0")
    with pytest.raises(InvalidPayload):
        string.check(b"\x02\0\0\0a")
