"""The topics and types of a rosserial board: what it has announced, and what it accepts on each topic.

The md5 of a type is that of its definition, so those of std_msgs follow from their one line. Messages of other types
are carried as bytes, with the type's name.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from bridges.serial import rosserial
from bridges.serial.dialect import BoardTopic, DeviceInfo, Flow
from bridges.serial.errors import InvalidBoardMessage
from mesh.log_context import log_event
from schemas.agent_keys import topic_chunks
from schemas.errors import InvalidKey, InvalidPayload
from schemas.payloads import EMPTY, STRING, PayloadType

if TYPE_CHECKING:
    from bridges.serial.dialect import Command
    from bridges.serial.rosserial import RosserialMessage, TopicInfo

log = logging.getLogger(__name__)

FLOWS: Final = {
    rosserial.PUBLISHER: Flow.PUBLISHES,
    rosserial.SUBSCRIBER: Flow.SUBSCRIBES,
    rosserial.SERVER_SUBSCRIBER: Flow.SERVES,
    rosserial.CLIENT_PUBLISHER: Flow.REQUESTS,
}
RESPONSES: Final = {rosserial.SERVER_PUBLISHER: Flow.SERVES, rosserial.CLIENT_SUBSCRIBER: Flow.REQUESTS}
"""Announcements of a service's other id, which its responses have."""
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
    """A type whose definition is known. `size` is the size of every payload in bytes, None if it varies."""

    payload: PayloadType
    size: int | None

    @property
    def md5(self) -> str:
        """The digest with which boards announce it."""
        from hashlib import md5  # OpenSSL, which an edge agent needs for nothing else

        return md5(self.payload.schema_data.strip(), usedforsecurity=False).hexdigest()

    def check(self, payload: bytes) -> None:
        """Raise `InvalidPayload` if these bytes are not of this type."""
        if self.payload == STRING:
            if len(payload) < 4 or int.from_bytes(payload[:4], "little") != len(payload) - 4:
                raise InvalidPayload("std_msgs/String", f"its length field does not match its {len(payload)} bytes")
        elif self.size is not None and len(payload) != self.size:
            raise InvalidPayload(self.payload.schema_name, f"it has {self.size} bytes, not {len(payload)}")


def _primitive(name: str, size: int) -> RosType:
    definition = f"{name} data"
    type_name = f"std_msgs/{_NAMES.get(name, name.capitalize())}"
    kind = PayloadType("ros1", type_name, "ros1msg", f"{definition}\n".encode())
    return RosType(kind, size)


_KNOWN: Final = {
    known.payload.schema_name: known
    for known in (
        RosType(EMPTY, 0),
        RosType(STRING, None),
        *(_primitive(name, size) for name, size in _SIZES.items()),
    )
}


def known_type(name: str) -> RosType | None:
    """The type of that name, such as `std_msgs/String`, if its definition is known."""
    return _KNOWN.get(name)


def payload_type_of(name: str) -> PayloadType:
    """The payload type of that name."""
    known = _KNOWN.get(name)
    return known.payload if known is not None else PayloadType("ros1", name, "ros1msg")


class TopicTable:
    """The topics that a board has announced so far. `longest_frame` is the longest frame that it accepts."""

    def __init__(self, longest_frame: int) -> None:
        self._longest_frame = longest_frame
        self._topics: dict[tuple[str, Flow], BoardTopic] = {}
        self._response_ids: dict[tuple[str, Flow], int] = {}
        self._buffers: dict[int, int] = {}
        self._rejected: set[TopicInfo] = set()
        self.last: tuple[int, int] | None = None
        """The kind and id of the last announcement; a board announces in the same order each time."""
        self._first: tuple[int, int] | None = None
        self._final: tuple[int, int] | None = None

    def clear(self) -> None:
        """Forget the topics: another board may come."""
        self._topics.clear()
        self._response_ids.clear()
        self._buffers.clear()
        self.last = self._first = self._final = None

    @property
    def is_complete(self) -> bool:
        """Whether the last announcement is that after which the first one has come again: the board has no other."""
        return self._final is not None and self.last == self._final

    def device_info(self) -> DeviceInfo:
        """What the board has reported about itself."""
        return DeviceInfo("", "", tuple(self._topics.values()))

    def add(self, kind: int, info: TopicInfo) -> bool:
        """Add an announced topic; false if it contradicts an earlier one. Invalid ones are left out with a warning."""
        if (kind, info.id) == self._first:
            self._final = self.last
        self.last = (kind, info.id)
        self._first = self._first or self.last
        if (name := self._valid_name(info)) is None:
            return True
        self._buffers[info.id] = info.buffer
        if kind in RESPONSES:
            self._response_ids[name, RESPONSES[kind]] = info.id
            return True
        topic = BoardTopic(name, FLOWS[kind], payload_type_of(info.type), info.id)
        return self._topics.setdefault((name, topic.flow), topic) == topic

    def sender(self, topic_id: int) -> BoardTopic | None:
        """The topic on which the board sends messages with this id."""
        flows = (Flow.PUBLISHES, Flow.REQUESTS)
        found = (topic for topic in self._topics.values() if topic.id == topic_id and topic.flow in flows)
        return next(found, None)

    def response_id(self, topic: BoardTopic) -> int | None:
        """The id of the responses of a service."""
        return self._response_ids.get((topic.name, topic.flow))

    def resolve(self, command: Command) -> tuple[BoardTopic, RosserialMessage]:
        """The topic and the message of a command. Raises `InvalidBoardMessage` if the board can't accept it."""
        topic = self.device_info().find(command.topic, Flow.SUBSCRIBES, Flow.SERVES)
        if topic is None:
            raise InvalidBoardMessage(command.topic, "the board has not announced that it subscribes to it")
        known = known_type(topic.type.schema_name)
        try:
            if known is not None and topic.flow is Flow.SUBSCRIBES:
                known.check(command.payload)
        except InvalidPayload as error:
            raise InvalidBoardMessage(command.topic, str(error)) from None
        size, limit = len(command.payload), self.max_data(topic.id)
        if size > limit:
            raise InvalidBoardMessage(command.topic, f"it has {size} bytes; the board accepts {limit} on this line")
        return topic, rosserial.RosserialMessage(topic.id, command.payload)

    def max_data(self, topic_id: int) -> int:
        """The most bytes of data that the board accepts: in its buffer, and in the time that it allows a frame."""
        return min(self._buffers.get(topic_id, 0), self._longest_frame - rosserial.frame_size(0))

    def _valid_name(self, info: TopicInfo) -> str | None:
        """The name of an announced topic; None if it, its id or its type is not valid."""
        known = known_type(info.type)
        why = name = ""
        if info.id < rosserial.FIRST_TOPIC:
            why = f"{info.id} is not the id of a topic"
        elif known is not None and known.md5 != info.md5:
            why = f"the md5 of {info.type} is {known.md5}, not {info.md5}"
        try:
            name = topic_chunks("/" + info.name.lstrip("/"))
        except InvalidKey as error:
            why = str(error)
        if not why:
            return name
        if info not in self._rejected:
            self._rejected.add(info)
            rejected = log_event("topic-rejected", topic=info.name, id=info.id)
            log.warning("topic %r of the board is not used: %s", info.name, why, extra=rejected)
        return None
