"""As much of the protobuf encoding as the blocks of files need: numbers and byte strings by field number."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from schemas.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

_VARINT: Final = 0
_BYTES: Final = 2
_MAX_NUMBER: Final = 2**64 - 1


def write_number(field: int, value: int) -> bytes:
    """A field that holds an unsigned integer of at most 64 bits."""
    return _varint(field << 3 | _VARINT) + _varint(value)


def write_bytes(field: int, value: bytes) -> bytes:
    """A field that holds a byte string."""
    return write_length(field, len(value)) + value


def write_length(field: int, length: int) -> bytes:
    """What comes before a byte string of that length."""
    return _varint(field << 3 | _BYTES) + _varint(length)


def read_fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """The fields of a message in their order, as number and value.

    Raises `InputError` for anything but whole numbers and byte strings.
    """
    position = 0
    while position < len(data):
        key, position = _read_varint(data, position)
        value: int | bytes
        number, position = _read_varint(data, position)
        match key & 7:
            case 0:
                value = number
            case 2:
                if number > len(data) - position:
                    raise InputError("a protobuf field is longer than what holds it")
                value = data[position : position + number]
                position += number
            case other:
                raise InputError(f"protobuf wire type {other} is not used here")
        yield key >> 3, value


def _varint(value: int) -> bytes:
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


def _read_varint(data: bytes, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if position == len(data):
            raise InputError("a protobuf field is cut off")
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            break
    if byte >= 0x80 or value > _MAX_NUMBER:
        raise InputError("a protobuf number has more than 64 bits")
    return value, position
