"""Types of payloads, the two ROS types of the lessons, and Python values as payloads."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from typing import Any

import msgspec
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from schemas import EMPTY, JSON, RAW, STRING, Empty, InvalidPayload, PayloadType, String, payload_type
from schemas.payloads import decode_value, encode_value


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (EMPTY, "ros1;std_msgs/Empty"),
        (STRING, "ros1;std_msgs/String"),
        (JSON, "application/json"),
        (RAW, "application/octet-stream"),
        (PayloadType("ros1", "sensor_msgs/Image", "ros1msg"), "ros1;sensor_msgs/Image"),
        (PayloadType("json", "Measurement", "jsonschema"), "application/json;Measurement"),
        (PayloadType("cdr", "std_msgs/msg/String", "ros2msg"), "application/cdr;std_msgs/msg/String"),
        (PayloadType("protobuf", "pkg.Type", "protobuf"), "application/protobuf;pkg.Type"),
        (PayloadType("text/plain"), "text/plain"),
    ],
)
def test_a_type_and_its_encoding_convert_both_ways(kind: PayloadType, text: str) -> None:
    assert kind.zenoh_encoding == text
    assert payload_type(text) == kind
    assert str(zenoh.Encoding(text)) == text


def test_no_encoding_is_raw_bytes() -> None:
    assert payload_type("") == payload_type("zenoh/bytes") == payload_type(str(zenoh.Encoding(""))) == RAW


def test_description_of_a_type_does_not_travel() -> None:
    described = PayloadType("json", "Measurement", "jsonschema", b'{"type":"object"}')
    assert payload_type(described.zenoh_encoding) == PayloadType("json", "Measurement", "jsonschema")


def test_md5_sums_are_those_of_the_definitions() -> None:
    # ROS takes the sum of the definition without its last line end.
    for kind in (Empty, String):
        assert hashlib.md5(kind.definition.rstrip("\n").encode()).hexdigest() == kind.md5
        assert kind.type.schema_data == kind.definition.encode()


def test_empty_has_no_bytes() -> None:
    assert Empty().encode() == b""
    assert Empty.decode(b"") == Empty()
    with pytest.raises(InvalidPayload):
        Empty.decode(b"\0")


def test_string_is_its_length_and_its_text() -> None:
    assert String("blue").encode() == b"\4\0\0\0blue"
    assert String.decode(b"\2\0\0\0\xc3\xa9") == String("é")


@given(st.text())
def test_every_string_survives(text: str) -> None:
    assert String.decode(String(text).encode()) == String(text)


@pytest.mark.parametrize("payload", [b"", b"\0\0\0", b"\1\0\0\0", b"\1\0\0\0ab", b"\xff\xff\xff\xffa", b"\1\0\0\0\xff"])
def test_invalid_strings_are_refused(payload: bytes) -> None:
    with pytest.raises(InvalidPayload) as caught:
        String.decode(payload)
    assert caught.value.type_name == "std_msgs/String"


def test_text_without_utf_8_form_is_refused() -> None:
    with pytest.raises(InvalidPayload):
        String("\ud800").encode()


@given(st.binary(max_size=40))
def test_any_bytes_decode_or_raise_invalid_payload(payload: bytes) -> None:
    for kind in (Empty, String):
        with suppress(InvalidPayload):
            assert kind.decode(payload).encode() == payload


class Measurement(msgspec.Struct):
    celsius: float


@pytest.mark.parametrize(
    ("value", "payload", "kind"),
    [
        (Empty(), b"", EMPTY),
        (String("blue"), b"\4\0\0\0blue", STRING),
        ("blue", b"\4\0\0\0blue", STRING),
        (b"\0\1", b"\0\1", RAW),
        (bytearray(b"\0\1"), b"\0\1", RAW),
        (memoryview(b"\0\1"), b"\0\1", RAW),
        ({"a": 1}, b'{"a":1}', JSON),
        ([1, None], b"[1,null]", JSON),
        (Measurement(21.5), b'{"celsius":21.5}', JSON),
    ],
)
def test_value_has_its_payload_and_type(value: object, payload: bytes, kind: PayloadType) -> None:
    assert encode_value(value) == (payload, kind)


def test_payload_is_read_by_its_type() -> None:
    assert decode_value(b"", EMPTY) == Empty()
    assert decode_value(b"\4\0\0\0blue", STRING) == String("blue")
    assert decode_value(b'{"a":1}', JSON) == {"a": 1}
    for kind in (RAW, PayloadType("ros1", "sensor_msgs/Image"), PayloadType("cdr", "std_msgs/msg/String")):
        assert decode_value(b"\4\0\0\0blue", kind) == b"\4\0\0\0blue"


@pytest.mark.parametrize("value", [object(), {1: object()}, {"a": 1j}, [10**5000]])
def test_a_value_that_can_not_be_encoded_is_refused(value: Any) -> None:
    with pytest.raises(InvalidPayload):
        encode_value(value)


@pytest.mark.parametrize(
    ("payload", "kind"),
    [(b"x", EMPTY), (b"x", STRING), (b"x", JSON), (b"", JSON), (b'"\xff"', JSON), (b"[" * 100_000, JSON)],
)
def test_payload_that_is_not_of_its_type_is_refused(payload: bytes, kind: PayloadType) -> None:
    with pytest.raises(InvalidPayload):
        decode_value(payload, kind)
