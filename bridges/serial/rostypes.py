"""The ROS types that a rosserial board may speak: their md5 sums, and whether a payload can be of a type.

The md5 of a type is that of its definition, so those of std_msgs follow from their one line. A type that is not here is
carried as it comes, with its name.
"""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import md5
from typing import Final

from schemas.errors import InvalidPayload
from schemas.payloads import EMPTY, STRING, Empty, PayloadType, String

_SIZES: Final = {
    "bool": 1,
    "byte": 1,
    "char": 1,
    "int8": 1,
    "uint8": 1,
    "int16": 2,
    "uint16": 2,
    "int32": 4,
    "uint32": 4,
    "int64": 8,
    "uint64": 8,
    "float32": 4,
    "float64": 8,
    "time": 8,
    "duration": 8,
}
_NAMES: Final = {"uint8": "UInt8", "uint16": "UInt16", "uint32": "UInt32", "uint64": "UInt64"}


@dataclass(frozen=True)
class RosType:
    """A type of which more than the name is known. `size` is that of each payload, None if it varies."""

    payload: PayloadType
    md5: str
    size: int | None

    def check(self, payload: bytes) -> None:
        """Raise `InvalidPayload` if these bytes are no message of the type."""
        if self.payload == STRING:
            if len(payload) < 4 or int.from_bytes(payload[:4], "little") != len(payload) - 4:
                raise InvalidPayload("std_msgs/String", f"its length does not fit its {len(payload)} bytes")
        elif self.size is not None and len(payload) != self.size:
            raise InvalidPayload(self.payload.schema_name, f"{len(payload)} bytes, and it has {self.size}")


def _primitive(name: str, size: int) -> RosType:
    definition = f"{name} data"
    type_name = f"std_msgs/{_NAMES.get(name, name.capitalize())}"
    kind = PayloadType("ros1", type_name, "ros1msg", f"{definition}\n".encode())
    return RosType(kind, md5(definition.encode(), usedforsecurity=False).hexdigest(), size)


_KNOWN: Final = {
    known.payload.schema_name: known
    for known in (
        RosType(EMPTY, Empty.md5, 0),
        RosType(STRING, String.md5, None),
        *(_primitive(name, size) for name, size in _SIZES.items()),
    )
}


def known_type(name: str) -> RosType | None:
    """What is known of the type of that name, `std_msgs/String` for instance."""
    return _KNOWN.get(name)


def payload_type_of(name: str) -> PayloadType:
    """How a payload of that type is to be read."""
    known = _KNOWN.get(name)
    return known.payload if known is not None else PayloadType("ros1", name, "ros1msg")
