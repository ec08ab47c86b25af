"""Python values as payloads."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from schemas import EMPTY, JSON, RAW, STRING, Empty, InvalidPayload, PayloadType, String
from schemas.values import decode_value, encode_value


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
def test_value_that_can_not_travel_is_refused(value: Any) -> None:
    with pytest.raises(InvalidPayload):
        encode_value(value)


@pytest.mark.parametrize(
    ("payload", "kind"),
    [(b"x", EMPTY), (b"x", STRING), (b"x", JSON), (b"", JSON), (b'"\xff"', JSON), (b"[" * 100_000, JSON)],
)
def test_payload_that_is_not_of_its_type_is_refused(payload: bytes, kind: PayloadType) -> None:
    with pytest.raises(InvalidPayload):
        decode_value(payload, kind)
