"""What a rosserial board has announced: its topics, their ids, and what it can take on each."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from bridges.serial import roswire
from bridges.serial.dialect import About, BoardTopic, Flow
from bridges.serial.errors import UnfitMessage
from bridges.serial.rostypes import known_type, payload_type_of
from schemas.errors import InvalidKey, InvalidPayload
from schemas.key_chunks import topic_chunks

if TYPE_CHECKING:
    from bridges.serial.dialect import Command
    from bridges.serial.roswire import Message, TopicInfo

log = logging.getLogger(__name__)

FLOWS: Final = {
    roswire.PUBLISHER: Flow.SAYS,
    roswire.SUBSCRIBER: Flow.HEARS,
    roswire.SERVER_SUBSCRIBER: Flow.SERVES,
    roswire.CLIENT_PUBLISHER: Flow.ASKS,
}
ANSWERING: Final = {roswire.SERVER_PUBLISHER: Flow.SERVES, roswire.CLIENT_SUBSCRIBER: Flow.ASKS}
"""Announcements that give a service's other id, on which the answers go."""


class Announcements:
    """The topics that a board has announced so far. `longest` is the longest frame that it takes on its line."""

    def __init__(self, longest: int) -> None:
        self._longest = longest
        self._topics: dict[tuple[str, Flow], BoardTopic] = {}
        self._answers: dict[tuple[str, Flow], int] = {}
        self._buffers: dict[int, int] = {}
        self._last: tuple[int, int] | None = None
        self._refused: set[TopicInfo] = set()

    def clear(self) -> None:
        """Another board may come."""
        self._topics.clear()
        self._answers.clear()
        self._buffers.clear()
        self._last = None

    def about(self) -> About:
        """What the board is, as far as it says."""
        return About("", "", tuple(self._topics.values()))

    def add(self, kind: int, info: TopicInfo) -> bool:
        """Take an announcement; false if it says that the board is not what it was. One that is wrong is left out."""
        self._last = (kind, info.id)
        if (name := self._acceptable(info)) is None:
            return True
        self._buffers[info.id] = info.buffer
        if kind in ANSWERING:
            self._answers[name, ANSWERING[kind]] = info.id
            return True
        topic = BoardTopic(name, FLOWS[kind], payload_type_of(info.type), info.id)
        return self._topics.setdefault((name, topic.flow), topic) == topic

    @property
    def last(self) -> tuple[int, int] | None:
        """The kind and the id of the announcement that came last; a board announces in the same order each time."""
        return self._last

    def speaking(self, topic_id: int) -> BoardTopic | None:
        """The topic on which the board speaks under this id."""
        ways = (Flow.SAYS, Flow.ASKS)
        found = (topic for topic in self._topics.values() if topic.id == topic_id and topic.flow in ways)
        return next(found, None)

    def answers(self, topic: BoardTopic) -> int | None:
        """The id of the answers on a service."""
        return self._answers.get((topic.name, topic.flow))

    def fitting(self, command: Command) -> tuple[BoardTopic, Message]:
        """Where a command goes, and its message. Raises `UnfitMessage` if the board can't take it."""
        topic = self.about().find(command.topic, Flow.HEARS, Flow.SERVES)
        if topic is None:
            raise UnfitMessage(command.topic, "the board has not announced that it listens to it")
        known = known_type(topic.type.schema_name)
        try:
            if known is not None and topic.flow is Flow.HEARS:
                known.check(command.payload)
        except InvalidPayload as error:
            raise UnfitMessage(command.topic, str(error)) from None
        if len(command.payload) > (room := self.room(topic.id)):
            raise UnfitMessage(command.topic, f"{len(command.payload)} bytes, and the board takes {room} on this line")
        return topic, roswire.Message(topic.id, command.payload)

    def room(self, topic_id: int) -> int:
        """Bytes of data that the board can take: in its buffer, and in the time that it has for a frame."""
        return min(self._buffers.get(topic_id, 0), self._longest - roswire.frame_size(0))

    def _acceptable(self, info: TopicInfo) -> str | None:
        """The name of an announced topic, if it is one and its type is the one that is known by that name."""
        known = known_type(info.type)
        why = name = ""
        if info.id < roswire.FIRST_TOPIC:
            why = f"{info.id} is no id of a topic"
        elif known is not None and known.md5 != info.md5:
            why = f"{info.type} has the md5 {known.md5}, and the board's is {info.md5}"
        try:
            name = topic_chunks("/" + info.name.lstrip("/"))
        except InvalidKey as error:
            why = str(error)
        if not why:
            return name
        if info not in self._refused:
            self._refused.add(info)
            log.warning("topic %r of the board is not used: %s", info.name, why)
        return None
