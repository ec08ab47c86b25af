"""What a board says of itself in our own frames."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

import msgspec

from bridges.serial.dialect import BoardTopic, Flow
from bridges.serial.values import TYPES
from schemas.errors import InvalidKey
from schemas.key_chunks import topic_chunks
from schemas.payloads import JSON

if TYPE_CHECKING:
    from bridges.serial.frames import Frame

log = logging.getLogger(__name__)

PROTOCOL: Final = 1


class BoardWord(msgspec.Struct, array_like=True, frozen=True):
    """What a BOARD frame says; `session` is the one that a host has opened since the board started, or 0."""

    protocol: int
    name: str
    version: str
    session: int
    topics: int


class _TopicWord(msgspec.Struct, array_like=True, frozen=True):
    """What a TOPIC frame says; `called` tells what can be called from what the board publishes."""

    called: bool
    name: str
    type: str


def read_board(frame: Frame) -> BoardWord | None:
    """What a BOARD frame says; None, and a line in the log, if it can't be read or speaks of another protocol."""
    try:
        board = msgspec.msgpack.decode(frame.payload, type=BoardWord)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        log.warning("what the board says of itself can't be read: %s", error)
        return None
    if board.protocol != PROTOCOL:
        log.warning("%s speaks version %d of the frames, and %d is known here", board.name, board.protocol, PROTOCOL)
        return None
    return board


def read_topic(frame: Frame) -> BoardTopic | None:
    """The topic that a TOPIC frame names; None, and a line in the log, if there can be no such topic."""
    try:
        word = msgspec.msgpack.decode(frame.payload, type=_TopicWord)
        name = topic_chunks("/" + word.name.lstrip("/"))
    except (msgspec.DecodeError, UnicodeDecodeError, InvalidKey) as error:
        log.warning("topic %d of the board can't be used: %s", frame.id, error)
        return None
    flow = Flow.HEARS if word.called else Flow.SAYS
    return BoardTopic(name, flow, TYPES.get(word.type, JSON), frame.id)
