"""rosserial version 2 on the wire: frames, found again after noise, and what the special ones say.

A frame is `ff fe | length u16 | 255 - (sum of the length's bytes) % 256 | topic u16 | data | 255 - (sum of topic and
data) % 256`, integers little-endian. Strings are a u32 length and bytes.
"""

from __future__ import annotations

import logging
import struct
from dataclasses import dataclass
from struct import Struct as Layout
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from bridges.serial.dialect import Counters

START: Final = b"\xff\xfe"
PUBLISHER: Final = 0
"""The board publishes; as a topic id it also asks for the topics (host to board)."""
SUBSCRIBER: Final = 1
SERVER_PUBLISHER: Final = 2
SERVER_SUBSCRIBER: Final = 3
CLIENT_PUBLISHER: Final = 4
CLIENT_SUBSCRIBER: Final = 5
PARAMETER: Final = 6
LOG: Final = 7
TIME: Final = 10
STOP: Final = 11
ANNOUNCEMENTS: Final = range(PUBLISHER, CLIENT_SUBSCRIBER + 1)
FIRST_TOPIC: Final = 100
MAX_DATA: Final = 4096
"""Bytes of data in a frame that are believed; boards have a few hundred."""

LEVELS: Final = (logging.DEBUG, logging.INFO, logging.WARNING, logging.ERROR, logging.CRITICAL)

_HEAD: Final = 7
_U16: Final = Layout("<H")
_U32: Final = Layout("<I")
_I32: Final = Layout("<i")
_TIME: Final = Layout("<II")


@dataclass(frozen=True, slots=True)
class Message:
    """What a frame carries: an id and data."""

    id: int
    data: bytes = b""


@dataclass(frozen=True)
class TopicInfo:
    """What a board announces of a topic; `buffer` is how many bytes of data it can take."""

    id: int
    name: str
    type: str
    md5: str
    buffer: int


class Malformed(ValueError):
    """The data of a special frame is not what it should be."""


def encode(message: Message) -> bytes:
    """The frame of a message."""
    length = _U16.pack(len(message.data))
    body = _U16.pack(message.id) + message.data
    return START + length + bytes((_check(length),)) + body + bytes((_check(body),))


ASK_TOPICS: Final = b"\xff\xfe\x00\x00\xff\x00\x00\xff"
"""The question for the topics: a message without data on id 0."""


def frame_size(data: int) -> int:
    """Bytes on the line of a message with so many bytes of data."""
    return _HEAD + data + 1


def longest_frame(baud: int) -> int:
    """The longest frame that a board takes: from its first byte it waits 20 ms and no more.

    Measured on an Uno: 123 bytes at 57600 baud, 232 at 115200. That is a little more than 20 ms, as the board counts
    milliseconds: beyond `baud` / 500 bytes there is no margin, and a frame may be lost now and then.
    """
    return 14 + baud * 109 // 57_600


class Deframer:
    """Finds the frames in what arrives, in pieces of any size.

    What is none is skipped a byte at a time, so that a frame which begins within the remains of another is found.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._pending = bytearray()

    def reset(self) -> None:
        """What comes next does not belong to what came before."""
        self._pending.clear()

    def feed(self, data: bytes) -> list[Message]:
        """The messages that these bytes complete."""
        self._pending += data
        messages = []
        while self._skip_noise():
            message = self._complete()
            if message is None:
                break
            messages.append(message)
        return messages

    def _skip_noise(self) -> bool:
        """Whether a frame begins at the front now."""
        begin = self._pending.find(START)
        if begin < 0:
            begin = len(self._pending) - self._pending.endswith(START[:1])
        self._counters.noise += begin
        del self._pending[:begin]
        return self._pending.startswith(START)

    def _complete(self) -> Message | None:
        """The frame at the front, if it is all there; a false start is skipped."""
        pending = self._pending
        while len(pending) >= _HEAD - 2:
            length = _U16.unpack_from(pending, 2)[0]
            if pending[4] == _check(pending[2:4]) and length <= MAX_DATA:
                end = frame_size(length)
                if len(pending) < end:
                    return None
                if pending[end - 1] == _check(pending[5 : end - 1]):
                    message = Message(_U16.unpack_from(pending, 5)[0], bytes(pending[_HEAD : end - 1]))
                    del pending[:end]
                    self._counters.received += 1
                    return message
            self._counters.damaged += 1
            self._counters.noise += 1
            del pending[:1]
            if not self._skip_noise():
                return None
        return None


def read_topic_info(data: bytes) -> TopicInfo:
    """An announced topic. Raises `Malformed`."""
    try:
        topic_id = _U16.unpack_from(data)[0]
        name, at = _read_string(data, 2)
        kind, at = _read_string(data, at)
        digest, at = _read_string(data, at)
        buffer = _I32.unpack_from(data, at)[0]
    except struct.error:
        raise Malformed("the announcement of a topic is cut off") from None
    if at + _I32.size != len(data):
        raise Malformed("the announcement of a topic has bytes after its end")
    return TopicInfo(topic_id, name, kind, digest, buffer)


def read_parameter_name(data: bytes) -> str:
    """The name of a parameter that the board asks for. Raises `Malformed`."""
    try:
        return _read_string(data, 0)[0]
    except struct.error:
        raise Malformed("the name of a parameter is cut off") from None


def read_log(data: bytes) -> tuple[int, str]:
    """A line of the board's log, and Python's level of it. Whatever is no text in it is replaced."""
    level = LEVELS[data[0]] if data and data[0] < len(LEVELS) else logging.INFO
    return level, data[5:].decode(errors="replace")


def time_answer(seconds: float) -> Message:
    """The time, seconds since 1970."""
    return Message(TIME, _TIME.pack(int(seconds) & 0xFFFFFFFF, int(seconds % 1 * 1e9)))


def parameter_answer(value: object) -> Message:
    """A parameter's value: a number, a text, or a list of one of these; None for one that there isn't."""
    values = value if isinstance(value, list | tuple) else [] if value is None else [value]
    integers = [int(each) for each in values if isinstance(each, int)]
    floats = [each for each in values if isinstance(each, float)]
    texts = [each.encode() for each in values if isinstance(each, str)]
    if floats:  # a list of both is one of floats
        floats, integers = [float(each) for each in values if isinstance(each, int | float)], []
    data = _U32.pack(len(integers)) + b"".join(map(_I32.pack, integers))
    data += _U32.pack(len(floats)) + b"".join(map(Layout("<f").pack, floats))
    data += _U32.pack(len(texts)) + b"".join(_U32.pack(len(text)) + text for text in texts)
    return Message(PARAMETER, data)


def _check(data: bytes | bytearray) -> int:
    return 255 - sum(data) % 256


def _read_string(data: bytes, at: int) -> tuple[str, int]:
    length = _U32.unpack_from(data, at)[0]
    begin = at + _U32.size
    if begin + length > len(data):
        raise Malformed("a text is longer than its message")
    return data[begin : begin + length].decode(errors="replace"), begin + length
