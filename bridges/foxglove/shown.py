"""Messages in a form that Foxglove decodes: with a schema, and JSON whose root is an object. Pure."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from mesh import foxglove
from mesh.extras import PackageMissing
from mesh.recording import JsonSchemas, encode_described
from mesh.ros import NOETIC, RosTypes, UnknownRosType
from schemas.payloads import EMPTY, RAW, PayloadType

if TYPE_CHECKING:
    from collections.abc import Mapping

ROS2: Final = "jazzy"
"""The distribution of ROS 2 whose definitions are used for types that came without one."""
SHOWN_BYTES: Final = 4096
"""Bytes that are shown of a message which has no other form."""
DEFINITIONS: Final = 1024
"""Types whose definition is remembered."""
_IMAGES: Final = ((b"\x89PNG\r\n\x1a\n", "png"), (b"\xff\xd8\xff", "jpeg"))


class Bytes(msgspec.Struct, frozen=True):
    """A message that can't be decoded: how many bytes it has, and the first of them."""

    type: str
    size: int
    data: bytes


class Shown(NamedTuple):
    """A message as Foxglove gets it. It needs `type.schema_data`, unless that is the empty definition."""

    payload: bytes
    type: PayloadType


class ShownTypes:
    """Gives the messages of one view their form. `known` are types of which only the name travels with a message.

    The first one reads the types of ROS: use a thread.
    """

    def __init__(self, known: tuple[PayloadType, ...] = ()) -> None:
        self._json = JsonSchemas()
        self._ros = _ros_types()
        self._defined: dict[tuple[str, str], PayloadType | None] = {}
        for kind in known:
            if kind.schema_data:
                self._learn(kind)

    def shown(self, topic: str, payload: bytes, kind: PayloadType) -> Shown:
        """A message of a topic as Foxglove gets it."""
        if kind.encoding == "json":
            return self._object(topic, payload, kind)
        if kind == EMPTY or kind.schema_data:
            self._learn(kind)
            return Shown(payload, kind)
        if (defined := self._definition(kind)) is not None:
            return Shown(payload, defined)
        return _image(payload) or _bytes(payload, kind)

    def _learn(self, kind: PayloadType) -> None:
        """Remember the definition of a type for messages that come without it."""
        name = kind.encoding, kind.schema_name
        if self._defined.get(name) is None and len(self._defined) < DEFINITIONS:
            self._defined[name] = kind

    def _object(self, topic: str, payload: bytes, kind: PayloadType) -> Shown:
        """JSON with an object at its root: other data is the value of the property `value`."""
        if payload.lstrip(b" \t\r\n")[:1] != b"{":
            payload, kind = b'{"value":' + payload + b"}", PayloadType("json", "", "jsonschema")
        return Shown(payload, self._json.describe(topic, payload, kind))

    def _definition(self, kind: PayloadType) -> PayloadType | None:
        """The type with its definition, if that is known or if ROS has one."""
        name = kind.encoding, kind.schema_name
        if name not in self._defined and len(self._defined) < DEFINITIONS:
            self._defined[name] = _ros_definition(kind, self._ros)
        return self._defined.get(name)


def _ros_definition(kind: PayloadType, ros: Mapping[str, RosTypes]) -> PayloadType | None:
    types = ros.get(kind.encoding)
    if types is None or not kind.schema_name:
        return None
    try:
        return types.payload_type(kind.schema_name)
    except UnknownRosType:
        return None


@cache
def _ros_types() -> Mapping[str, RosTypes]:
    """The types of ROS by encoding; none without the package rosbags."""
    try:
        return {"ros1": RosTypes(NOETIC), "cdr": RosTypes(ROS2)}
    except PackageMissing:
        return {}


def _image(payload: bytes) -> Shown | None:
    """A PNG or JPEG file as the image that Foxglove shows."""
    for magic, name in _IMAGES:
        if payload.startswith(magic):
            return Shown(*encode_described(foxglove.CompressedImage(data=payload, format=name)))
    return None


def _bytes(payload: bytes, kind: PayloadType) -> Shown:
    name = "" if kind == RAW else kind.zenoh_encoding
    return Shown(*encode_described(Bytes(name, len(payload), payload[:SHOWN_BYTES])))
