"""The codec of rosserial version 2: messages in frames, and the data of the protocol's own messages.

A frame is `ff fe | length u16 | 255 - (sum of the length's bytes) % 256 | topic u16 | data | 255 - (sum of topic and
data) % 256`, integers little-endian. A string is a u32 length and its bytes.
"""

from __future__ import annotations

import logging
import struct
from dataclasses import dataclass
from struct import Struct as Layout
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from bridges.serial.dialect import LineCounters

START: Final = b"\xff\xfe"
PUBLISHER: Final = 0
"""The board publishes; as a message id it also requests the topics (host to board)."""
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
"""The longest data that a frame may announce; boards have a few hundred bytes."""

LEVELS: Final = (logging.DEBUG, logging.INFO, logging.WARNING, logging.ERROR, logging.CRITICAL)

_HEAD: Final = 7
_U16: Final = Layout("<H")
_U32: Final = Layout("<I")
_I32: Final = Layout("<i")
_TIME: Final = Layout("<II")


@dataclass(frozen=True, slots=True)
class RosserialMessage:
    """What a frame carries: an id and data."""

    id: int
    data: bytes = b""


@dataclass(frozen=True)
class TopicInfo:
    """The announcement of a topic; `buffer` is the most bytes of data that the board accepts on it."""

    id: int
    name: str
    type: str
    md5: str
    buffer: int


class MalformedMessage(ValueError):
    """The data of one of the protocol's own messages can't be decoded."""


def encode_message(message: RosserialMessage) -> bytes:
    """The frame of a message."""
    length = _U16.pack(len(message.data))
    body = _U16.pack(message.id) + message.data
    return START + length + bytes((_check(length),)) + body + bytes((_check(body),))


ASK_TOPICS: Final = b"\xff\xfe\x00\x00\xff\x00\x00\xff"
"""The request for the topics: a message without data on id 0."""


def frame_size(data: int) -> int:
    """The length of a frame with `data` bytes of data."""
    return _HEAD + data + 1


def longest_frame(baud: int) -> int:
    """The longest frame that a board accepts: it gives up 20 ms after a frame's first byte.

    Measured on an Uno: 123 bytes at 57600 baud, 232 at 115200. That is a little more than 20 ms, as the board counts
    whole milliseconds: beyond `baud` / 500 bytes there is no margin, and a frame may be lost now and then.
    """
    return 14 + baud * 109 // 57_600


class RosserialDecoder:
    """Decodes the messages in a stream of bytes, in pieces of any size.

    Bytes that are no frame are skipped one at a time, so a frame that begins within the rest of another is found.
    """

    def __init__(self, counters: LineCounters) -> None:
        self._counters = counters
        self._pending = bytearray()

    def reset(self) -> None:
        """Discard the beginning of a frame: the next bytes are from another stream."""
        self._pending.clear()

    def feed(self, data: bytes) -> list[RosserialMessage]:
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
        """Skip to the next start of a frame; whether there is one."""
        begin = self._pending.find(START)
        if begin < 0:
            begin = len(self._pending) - self._pending.endswith(START[:1])
        self._counters.noise += begin
        del self._pending[:begin]
        return self._pending.startswith(START)

    def _complete(self) -> RosserialMessage | None:
        """The message of the first frame, if it is complete; false starts are skipped."""
        pending = self._pending
        while len(pending) >= _HEAD - 2:
            length = _U16.unpack_from(pending, 2)[0]
            if pending[4] == _check(pending[2:4]) and length <= MAX_DATA:
                end = frame_size(length)
                if len(pending) < end:
                    return None
                if pending[end - 1] == _check(pending[5 : end - 1]):
                    message = RosserialMessage(_U16.unpack_from(pending, 5)[0], bytes(pending[_HEAD : end - 1]))
                    del pending[:end]
                    self._counters.received += 1
                    return message
            self._counters.damaged += 1
            self._counters.noise += 1
            del pending[:1]
            if not self._skip_noise():
                return None
        return None


def decode_topic_info(data: bytes) -> TopicInfo:
    """The topic that a message announces. Raises `MalformedMessage`."""
    try:
        topic_id = _U16.unpack_from(data)[0]
        name, at = _read_string(data, 2)
        kind, at = _read_string(data, at)
        digest, at = _read_string(data, at)
        buffer = _I32.unpack_from(data, at)[0]
    except struct.error:
        raise MalformedMessage("the announcement of a topic is cut off") from None
    if at + _I32.size != len(data):
        raise MalformedMessage("the announcement of a topic has bytes after its end")
    return TopicInfo(topic_id, name, kind, digest, buffer)


def decode_parameter_name(data: bytes) -> str:
    """The name of the parameter that the board requests. Raises `MalformedMessage`."""
    try:
        return _read_string(data, 0)[0]
    except struct.error:
        raise MalformedMessage("the name of a parameter is cut off") from None


def decode_log(data: bytes) -> tuple[int, str]:
    """The level (of Python's logging) and text of a line of the board's log; invalid UTF-8 is replaced."""
    level = LEVELS[data[0]] if data and data[0] < len(LEVELS) else logging.INFO
    return level, data[5:].decode(errors="replace")


def encode_time(seconds: float) -> RosserialMessage:
    """The answer to a request for the time; `seconds` since 1970."""
    return RosserialMessage(TIME, _TIME.pack(int(seconds) & 0xFFFFFFFF, int(seconds % 1 * 1e9)))


def encode_parameter(value: object) -> RosserialMessage:
    """The value of a parameter: a number, a text, or a list of one of these; None if it is not set."""
    values = value if isinstance(value, list | tuple) else [] if value is None else [value]
    integers = [int(each) for each in values if isinstance(each, int)]
    floats = [each for each in values if isinstance(each, float)]
    texts = [each.encode() for each in values if isinstance(each, str)]
    if floats:  # integers beside floats become floats
        floats, integers = [float(each) for each in values if isinstance(each, int | float)], []
    data = _U32.pack(len(integers)) + b"".join(map(_I32.pack, integers))
    data += _U32.pack(len(floats)) + b"".join(map(Layout("<f").pack, floats))
    data += _U32.pack(len(texts)) + b"".join(_U32.pack(len(text)) + text for text in texts)
    return RosserialMessage(PARAMETER, data)


def _check(data: bytes | bytearray) -> int:
    return 255 - sum(data) % 256


def _read_string(data: bytes, at: int) -> tuple[str, int]:
    length = _U32.unpack_from(data, at)[0]
    begin = at + _U32.size
    if begin + length > len(data):
        raise MalformedMessage("a string is longer than its message")
    return data[begin : begin + length].decode(errors="replace"), begin + length
