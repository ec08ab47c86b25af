"""ROS 1's std_msgs of one number and of an array of numbers: their definitions, and their bytes.

What is little-endian and packed in ROS 1 needs no more than `struct`.
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

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
_COUNT: Final = struct.Struct("<I")
_SIZES: Final = struct.Struct("<II")
MAX_DIMENSIONS: Final = 32

DEFINITIONS: Final = {
    **{f"std_msgs/{name}": f"{name.lower()} data\n" for name in _FORMATS},
    **{f"std_msgs/{name}": _LAYOUT.format(name.removesuffix("MultiArray").lower()) for name in _ARRAYS},
}
"""The types that this module encodes and decodes."""


def encode(type_name: str, value: Any) -> bytes:
    """The payload of a number, or of a list of numbers, nested as its array has dimensions. Raises `ValueError`."""
    name = type_name.removeprefix("std_msgs/")
    try:
        if name in _FORMATS:
            return struct.pack(f"<{_FORMATS[name]}", value)
        shape, numbers = _flattened(value)
        return _dimensions(shape) + struct.pack(f"<I{len(numbers)}{_ARRAYS[name]}", len(numbers), *numbers)
    except (struct.error, OverflowError, TypeError) as error:
        raise ValueError(str(error)) from None


def decode(type_name: str, payload: bytes) -> Any:
    """The number, or the list of numbers, in a payload. Raises `ValueError` if it is not of that type."""
    name = type_name.removeprefix("std_msgs/")
    try:
        if name in _FORMATS:
            return struct.unpack(f"<{_FORMATS[name]}", payload)[0]
        return _decode_array(_ARRAYS[name], payload)
    except struct.error as error:
        raise ValueError(str(error)) from None


def array_type(value: Sequence[Any]) -> str | None:
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
        if len({len(one) for one in elements}) > 1 or len(shape) == MAX_DIMENSIONS:
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
    if dimensions > MAX_DIMENSIONS:
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
