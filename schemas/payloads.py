"""Payloads of topics: their types, in Zenoh's encoding field and in the schemas of recordings, and Python values.

Payloads are carried unchanged; the type says how to decode them. The ROS types of the legacy network's lessons,
std_msgs/Empty and std_msgs/String, are defined here, those of numbers in `schemas.std_msgs`; of other types only the
name travels with a message.
"""

from __future__ import annotations

import math
from struct import Struct as Layout
from typing import Any, ClassVar, Final

import msgspec
from msgspec import Struct

from schemas import std_msgs
from schemas.errors import InvalidPayload

_LENGTH: Final = Layout("<I")
_MEDIA_TYPES: Final = {
    "json": "application/json",
    "cdr": "application/cdr",
    "protobuf": "application/protobuf",
    "application/octet-stream": "application/octet-stream",
}
_ENCODINGS: Final = {media_type: encoding for encoding, media_type in _MEDIA_TYPES.items()}
_SCHEMA_ENCODINGS: Final = {"ros1": "ros1msg", "json": "jsonschema", "cdr": "ros2msg", "protobuf": "protobuf"}
_NO_ENCODINGS: Final = ("", "zenoh/bytes")
_DECODER: Final = msgspec.json.Decoder()


class PayloadType(Struct, frozen=True):
    """How to decode a payload, in the terms of MCAP.

    `encoding` is the message encoding (`ros1`, `json`, `cdr`, `protobuf`, …), `schema_name` the type's name,
    `schema_encoding` says how `schema_data` describes it; both are empty if the description is not known.
    """

    encoding: str
    schema_name: str = ""
    schema_encoding: str = ""
    schema_data: bytes = b""

    @property
    def zenoh_encoding(self) -> str:
        """The text of Zenoh's encoding field: `ros1;std_msgs/Empty`, `application/json`, …"""
        media_type = _MEDIA_TYPES.get(self.encoding, self.encoding)
        return f"{media_type};{self.schema_name}" if self.schema_name else media_type


class Empty(Struct, frozen=True):
    """std_msgs/Empty: no bytes."""

    type: ClassVar[PayloadType] = PayloadType("ros1", "std_msgs/Empty", "ros1msg", b"")
    md5: ClassVar[str] = "d41d8cd98f00b204e9800998ecf8427e"
    definition: ClassVar[str] = ""

    def encode(self) -> bytes:
        """The payload."""
        return b""

    @classmethod
    def decode(cls, payload: bytes) -> Empty:
        """The message in a payload. Raises `InvalidPayload` if there are bytes in it."""
        if payload:
            raise InvalidPayload("std_msgs/Empty", f"it has {len(payload)} bytes")
        return cls()


class String(Struct, frozen=True):
    """std_msgs/String: a length of four bytes, little-endian, and that many bytes of UTF-8."""

    data: str

    type: ClassVar[PayloadType] = PayloadType("ros1", "std_msgs/String", "ros1msg", b"string data\n")
    md5: ClassVar[str] = "992ce8a1687cec8c8bd883ec73ca41d1"
    definition: ClassVar[str] = "string data\n"

    def encode(self) -> bytes:
        """The payload. Raises `InvalidPayload` if the text has no UTF-8 form (a lone surrogate)."""
        try:
            text = self.data.encode()
        except UnicodeEncodeError as error:
            raise InvalidPayload("std_msgs/String", str(error)) from None
        return _LENGTH.pack(len(text)) + text

    @classmethod
    def decode(cls, payload: bytes) -> String:
        """The message in a payload. Raises `InvalidPayload` if the length does not fit or the text is not UTF-8."""
        if len(payload) < _LENGTH.size or _LENGTH.unpack_from(payload)[0] != len(payload) - _LENGTH.size:
            raise InvalidPayload("std_msgs/String", f"its length field does not match its {len(payload)} bytes")
        try:
            return cls(payload[_LENGTH.size :].decode())
        except UnicodeDecodeError as error:
            raise InvalidPayload("std_msgs/String", str(error)) from None


EMPTY: Final = Empty.type
STRING: Final = String.type
JSON: Final = PayloadType("json", "", "jsonschema", b'{"type":"object","properties":{}}')
RAW: Final = PayloadType("application/octet-stream")

_NUMERIC: Final = {
    name: PayloadType("ros1", name, "ros1msg", text.encode()) for name, text in std_msgs.DEFINITIONS.items()
}
"""The ROS types of a number or an array of numbers, by name."""
_KNOWN: Final = {known.zenoh_encoding: known for known in (EMPTY, STRING, JSON, RAW, *_NUMERIC.values())}


def payload_type(zenoh_encoding: str) -> PayloadType:
    """The type in the text of Zenoh's encoding field; `RAW` if it is empty.

    `schema_data` is empty for a type that is not defined here.
    """
    known = _KNOWN.get(zenoh_encoding)
    if known is not None:
        return known
    if zenoh_encoding in _NO_ENCODINGS:
        return RAW
    media_type, _, name = zenoh_encoding.partition(";")
    encoding = _ENCODINGS.get(media_type, media_type)
    return PayloadType(encoding, name, _SCHEMA_ENCODINGS.get(encoding, ""))


class Payload(Struct, frozen=True):
    """A message that is encoded already: its payload, and the type of that."""

    data: bytes
    type: PayloadType


def encode_value(value: object) -> tuple[bytes, PayloadType]:
    """The payload of a value, and its type.

    `Empty` and None, `String` and str, bool, int and float become the ROS types of that kind, lists of numbers a
    std_msgs/Float64MultiArray (or Int64MultiArray). bytes and a `Payload` stay unchanged. A msgspec Struct, a
    dataclass, a dict or any other value that JSON can represent becomes JSON. Numbers and arrays of numpy count as
    those of Python. Raises `InvalidPayload` for other values, and for NaN or infinity in JSON, which has no form for
    them.
    """
    match value:
        case Empty() | String():
            return value.encode(), value.type
        case None:
            return b"", EMPTY
        case str():
            return String(value).encode(), STRING
        case bytes() | bytearray() | memoryview():
            return bytes(value), RAW
        case Payload():
            return value.data, value.type
    if hasattr(type(value), "tolist"):
        return encode_value(_plain(value))
    name = _numeric_type(value)
    return (_encode_json(value), JSON) if name is None else (_encode_numeric(name, value), _NUMERIC[name])


def encode_as(value: object, kind: PayloadType) -> bytes | None:
    """The payload of a value in a type that is defined here, or JSON; None for any other type.

    Raises `InvalidPayload` if the value has no form in that type.
    """
    name = kind.schema_name
    if kind.encoding == "ros1" and name in _NUMERIC:
        return _encode_numeric(name, value)
    if kind in (STRING, EMPTY):
        payload, found = encode_value(value)
        if found != kind:
            raise InvalidPayload(name, f"it is a {found.schema_name or found.encoding}")
        return payload
    if kind.encoding == "json":
        return _encode_json(value.data if isinstance(value, String) else None if isinstance(value, Empty) else value)
    return None


def decode_value(payload: bytes, kind: PayloadType) -> Any:
    """The value of a payload of type `kind`: `Empty`, `String`, a number, a list of numbers, JSON data.

    For any other type it is the bytes. Raises `InvalidPayload` if the payload is not of that type.
    """
    match kind.encoding, kind.schema_name:
        case "ros1", EMPTY.schema_name:
            return Empty.decode(payload)
        case "ros1", STRING.schema_name:
            return String.decode(payload)
        case "ros1", name if name in _NUMERIC:
            try:
                return std_msgs.decode(name, payload)
            except ValueError as error:
                raise InvalidPayload(name, str(error)) from None
        case "json", _:
            try:
                return _DECODER.decode(payload)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                raise InvalidPayload("json", str(error)) from None
    return payload


def _numeric_type(value: object) -> str | None:
    """The ROS type of a number, or of a list of numbers; None for anything else."""
    match value:
        case bool():
            return "std_msgs/Bool"
        case int():
            return "std_msgs/Int64" if value < 1 << 63 else "std_msgs/UInt64"
        case float():
            return "std_msgs/Float64"
        case list() | tuple():
            return std_msgs.array_type(value)
    return None


def _encode_numeric(name: str, value: Any) -> bytes:
    try:
        return std_msgs.encode(name, value)
    except ValueError as error:
        raise InvalidPayload(name, str(error)) from None


def _plain(value: Any) -> Any:
    """A value that JSON has no form for, as one of Python: an array of numpy as a list, its scalar as a number."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no form in JSON")


_ENCODER: Final = msgspec.json.Encoder(enc_hook=_plain)


def _encode_json(value: object) -> bytes:
    try:
        payload = _ENCODER.encode(value)
        if b"null" in payload:  # perhaps not only of None: msgspec writes it for NaN and infinity, too
            _check_finite(msgspec.to_builtins(value, enc_hook=_plain))
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InvalidPayload(type(value).__name__, str(error)) from None
    return payload


def _check_finite(value: object, path: str = "") -> None:
    """Raise `ValueError` for a number in JSON data that JSON has no form for."""
    match value:
        case float() if not math.isfinite(value):
            raise ValueError(f"{path.lstrip('.') or 'it'} is {value}, which JSON can't hold; use None, or leave it out")
        case dict():
            for key, member in value.items():
                _check_finite(member, f"{path}.{key}")
        case list() | tuple() | set() | frozenset():
            for number, member in enumerate(value):
                _check_finite(member, f"{path}[{number}]")
