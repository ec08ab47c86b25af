"""rosserial version 2: its messages in frames, a board's topics and types, and the host's side for every sketch.

A frame is `ff fe | length u16 | 255 - (sum of the length's bytes) % 256 | topic u16 | data | 255 - (sum of topic and
data) % 256`, integers little-endian. A string is a u32 length and its bytes. The md5 of a type is that of its
definition, so those of std_msgs follow from their one line; messages of other types are carried as bytes.

A board acknowledges nothing and buffers 64 bytes. But it announces its topics on request, so that request follows each
command, and the next command is sent after the answer: until then the board may still run the last callback. The
answer proves no more: the board skips a damaged command silently.

After a cable was pulled during a command, the board is not asked: if it was not restarted, it speaks within seconds.
"""

from __future__ import annotations

import logging
import struct
import time
from dataclasses import dataclass, field
from enum import IntEnum
from struct import Struct as Layout
from typing import TYPE_CHECKING, Final, NamedTuple

from bridges.serial.dialect import (
    BoardLogged,
    BoardLost,
    BoardReady,
    BoardTopic,
    CallStatus,
    Command,
    CommandFinished,
    CommandRefused,
    DeviceInfo,
    Dialect,
    Flow,
    MessageReceived,
)
from mesh.base.log_context import log_event
from schemas.errors import InvalidKey, InvalidPayload
from schemas.keys import topic_chunks
from schemas.payloads import EMPTY, STRING, PayloadType

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from bridges.serial.dialect import LineCounters


START: Final = b"\xff\xfe"


class RosserialId(IntEnum):
    """The ids of messages that are not about a topic, or announce one."""

    PUBLISHER = 0
    """The board publishes; as a message id it also requests the topics (host to board)."""
    SUBSCRIBER = 1
    SERVER_PUBLISHER = 2
    SERVER_SUBSCRIBER = 3
    CLIENT_PUBLISHER = 4
    CLIENT_SUBSCRIBER = 5
    PARAMETER = 6
    LOG = 7
    TIME = 10
    STOP = 11


ANNOUNCEMENTS: Final = range(RosserialId.PUBLISHER, RosserialId.CLIENT_SUBSCRIBER + 1)

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


def encode_message(message: RosserialMessage) -> bytes:
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
            # The longest data that a frame may announce; boards have a few hundred bytes.
            if pending[4] == _check(pending[2:4]) and length <= 4096:
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
    """The topic that a message announces. Raises `InvalidPayload`."""
    try:
        topic_id = _U16.unpack_from(data)[0]
        name, at = _read_string(data, 2)
        kind, at = _read_string(data, at)
        digest, at = _read_string(data, at)
        buffer = _I32.unpack_from(data, at)[0]
    except struct.error:
        raise InvalidPayload("rosserial_msgs/TopicInfo", "it is cut off") from None
    if at + _I32.size != len(data):
        raise InvalidPayload("rosserial_msgs/TopicInfo", "it has bytes after its end")
    return TopicInfo(topic_id, name, kind, digest, buffer)


def decode_parameter_name(data: bytes) -> str:
    """The name of the parameter that the board requests. Raises `InvalidPayload`."""
    try:
        return _read_string(data, 0)[0]
    except struct.error:
        raise InvalidPayload("rosserial_msgs/RequestParam", "its name is cut off") from None


def decode_log(data: bytes) -> tuple[int, str]:
    """The level (of Python's logging) and text of a line of the board's log; invalid UTF-8 is replaced."""
    level = LEVELS[data[0]] if data and data[0] < len(LEVELS) else logging.INFO
    return level, data[5:].decode(errors="replace")


def encode_time(seconds: float) -> RosserialMessage:
    """The answer to a request for the time; `seconds` since 1970."""
    return RosserialMessage(RosserialId.TIME, _TIME.pack(int(seconds) & 0xFFFFFFFF, int(seconds % 1 * 1e9)))


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
    return RosserialMessage(RosserialId.PARAMETER, data)


def _check(data: bytes | bytearray) -> int:
    return 255 - sum(data) % 256


def _read_string(data: bytes, at: int) -> tuple[str, int]:
    length = _U32.unpack_from(data, at)[0]
    begin = at + _U32.size
    if begin + length > len(data):
        raise InvalidPayload("string", "it is longer than its message")
    return data[begin : begin + length].decode(errors="replace"), begin + length


log = logging.getLogger(__name__)

FLOWS: Final[dict[int, Flow]] = {
    RosserialId.PUBLISHER: Flow.PUBLISHES,
    RosserialId.SUBSCRIBER: Flow.SUBSCRIBES,
    RosserialId.SERVER_SUBSCRIBER: Flow.SERVES,
    RosserialId.CLIENT_PUBLISHER: Flow.REQUESTS,
}
RESPONSES: Final[dict[int, Flow]] = {
    RosserialId.SERVER_PUBLISHER: Flow.SERVES,
    RosserialId.CLIENT_SUBSCRIBER: Flow.REQUESTS,
}
"""Announcements of a service's other id, which its responses have."""
_SIZES: Final = {
    1: "bool byte char int8 uint8",
    2: "int16 uint16",
    4: "int32 uint32 float32",
    8: "int64 uint64 float64 time duration",
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


KNOWN_TYPES: Final = {
    known.payload.schema_name: known
    for known in (
        RosType(EMPTY, 0),
        RosType(STRING, None),
        *(_primitive(name, size) for size, names in _SIZES.items() for name in names.split()),
    )
}


class TopicTable:
    """The topics that a board has announced so far. `longest_frame` is the longest frame that it accepts.

    A sketch may have several publishers or subscribers of one topic (two tf broadcasters, for example). Each has an id
    of its own; together they are one topic.
    """

    def __init__(self, longest_frame: int) -> None:
        self._longest_frame = longest_frame
        self._endpoints: dict[tuple[Flow, int], BoardTopic] = {}
        """What the board has announced, by direction and id."""
        self._responses: dict[tuple[Flow, int], str] = {}
        """The services whose responses have an id of their own."""
        self._buffers: dict[int, int] = {}
        self._rejected: set[TopicInfo] = set()
        self.last: tuple[int, int] | None = None
        """The kind and id of the last announcement; a board announces in the same order each time."""
        self._first: tuple[int, int] | None = None
        self._final: tuple[int, int] | None = None

    def clear(self) -> None:
        """Forget the topics: another board may come."""
        self._endpoints.clear()
        self._responses.clear()
        self._buffers.clear()
        self.last = self._first = self._final = None

    @property
    def is_complete(self) -> bool:
        """Whether the last announcement is that after which the first one has come again: the board has no other."""
        return self._final is not None and self.last == self._final

    def device_info(self) -> DeviceInfo:
        """What the board has reported about itself: each topic once."""
        return DeviceInfo("", "", tuple(dict.fromkeys(self._endpoints.values())))

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
            self._responses[RESPONSES[kind], info.id] = name
            return True
        known = KNOWN_TYPES.get(info.type)
        payload = known.payload if known is not None else PayloadType("ros1", info.type, "ros1msg")
        topic = BoardTopic(name, FLOWS[kind], payload, info.id)
        if (topic.flow, info.id) in self._endpoints:
            return self._endpoints[topic.flow, info.id] == topic
        if self._final is not None and self.device_info().find(name, topic.flow) is not None:
            return False  # this board had announced all that it has, without this one
        self._endpoints[topic.flow, info.id] = topic
        return True

    def sender(self, topic_id: int) -> BoardTopic | None:
        """The topic on which the board sends messages with this id."""
        return self._endpoints.get((Flow.PUBLISHES, topic_id)) or self._endpoints.get((Flow.REQUESTS, topic_id))

    def response_id(self, topic: BoardTopic) -> int | None:
        """The id of the responses of a service: for a board's n-th client of it, the n-th one."""
        ids = [number for (flow, number), name in self._responses.items() if (flow, name) == (topic.flow, topic.name)]
        return next((number for one, number in zip(self._ids(topic), ids, strict=False) if one == topic.id), None)

    def resolve(self, command: Command) -> tuple[BoardTopic, list[RosserialMessage]]:
        """The topic of a command, and the message for each subscriber.

        Raises `CommandRefused` if the board can't accept it.
        """
        topic = self.device_info().find(command.topic, Flow.SUBSCRIBES, Flow.SERVES)
        if topic is None:
            raise CommandRefused(command.topic, "the board has not announced that it subscribes to it")
        known = KNOWN_TYPES.get(topic.type.schema_name)
        try:
            if known is not None and topic.flow is Flow.SUBSCRIBES:
                known.check(command.payload)
        except InvalidPayload as error:
            raise CommandRefused(command.topic, str(error)) from None
        ids = self._ids(topic) if topic.flow is Flow.SUBSCRIBES else [topic.id]
        size, limit = len(command.payload), min(map(self.max_data, ids))
        if size > limit:
            raise CommandRefused(command.topic, f"it has {size} bytes; the board accepts {limit} on this line")
        return topic, [RosserialMessage(one, command.payload) for one in ids]

    def _ids(self, topic: BoardTopic) -> list[int]:
        """The ids of all its publishers, or of all its subscribers."""
        return [one.id for one in self._endpoints.values() if one == topic]

    def max_data(self, topic_id: int) -> int:
        """The most bytes of data that the board accepts: in its buffer, and in the time that it allows a frame."""
        return min(self._buffers.get(topic_id, 0), self._longest_frame - frame_size(0))

    def _valid_name(self, info: TopicInfo) -> str | None:
        """The name of an announced topic; None if it, its id or its type is not valid."""
        known = KNOWN_TYPES.get(info.type)
        why = name = ""
        if info.id < 100:
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


class RosserialPace(NamedTuple):
    """How a board is asked for what it may have lost."""

    ask: float = 0.5
    """Seconds between two requests for the topics while a board starts."""
    settle: float = 0.1
    """Seconds without another announcement after which a board has announced all."""
    missing: float = 0.5
    """The same behind a command if answers are missing: their requests were lost, or the board is late."""
    quiet: float = 3.0
    """Seconds of silence after which the topics are requested again: a board asks for the time every 2.5."""
    lost: float = 10.0
    """Seconds of silence, without an active command, after which a board is lost."""
    repeat: float = 0.2
    """Seconds after which the request behind a command is repeated; each further delay is twice as long."""
    requests: int = 5
    """The most requests behind one command: more would fill the board's 64 bytes while a callback blocks."""
    cut_off: float = 0.1
    """Seconds after a command was sent in which a pulled cable may have cut it off."""
    forgets: float = 11.5
    """Seconds after the last answer to a board's request for the time, after which it does not speak by itself any
    more."""


ROSSERIAL_PACE: Final = RosserialPace()


@dataclass
class _ActiveCommand:
    """The command that was sent and has not ended. `rest` are the messages for the topic's other subscribers."""

    command: Command
    topic: BoardTopic
    sent_at: float = 0.0
    repeat_at: float = float("inf")
    delay: float = ROSSERIAL_PACE.repeat
    requests: int = 1
    late: int = 0
    """Answers to requests before this command that may still come: they don't say that it was read."""
    answer: bytes | None = None
    rest: list[RosserialMessage] = field(default_factory=list)


class RosserialDialect(Dialect):
    """`parameters` are what a sketch may request; `clock` gives the time that boards ask for. A command
    waits `settle_time` s if answers to requests behind the last one are missing: longer for a slow board."""

    def __init__(
        self,
        *,
        baud: int,
        parameters: Mapping[str, object] | None = None,
        clock: Callable[[], float] = time.time,
        settle_time: float = ROSSERIAL_PACE.missing,
    ) -> None:
        super().__init__(baud=baud, parameters=parameters)
        self._clock = clock
        # Bytes for whose time on the line a board may be silent between two announcements, if that takes longer.
        self._ready_time = max(ROSSERIAL_PACE.settle, 300 * 10 / baud)
        self._settle_time = max(settle_time, self._ready_time)
        self._decoder = RosserialDecoder(self.counters)
        self._topics = TopicTable(longest_frame(baud))
        self._last_announced: tuple[int, int] | None = None
        self._last_heard = self._last_asked = self._remembers_until = 0.0
        self._settled_at: float | None = None
        self._answers_expected = 0
        self._answers_late = 0
        """Of the answers that were expected when the wait for them ended, those that may still come: one at most."""
        self._active: _ActiveCommand | None = None
        self._listens_until: float | None = None

    @property
    def next_tick(self) -> float:
        due = self._next_expiry
        if self._active is not None:
            due = min(due, self._active.repeat_at, self._active.command.deadline)
        if self._listens_until is not None:
            due = min(due, self._listens_until)
        if self._settled_at is not None:
            due = min(due, self._settled_at)
        elif self._is_open and self._active is None:
            quiet = self._last_heard + ROSSERIAL_PACE.quiet if self.info is not None else 0.0
            due = min(due, max(quiet, self._last_asked + ROSSERIAL_PACE.ask))
        return due

    def opened(self, now: float) -> None:
        """Request the topics, which a board that is starting does not hear; or listen what became of a command."""
        self._is_open, self._last_heard = True, now
        self._decoder.reset()
        if self._listens_until is None:
            self._ask_topics(now)

    def closed(self, now: float) -> None:
        """The active command waits if the board may still remember the host; otherwise it is in doubt."""
        self._is_open, self._settled_at = False, None
        self._out.clear()
        active = self._active
        until = None
        if (
            active is not None
            and active.topic.flow is Flow.SUBSCRIBES
            and active.sent_at + ROSSERIAL_PACE.cut_off <= now
        ):
            until, active.repeat_at = self._remembers_until, float("inf")
        self._lose_board("the line is closed", until=until)

    def receive(self, data: bytes, now: float) -> None:
        for message in self._decoder.feed(data):
            self._last_heard = now
            self._handle(message, now)

    def tick(self, now: float) -> None:
        """Give up what is late, request the topics of a quiet board, end a series of announcements."""
        self._expire_queued(now)
        if self._settled_at is not None and self._settled_at <= now:
            self._settle(now)
        if self._listens_until is not None and self._listens_until <= now:
            self._lose_board("the board was restarted, or was silent for long")
        active = self._active
        if active is not None and active.command.deadline <= now:
            self._finish(CallStatus.FAILED, "doubt", "the board did not read on", now)
        elif active is not None and active.repeat_at <= now:
            self._repeat_request(active, now)
        if not self._is_open or self._settled_at is not None:
            return
        quiet = self.info is None or self._last_heard + ROSSERIAL_PACE.quiet <= now
        if quiet and active is None and self._last_asked + ROSSERIAL_PACE.ask <= now:
            self._ask_topics(now)
        if self.info is not None and active is None and self._last_heard + ROSSERIAL_PACE.lost <= now:
            self._lose_board("the board is silent")

    def submit(self, command: Command, now: float) -> None:
        if self.info is not None:
            self._topics.resolve(command)
        self._enqueue(command)
        self._send_next(now)

    def respond(self, topic: BoardTopic, payload: bytes, now: float) -> None:
        """Send the response to a request of the board, if it fits its buffer."""
        response_id = self._topics.response_id(topic)
        if response_id is None or len(payload) > self._topics.max_data(response_id):
            dropped = log_event("response-dropped", topic=topic.name, bytes=len(payload))
            log.warning("the response on %s, %d bytes, is too long", topic.name, len(payload), extra=dropped)
            return
        self._send(RosserialMessage(response_id, payload))

    def _handle(self, message: RosserialMessage, now: float) -> None:
        if self._listens_until is not None and message.id not in (RosserialId.LOG, RosserialId.PARAMETER):
            self._resume(now, ask=message.id not in ANNOUNCEMENTS)
        try:
            if message.id in ANNOUNCEMENTS:
                self._handle_announcement(message.id, decode_topic_info(message.data), now)
            elif message.id == RosserialId.TIME:
                self._remembers_until = now + ROSSERIAL_PACE.forgets
                self._send(encode_time(self._clock()))
            elif message.id == RosserialId.LOG:
                self._events.append(BoardLogged(*decode_log(message.data)))
            elif message.id == RosserialId.PARAMETER:
                self._handle_parameter_request(decode_parameter_name(message.data))
            else:
                self._handle_message(message, now)
        except InvalidPayload as error:
            self.counters.refused += 1
            log.info("a message of the board can't be decoded: %s", error, extra=log_event("message-undecodable"))

    def _handle_announcement(self, kind: int, info: TopicInfo, now: float) -> None:
        if self._topics.last is None:
            self._ask_topics(now)  # to learn from the second answer where the first one ends
        if not self._topics.add(kind, info):
            self._lose_board("the board has other topics now")
            self._topics.add(kind, info)
        active = self._active if self.info is not None and self._settled_at is None else None
        if active is not None and active.topic.flow is Flow.SUBSCRIBES:
            if active.late:
                active.late -= (kind, info.id) == self._last_announced
                active.requests = max(1, active.requests - (not active.late))
                return
            self._settled_at, self._answers_expected = now + self._settle_time, active.requests
            active.repeat_at = float("inf")
            if not active.rest:
                self._finish(CallStatus.READ, "", "", now)
        if self.info is None or self._settled_at is not None:
            self._settled_at = now + (self._ready_time if self.info is None else self._settle_time)
            self._answers_expected -= (kind, info.id) == self._last_announced
            if self.info is not None and self._answers_expected <= 0:
                self._settle(now)

    def _settle(self, now: float) -> None:
        """The announcements have ended; if they have not been repeated yet, they are requested again."""
        self._settled_at = None
        self._answers_late = min(1, max(0, self._answers_expected)) if self.info is not None else 0
        if self.info is None and self._topics.is_complete:
            self.info, self._last_announced = self._topics.device_info(), self._topics.last
            self._events.append(BoardReady(self.info))
        if self._active is not None and self._active.rest:
            self._transmit(self._active, now)
        self._send_next(now)

    def _handle_message(self, message: RosserialMessage, now: float) -> None:
        active = self._active
        if active is not None and self._topics.response_id(active.topic) == message.id:
            active.answer = message.data
            self._finish(CallStatus.DONE, "", "", now)
            return
        topic = self._topics.sender(message.id)
        if topic is None:
            self.counters.stray += 1
            return
        if topic.flow is Flow.PUBLISHES and (known := KNOWN_TYPES.get(topic.type.schema_name)) is not None:
            known.check(message.data)
        self._events.append(MessageReceived(topic, message.data))

    def _handle_parameter_request(self, name: str) -> None:
        value = self._parameters.get(name, self._parameters.get(name.lstrip("~/")))
        if value is None:
            missing = log_event("parameter-missing", parameter=name)
            log.warning("the board requests the parameter %r, which is not set", name, extra=missing)
        self._send(encode_parameter(value))

    def _send_next(self, now: float) -> None:
        is_free = self.info is not None and self._settled_at is None and self._active is None
        if is_free and (found := self._next_of(self._topics.resolve)) is not None:
            command, (topic, messages) = found
            self._active = _ActiveCommand(command, topic, rest=messages)
            self._transmit(self._active, now)

    def _transmit(self, active: _ActiveCommand, now: float) -> None:
        """Send the command's message to the next subscriber of its topic, or to the service."""
        active.sent_at, active.repeat_at = now, now + ROSSERIAL_PACE.repeat
        active.delay, active.requests = ROSSERIAL_PACE.repeat, 1
        active.late, self._answers_late = self._answers_late, 0
        self._send(active.rest.pop(0))
        if active.topic.flow is Flow.SUBSCRIBES:
            self._out += ASK_TOPICS

    def _repeat_request(self, active: _ActiveCommand, now: float) -> None:
        """Repeat the request behind a command: it was damaged, or the board is running a callback."""
        active.delay *= 2
        active.repeat_at = now + active.delay
        if active.requests < ROSSERIAL_PACE.requests and active.topic.flow is Flow.SUBSCRIBES:
            active.requests += 1
            self.counters.repeated += 1
            self._out += ASK_TOPICS

    def _finish(self, status: CallStatus, reason: str, detail: str, now: float) -> None:
        assert self._active is not None
        active, self._active, self._listens_until = self._active, None, None
        kind = active.topic.type if active.answer is not None else None
        self._events.append(CommandFinished(active.command, status, active.answer or b"", kind, reason, detail))
        self._send_next(now)

    def _lose_board(self, why: str, *, until: float | None = None) -> None:
        """The board is no longer ready. The active command waits `until` then, or is in doubt; queued ones stay."""
        self._listens_until = until
        if self._active is not None and until is None:
            active, self._active = self._active, None
            self._fail(active.command, "doubt", f"{why}; it is not known whether the board had read it")
        if self.info is not None:
            self.info = None
            self._events.append(BoardLost(why))
        if until is None:
            self._topics.clear()

    def _resume(self, now: float, *, ask: bool) -> None:
        """The board has not restarted: it is ready as before, and has read the active command or will."""
        assert self._active is not None
        self._listens_until, self.info = None, self._topics.device_info()
        self._events.append(BoardReady(self.info))
        if ask:
            self._active.requests, self._active.delay, self._active.repeat_at = (
                1,
                ROSSERIAL_PACE.repeat,
                now + ROSSERIAL_PACE.repeat,
            )
            self._out += ASK_TOPICS

    def _ask_topics(self, now: float) -> None:
        self._last_asked = now
        if self.info is not None:  # a command waits for the answer, which would else seem to be its own
            self._settled_at, self._answers_expected = now + self._settle_time, 1
        self._out += ASK_TOPICS
        self.counters.sent += 1

    def _send(self, message: RosserialMessage) -> None:
        self._out += encode_message(message)
        self.counters.sent += 1
