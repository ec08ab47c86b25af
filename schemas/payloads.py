"""Payloads of topics: their types, in Zenoh's encoding field and in the schemas of recordings, and Python values.

Payloads are carried unchanged; the type says how to decode them. The std_msgs of ROS 1 that the legacy network's
lessons use are defined here: Empty, String, and those of one number or an array of numbers, which need no more than
`struct`, as they are little-endian and packed. Of other types only the name travels in Zenoh's encoding; the definition
travels now and then, in a message's attachment (`SentDefinitions`).
"""

from __future__ import annotations

import math
import struct
from struct import Struct as Layout
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

import msgspec
from msgspec import Struct

from schemas.decoding import InvalidData, decode_json
from schemas.errors import InvalidPayload

if TYPE_CHECKING:
    from collections.abc import Sequence


_MEDIA_TYPES: Final = {
    "json": "application/json",
    "cdr": "application/cdr",
    "protobuf": "application/protobuf",
    "application/octet-stream": "application/octet-stream",
}
_ENCODINGS: Final = {media_type: encoding for encoding, media_type in _MEDIA_TYPES.items()}
_SCHEMA_ENCODINGS: Final = {"ros1": "ros1msg", "json": "jsonschema", "cdr": "ros2msg", "protobuf": "protobuf"}


_FORMATS: Final = {
    "Bool": "?",
    "Int8": "b",
    "UInt8": "B",
    "Int16": "h",
    "UInt16": "H",
    "Int32": "i",
    "UInt32": "I",
    "Int64": "q",
    "UInt64": "Q",
    "Float32": "f",
    "Float64": "d",
}
_ARRAYS: Final = {f"{name}MultiArray": letter for name, letter in _FORMATS.items() if letter != "?"}
_LAYOUT: Final = f"""\
MultiArrayLayout layout
{{}}[] data
{"=" * 80}
MSG: std_msgs/MultiArrayLayout
MultiArrayDimension[] dim
uint32 data_offset
{"=" * 80}
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""
_COUNT: Final = Layout("<I")
_SIZES: Final = Layout("<II")
_MAX_DIMENSIONS: Final = 32

_NUMBERS: Final = {
    **{f"std_msgs/{name}": f"{name.lower()} data\n" for name in _FORMATS},
    **{f"std_msgs/{name}": _LAYOUT.format(name.removesuffix("MultiArray").lower()) for name in _ARRAYS},
}
"""The std_msgs of numbers, and their definitions."""


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
        return _COUNT.pack(len(text)) + text

    @classmethod
    def decode(cls, payload: bytes) -> String:
        """The message in a payload. Raises `InvalidPayload` if the length does not fit or the text is not UTF-8."""
        if len(payload) < _COUNT.size or _COUNT.unpack_from(payload)[0] != len(payload) - _COUNT.size:
            raise InvalidPayload("std_msgs/String", f"its length field does not match its {len(payload)} bytes")
        try:
            return cls(payload[_COUNT.size :].decode())
        except UnicodeDecodeError as error:
            raise InvalidPayload("std_msgs/String", str(error)) from None


EMPTY: Final = Empty.type
STRING: Final = String.type
JSON: Final = PayloadType("json", "", "jsonschema", b'{"type":"object","properties":{}}')
RAW: Final = PayloadType("application/octet-stream")

_NUMERIC: Final = {name: PayloadType("ros1", name, "ros1msg", text.encode()) for name, text in _NUMBERS.items()}
"""The ROS types of a number or an array of numbers, by name."""
_KNOWN: Final = {known.zenoh_encoding: known for known in (EMPTY, STRING, JSON, RAW, *_NUMERIC.values())}


def payload_type(zenoh_encoding: str) -> PayloadType:
    """The type in the text of Zenoh's encoding field; `RAW` if it is empty.

    `schema_data` is empty for a type that is not defined here.
    """
    known = _KNOWN.get(zenoh_encoding)
    if known is not None:
        return known
    if zenoh_encoding in ("", "zenoh/bytes"):
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
    return (_encode_json(value), JSON) if name is None else (_encode_numbers(name, value), _NUMERIC[name])


def encode_as(value: object, kind: PayloadType) -> bytes | None:
    """The payload of a value in a type that is defined here, or JSON; None for any other type.

    Raises `InvalidPayload` if the value has no form in that type.
    """
    name = kind.schema_name
    if kind.encoding == "ros1" and name in _NUMERIC:
        return _encode_numbers(name, value)
    if kind in (STRING, EMPTY):
        payload, found = encode_value(value)
        if found != kind:
            raise InvalidPayload(name, f"it is a {found.schema_name or found.encoding}")
        return payload
    if kind.encoding == "json":
        return _encode_json(_unwrapped(value))
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
            return _decode_numbers(name, payload)
        case "json", _:
            try:
                return decode_json(payload)
            except InvalidData as error:
                raise InvalidPayload("json", str(error)) from None
    return payload


def plain_value(payload: bytes, kind: PayloadType) -> Any:
    """The value of a payload as it was given to be sent: a text for std_msgs/String, None for std_msgs/Empty.

    Otherwise as `decode_value`.
    """
    return _unwrapped(decode_value(payload, kind))


def _unwrapped(value: Any) -> Any:
    return value.data if isinstance(value, String) else None if isinstance(value, Empty) else value


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
            return _array_type(value)
    return None


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


def _encode_numbers(type_name: str, value: Any) -> bytes:
    """The payload of a number, or of a list of numbers, nested as its array has dimensions."""
    name = type_name.removeprefix("std_msgs/")
    try:
        if name in _FORMATS:
            return struct.pack(f"<{_FORMATS[name]}", value)
        shape, numbers = _flattened(value)
        return _dimensions(shape) + struct.pack(f"<I{len(numbers)}{_ARRAYS[name]}", len(numbers), *numbers)
    except (struct.error, OverflowError, TypeError, ValueError) as error:
        raise InvalidPayload(type_name, str(error)) from None


def _decode_numbers(type_name: str, payload: bytes) -> Any:
    """The number, or the list of numbers, in a payload."""
    name = type_name.removeprefix("std_msgs/")
    try:
        if name in _FORMATS:
            return struct.unpack(f"<{_FORMATS[name]}", payload)[0]
        return _decode_array(_ARRAYS[name], payload)
    except (struct.error, ValueError) as error:
        raise InvalidPayload(type_name, str(error)) from None


def _array_type(value: Sequence[Any]) -> str | None:
    """The type of a list or tuple of numbers, or of rows of them that are equally long; None for anything else."""
    try:
        shape, numbers = _flattened(value)
    except ValueError:
        return None
    kinds = {type(number) for number in numbers}
    if not kinds <= {int, float} or (not numbers and len(shape) > 1):
        return None
    return "std_msgs/Int64MultiArray" if kinds == {int} else "std_msgs/Float64MultiArray"


def _flattened(value: Any) -> tuple[list[int], list[Any]]:
    """The sizes of an array's dimensions, and its elements. Raises `ValueError` if its rows are not alike."""
    shape, elements = [len(value)], list(value)
    while elements and all(isinstance(one, list | tuple) for one in elements):
        if len({len(one) for one in elements}) > 1 or len(shape) == _MAX_DIMENSIONS:
            raise ValueError("its rows differ in length, or it has too many dimensions")
        shape.append(len(elements[0]))
        elements = [number for row in elements for number in row]
    return shape, elements


def _dimensions(shape: list[int]) -> bytes:
    """The layout of an array; one of one dimension has none."""
    if len(shape) == 1:
        shape = []
    no_label, no_offset = _COUNT.pack(0), _COUNT.pack(0)
    parts = [no_label + _SIZES.pack(size, math.prod(shape[number:])) for number, size in enumerate(shape)]
    return _COUNT.pack(len(shape)) + b"".join(parts) + no_offset


def _decode_array(number: str, payload: bytes) -> list[Any]:
    offset, shape = _COUNT.size, list[int]()
    (dimensions,) = _COUNT.unpack_from(payload)
    if dimensions > _MAX_DIMENSIONS:
        raise ValueError(f"it has {dimensions} dimensions")
    for _ in range(dimensions):
        offset += _COUNT.size + _COUNT.unpack_from(payload, offset)[0]  # the label
        size, _ = _SIZES.unpack_from(payload, offset)
        offset += _SIZES.size
        shape.append(size)
    _, count = _SIZES.unpack_from(payload, offset)  # after the offset of the data, which is for readers
    numbers = list(struct.unpack(f"<{count}{number}", payload[offset + _SIZES.size :]))
    if math.prod(shape) == count:  # other senders may state no sizes, or wrong ones
        for size in reversed(shape[1:]):
            numbers = [numbers[start : start + size] for start in range(0, len(numbers), size)]
    return numbers


class DefinitionLimits(NamedTuple):
    """Which definitions of types travel, and how often."""

    size: int = 64 << 10
    """Bytes of the longest one."""
    repeat: float = 5.0
    """Seconds after which one travels again: what carried it may be lost, and listeners come later."""
    topics: int = 4096
    """Topics for which the last time is remembered."""


DEFINITION_LIMITS: Final = DefinitionLimits()
_DEFINED_ENCODINGS: Final = frozenset({"ros1msg", "ros2msg", "ros2idl", "jsonschema", "protobuf"})


def defined_by(attachment: bytes, type: PayloadType) -> PayloadType | None:
    """The type with the definition in an attachment; None if there is none."""
    _, _, text = attachment.partition(b"\n")
    encoding, _, definition = text.partition(b"\n")
    schema_encoding = encoding[:16].decode(errors="replace")
    if not type.schema_name or not 0 < len(definition) <= DEFINITION_LIMITS.size:
        return None
    if schema_encoding not in _DEFINED_ENCODINGS:
        return None
    return PayloadType(type.encoding, type.schema_name, schema_encoding, definition)


class SentDefinitions:
    """When the definition of a topic's type was sent last: it goes with the first message, and then now and again."""

    def __init__(self) -> None:
        self._sent: dict[str, float] = {}

    def attachment(self, mark: bytes, key: str, type: PayloadType, now: float) -> bytes:
        """The attachment of a message on a key, at `now` (seconds on a monotonic clock): with the definition or not."""
        every = DEFINITION_LIMITS.repeat
        if now - self._sent.get(key, -every) < every:
            return mark
        if len(self._sent) >= DEFINITION_LIMITS.topics:
            self._sent.clear()
        self._sent[key] = now
        if not type.schema_data or len(type.schema_data) > DEFINITION_LIMITS.size:
            return mark
        return b"\n".join((mark, type.schema_encoding.encode(), type.schema_data))
