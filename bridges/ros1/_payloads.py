"""What travels in the mesh as messages of ROS 1, and the reverse."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from bridges.ros1.messages import Ros1Type
from mesh.base.flood import BoundedDict
from mesh.recording.ros import RosConverter
from schemas import String
from schemas.errors import InvalidPayload
from schemas.payloads import EMPTY, JSON, RAW, PayloadType, decode_value, defined_by, encode_value, payload_type

if TYPE_CHECKING:
    from collections.abc import Mapping

    import zenoh

    from bridges.ros1.node import Ros1Node, Ros1Publisher
    from mesh.recording.ros import RosConversion

MOST_TYPES: Final = 10_000
"""Definitions of topics' types that are remembered."""
MOST_CONVERSIONS: Final = 256
"""Types of ROS 2 whose conversions are remembered."""


def type_in(header: Mapping[str, str]) -> PayloadType:
    """The type of a publisher's messages, with its definition, by the header of its connection."""
    definition = header.get("message_definition", "").encode()
    return PayloadType("ros1", header.get("type", ""), "ros1msg", definition)


async def advertise(node: Ros1Node, topic: str, kind: PayloadType) -> Ros1Publisher:
    """Publish a topic of messages that are encoded already. Raises `InvalidPayload`, `InvalidGraphName`."""
    return await node.advertise(topic, Ros1Type(kind.schema_name, kind.schema_data.decode(errors="replace")))


class RosPayloads:
    """Makes messages of ROS 1 from what arrives. It remembers the definitions that come with some messages only."""

    def __init__(self) -> None:
        self._types: dict[tuple[str, str], PayloadType] = {}
        self._converter = RosConverter(0, "jazzy")
        self._conversions: BoundedDict[PayloadType, RosConversion] = BoundedDict(MOST_CONVERSIONS)
        """Of types of ROS 2: to make one takes some 90 ms."""

    def type_of(self, sample: zenoh.Sample) -> PayloadType:
        """The type of what arrived, with its definition if that is known. On the thread of a pump."""
        key, kind = str(sample.key_expr), payload_type(str(sample.encoding))
        if kind.schema_data or not kind.schema_name:
            return kind
        found = None if sample.attachment is None else defined_by(sample.attachment.to_bytes(), kind)
        if found is not None and len(self._types) < MOST_TYPES:
            self._types[key, kind.schema_name] = found
        return found or self._types.get((key, kind.schema_name), kind)

    def for_ros(self, payload: bytes, kind: PayloadType) -> tuple[bytes, PayloadType]:
        """A message as one of ROS 1, with its definition. Raises `InvalidPayload`, `PackageMissing`."""
        if kind.encoding == "ros1":
            kind = kind if kind.schema_data else self._converter.of(kind).type
            if not kind.schema_data and kind != EMPTY:
                raise InvalidPayload(kind.schema_name, "its definition is not known")
            return payload, kind
        if kind.encoding == "cdr":
            conversion = self._conversions.get(kind)
            if conversion is None:
                conversion = self._conversions[kind] = RosConverter(1, "jazzy").of(kind)
            if conversion.why:
                raise InvalidPayload(kind.schema_name, conversion.why)
            try:
                return conversion.convert(payload), conversion.type
            except Exception as error:  # whatever rosbags raises for a stranger's payload
                raise InvalidPayload(kind.schema_name, str(error)) from None
        changed, type = encode_value(decode_value(payload, kind))
        if type not in (JSON, RAW):
            return changed, type
        return encode_value(String(payload.decode(errors="replace")))
