"""Calls carry values: a board gets them in the type of its topic, whatever the caller sent."""

from __future__ import annotations

import struct

import pytest

from bridges.serial._edge import convert
from schemas import EMPTY, JSON, RAW, STRING, Empty, PayloadType, payload_type
from schemas.payloads import encode_value

FLOAT32, UINT8 = payload_type("ros1;std_msgs/Float32"), payload_type("ros1;std_msgs/UInt8")


@pytest.mark.parametrize(
    ("value", "wanted", "payload"),
    [
        ("blue", JSON, b'"blue"'),
        (90, JSON, b"90"),
        (1.5, JSON, b"1.5"),
        ([1, 2], JSON, b"[1,2]"),
        (90, UINT8, b"\x5a"),
        (90, FLOAT32, struct.pack("<f", 90)),
        (True, UINT8, b"\1"),
        (None, EMPTY, b""),
        (Empty(), JSON, b""),
        (b"\0\1", STRING, b"\0\1"),
        ("blue", RAW, b"\4\0\0\0blue"),
        ("blue", PayloadType("ros1", "my/Type", "ros1msg"), b"\4\0\0\0blue"),
    ],
)
def test_a_value_is_converted_to_the_type_of_the_topic(value: object, wanted: PayloadType, payload: bytes) -> None:
    assert convert(*encode_value(value), wanted) == payload


@pytest.mark.parametrize(
    ("payload", "given", "wanted", "converted"),
    [
        (b'"blue"', JSON, STRING, b"\4\0\0\0blue"),
        (b"null", JSON, EMPTY, b""),
        (b"5", JSON, FLOAT32, struct.pack("<f", 5)),
        (b"5", payload_type("application/json;Speed"), JSON, b"5"),
        (b"300", JSON, UINT8, b"300"),
        (b"5", JSON, STRING, b"5"),
        (b"no json", JSON, STRING, b"no json"),
    ],
)
def test_json_is_converted_if_it_can_be(
    payload: bytes, given: PayloadType, wanted: PayloadType, converted: bytes
) -> None:
    assert convert(payload, given, wanted) == converted
