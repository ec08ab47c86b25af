"""Types of payloads, the two ROS types of the lessons, and Python values as payloads."""

from __future__ import annotations

import hashlib
import struct
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from schemas import EMPTY, JSON, RAW, STRING, Empty, InvalidPayload, PayloadType, String, payload_type
from schemas.payloads import Payload, decode_value, encode_as, encode_value


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


@dataclass
class Place:
    latitude: float
    longitude: float


def ros(name: str) -> PayloadType:
    return payload_type(f"ros1;std_msgs/{name}")


@pytest.mark.parametrize(
    ("value", "payload", "kind"),
    [
        (Empty(), b"", EMPTY),
        (String("blue"), b"\4\0\0\0blue", STRING),
        ("blue", b"\4\0\0\0blue", STRING),
        (b"\0\1", b"\0\1", RAW),
        (bytearray(b"\0\1"), b"\0\1", RAW),
        (memoryview(b"\0\1"), b"\0\1", RAW),
        (None, b"", EMPTY),
        (True, b"\1", ros("Bool")),
        (-2, b"\xfe" + b"\xff" * 7, ros("Int64")),
        (1 << 63, b"\0" * 7 + b"\x80", ros("UInt64")),
        (21.5, struct.pack("<d", 21.5), ros("Float64")),
        ([1, 2], b"\0" * 8 + struct.pack("<Iqq", 2, 1, 2), ros("Int64MultiArray")),
        ((1, 2.5), b"\0" * 8 + struct.pack("<Idd", 2, 1, 2.5), ros("Float64MultiArray")),
        ([], b"\0" * 12, ros("Float64MultiArray")),
        (Payload(b"\1", ros("UInt8")), b"\1", ros("UInt8")),
        ({"a": 1}, b'{"a":1}', JSON),
        ([1, None], b"[1,null]", JSON),
        ([[]], b"[[]]", JSON),
        ([[1], [2, 3]], b"[[1],[2,3]]", JSON),
        ([True], b"[true]", JSON),
        (Measurement(21.5), b'{"celsius":21.5}', JSON),
        (Place(52.5, 13.4), b'{"latitude":52.5,"longitude":13.4}', JSON),
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


NOT_FINITE = (float("nan"), float("inf"), float("-inf"))


@pytest.mark.parametrize("value", [1.5, -7, 1 << 63, True, [1, 2], [1.5, 2.5], [[1, 2], [3, 4]], [[[1.5], [2.5]]], []])
def test_numbers_and_arrays_of_numbers_survive(value: object) -> None:
    payload, kind = encode_value(value)
    assert kind.encoding == "ros1"
    assert kind.schema_data
    assert decode_value(payload, kind) == value
    assert payload_type(kind.zenoh_encoding) == kind


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.float64(1.5), 1.5),
        (np.float32(1.5), 1.5),
        (np.int8(-3), -3),
        (np.bool_(True), True),
        (np.array(2.5), 2.5),
        (np.arange(3), [0, 1, 2]),
        (np.array([[1.5, 2.5], [3.5, 4.5]], dtype=np.float32), [[1.5, 2.5], [3.5, 4.5]]),
        ([np.float64(1.5), np.float64(2.5)], [1.5, 2.5]),
        ({"a": np.float32(1.5), "b": [np.arange(2)]}, {"a": 1.5, "b": [[0, 1]]}),
    ],
)
def test_values_of_numpy_are_those_of_python(value: object, expected: object) -> None:
    decoded = decode_value(*encode_value(value))
    assert (type(decoded), decoded) == (type(expected), expected)


@pytest.mark.parametrize("number", NOT_FINITE)
def test_nan_is_kept_in_numbers_and_refused_in_json(number: float) -> None:
    kept: tuple[object, ...] = (number, [1.0, number], np.array([number]))
    refused: tuple[object, ...] = (
        {"a": {"b": [1, number]}, "c": None},
        Measurement(number),
        [None, number],
        {"a": np.array([number])},
    )
    for value in kept:
        decoded = decode_value(*encode_value(value))
        assert repr(number) in repr(decoded)
    for value in refused:
        with pytest.raises(InvalidPayload) as caught:
            encode_value(value)
        assert repr(number) in str(caught.value)
    assert encode_value({"a": None, "b": "null"})[1] == JSON


def test_the_place_of_a_nan_is_named() -> None:
    with pytest.raises(InvalidPayload) as caught:
        encode_value({"wheels": [{"speed": 1.0}, {"speed": float("nan")}], "none": None})
    assert "wheels[1].speed" in str(caught.value)


@given(st.binary(max_size=60), st.sampled_from(["Bool", "Int8", "Float64", "Float64MultiArray", "UInt8MultiArray"]))
def test_any_bytes_are_a_number_or_refused(payload: bytes, name: str) -> None:
    with suppress(InvalidPayload):
        decode_value(payload, ros(name))


def test_arrays_of_other_senders_are_read_with_labels_and_without_sizes() -> None:
    label = b"\1\0\0\0x"
    sizes = struct.pack("<II", 2, 4) + b"\0\0\0\0" + struct.pack("<II", 2, 2)
    data = struct.pack("<II4f", 0, 4, 1, 2, 3, 4)
    assert decode_value(b"\2\0\0\0" + label + sizes + data, ros("Float32MultiArray")) == [[1, 2], [3, 4]]
    wrong = label + struct.pack("<II", 3, 3)
    assert decode_value(b"\1\0\0\0" + wrong + data, ros("Float32MultiArray")) == [1, 2, 3, 4]


@pytest.mark.parametrize(
    ("value", "kind", "payload"),
    [
        (5, ros("Float64"), struct.pack("<d", 5)),
        (5, ros("UInt8"), b"\5"),
        (True, ros("Bool"), b"\1"),
        ([1, 2], ros("UInt8MultiArray"), b"\0" * 8 + b"\2\0\0\0\1\2"),
        ("blue", STRING, b"\4\0\0\0blue"),
        (None, EMPTY, b""),
        (5, JSON, b"5"),
        ([1, 2.5], JSON, b"[1,2.5]"),
        (String("blue"), JSON, b'"blue"'),
        (5, RAW, None),
    ],
)
def test_a_value_is_encoded_as_a_given_type(value: object, kind: PayloadType, payload: bytes | None) -> None:
    assert encode_as(value, kind) == payload


@pytest.mark.parametrize(
    ("value", "kind"),
    [(300, ros("UInt8")), (1.5, ros("Int64")), ("x", ros("Float64")), (5, STRING), ("x", EMPTY), (object(), JSON)],
)
def test_a_value_without_a_form_in_a_type_is_refused(value: object, kind: PayloadType) -> None:
    with pytest.raises(InvalidPayload):
        encode_as(value, kind)


@pytest.mark.parametrize("value", [object(), {1: object()}, {"a": 1j}, [10**5000], 1 << 64, -(1 << 64), np.float64])
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
