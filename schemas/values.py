"""Python values as payloads of topics, and back: what an agent's code says and hears."""

from __future__ import annotations

from typing import Any, Final

import msgspec

from schemas.errors import InvalidPayload
from schemas.payloads import EMPTY, JSON, RAW, STRING, Empty, PayloadType, String

_ENCODER: Final = msgspec.json.Encoder()
_DECODER: Final = msgspec.json.Decoder()


def encode_value(value: object) -> tuple[bytes, PayloadType]:
    """The payload of a value, and its type.

    `Empty`, `String` and str become the ROS types, bytes travel as they are; a msgspec Struct, a dict or anything else
    that JSON can hold becomes JSON. Raises `InvalidPayload` for what can't travel.
    """
    match value:
        case Empty() | String():
            return value.encode(), value.type
        case str():
            return String(value).encode(), STRING
        case bytes() | bytearray() | memoryview():
            return bytes(value), RAW
    try:
        return _ENCODER.encode(value), JSON
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InvalidPayload(type(value).__name__, str(error)) from None


def decode_value(payload: bytes, kind: PayloadType) -> Any:
    """What a payload of `kind` says: `Empty`, `String`, JSON data, or the bytes themselves for any other type.

    Raises `InvalidPayload` if the payload is not what its type says.
    """
    match kind.encoding, kind.schema_name:
        case "ros1", EMPTY.schema_name:
            return Empty.decode(payload)
        case "ros1", STRING.schema_name:
            return String.decode(payload)
        case "json", _:
            try:
                return _DECODER.decode(payload)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                raise InvalidPayload("json", str(error)) from None
    return payload
