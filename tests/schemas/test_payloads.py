"""Types of payloads, and the two ROS types that lessons use."""

from __future__ import annotations

import hashlib
from contextlib import suppress

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from schemas import EMPTY, JSON, RAW, STRING, Empty, InvalidPayload, PayloadType, String, payload_type


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
def test_type_and_encoding_belong_together(kind: PayloadType, text: str) -> None:
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
def test_what_is_no_string_is_refused(payload: bytes) -> None:
    with pytest.raises(InvalidPayload) as caught:
        String.decode(payload)
    assert caught.value.type_name == "std_msgs/String"


def test_text_without_utf_8_form_is_refused() -> None:
    with pytest.raises(InvalidPayload):
        String("\ud800").encode()


@given(st.binary(max_size=40))
def test_no_bytes_raise_anything_but_invalid_payload(payload: bytes) -> None:
    for kind in (Empty, String):
        with suppress(InvalidPayload):
            assert kind.decode(payload).encode() == payload
