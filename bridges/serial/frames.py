"""Our own frames: the codec, to the byte as docs/reference/frames.md specifies it, and the host's side of the protocol.

A frame is `kind << 4 | sequence`, an id, at most 96 bytes of payload, and a CRC-16/CCITT-FALSE of these (low byte
first), stuffed by COBS so that a zero byte ends it and occurs nowhere else. Payloads are msgpack.

One request is pending at a time and is repeated until it is answered, so nothing piles up in the board's 64 bytes. The
board recognizes a repeated call by its sequence number and answers it from memory; after a restart it accepts no call
until the host has opened a new session, so the host always learns of the restart first.
"""

from __future__ import annotations

import logging
import os
from binascii import crc_hqx
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from bridges.serial.dialect import (
    BoardLost,
    BoardReady,
    BoardTopic,
    CallStatus,
    CommandFinished,
    CommandRefused,
    DeviceInfo,
    Dialect,
    Flow,
    MessageReceived,
)
from mesh.base.extras import needs_extra
from mesh.base.log_context import log_event
from schemas.decoding import InvalidData, decode_json, decode_msgpack
from schemas.errors import InvalidKey, InvalidPayload
from schemas.keys import topic_chunks
from schemas.payloads import EMPTY, JSON, RAW, STRING, Empty, PayloadType, String

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bridges.serial.dialect import Command, LineCounters


with needs_extra("serial", "a serial line"):
    from cobs import cobs  # type: ignore[import-untyped]

log = logging.getLogger(__name__)


class FrameFormat(NamedTuple):
    """The sizes and numbers of frames, in this version of the protocol."""

    version: int = 1
    """The version of the protocol."""
    head: int = 2
    """Bytes before the payload."""
    payload: int = 96
    """Bytes of the longest payload."""
    check: int = 2
    """Bytes of the checksum."""
    sequences: int = 16
    """Sequence numbers, after which they begin again."""
    board: int = 0xFF
    """The id of frames that concern the board as a whole."""
    last_session: int = 0xFFFF
    """The largest number of a session."""

    @property
    def longest(self) -> int:
        """Bytes of a stuffed frame without its end: below 254 bytes COBS adds one."""
        return self.head + self.payload + self.check + 1


FRAME: Final = FrameFormat()
TYPES: Final = {"std_msgs/Empty": EMPTY, "std_msgs/String": STRING, "json": JSON, "raw": RAW}
"""What firmware may give as the type of a topic. Payloads of `raw` are bytes, not msgpack."""


class FrameKind(IntEnum):
    """What a frame says; the host sends those below 8, the board the others."""

    ASK = 1
    OPEN = 2
    CALL = 3
    BOARD = 8
    TOPIC = 9
    OPENED = 10
    TAKEN = 11
    DONE = 12
    FAILED = 13
    EVENT = 14


_KINDS: Final = frozenset(map(int, FrameKind))


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame. `sequence` is 0 to 15, `id` 0 to 255."""

    kind: FrameKind
    sequence: int
    id: int
    payload: bytes = b""


class BoardDescription(msgspec.Struct, array_like=True, frozen=True):
    """The payload of a BOARD frame; `session` is the one that a host has opened since the board started, or 0."""

    protocol: int
    name: str
    version: str
    session: int
    topics: int


class _TopicDescription(msgspec.Struct, array_like=True, frozen=True):
    """The payload of a TOPIC frame; `callable` is false for a topic that the board publishes."""

    callable: bool
    name: str
    type: str


def encode_frame(frame: Frame) -> bytes:
    """The bytes on the line, with their end. Raises `ValueError` for a payload that is too long."""
    if len(frame.payload) > FRAME.payload:
        raise ValueError(f"the payload has {len(frame.payload)} bytes; the limit is {FRAME.payload}")
    body = bytes((frame.kind << 4 | frame.sequence, frame.id)) + frame.payload
    return bytes(cobs.encode(body + crc16(body).to_bytes(FRAME.check, "little"))) + b"\0"


def crc16(body: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF."""
    return crc_hqx(body, 0xFFFF)


def decode_frame(stuffed: bytes) -> Frame | None:
    """The frame in the bytes between two zero bytes; None if it is damaged."""
    try:
        body = bytes(cobs.decode(stuffed))
    except cobs.DecodeError:
        return None
    end = len(body) - FRAME.check
    if end < FRAME.head or crc16(body[:end]) != int.from_bytes(body[end:], "little"):
        return None
    kind = body[0] >> 4
    if kind not in _KINDS or end > FRAME.head + FRAME.payload:
        return None
    return Frame(FrameKind(kind), body[0] & 0x0F, body[1], body[FRAME.head : end])


class FrameDecoder:
    """Decodes the frames in a stream of bytes, in pieces of any size, and counts damaged ones."""

    def __init__(self, counters: LineCounters) -> None:
        self._counters = counters
        self._pending = bytearray()

    @property
    def pending(self) -> int:
        return len(self._pending)

    def reset(self) -> None:
        """Discard the beginning of a frame: the next bytes are from another stream."""
        self._pending.clear()

    def feed(self, data: bytes) -> list[Frame]:
        *ended, rest = data.split(b"\0")
        frames = []
        for piece in ended:
            stuffed = bytes(self._pending) + piece
            self._pending.clear()
            if stuffed and (frame := self._decode(stuffed)) is not None:
                frames.append(frame)
        self._pending += rest
        if len(self._pending) > 4 * FRAME.longest:  # no frame: keep just enough to find it damaged at its end
            self._counters.noise += len(self._pending) - 2 * FRAME.longest
            del self._pending[: -2 * FRAME.longest]
        return frames

    def _decode(self, stuffed: bytes) -> Frame | None:
        frame = decode_frame(stuffed)
        if frame is None:
            self._counters.damaged += 1
        else:
            self._counters.received += 1
        return frame


def decode_board(frame: Frame) -> BoardDescription | None:
    """What a BOARD frame says; None, with a warning, if it can't be decoded or is of another protocol version."""
    try:
        board = decode_msgpack(frame.payload, BoardDescription)
    except InvalidData as error:
        log.warning("the board's description can't be decoded: %s", error, extra=log_event("board-undecodable"))
        return None
    if board.protocol != FRAME.version:
        unsupported = log_event("board-unsupported", board=board.name, protocol=board.protocol)
        log.warning(
            "%s uses version %d of the frames; supported is %d",
            board.name,
            board.protocol,
            FRAME.version,
            extra=unsupported,
        )
        return None
    return board


def decode_topic(frame: Frame) -> BoardTopic | None:
    """The topic in a TOPIC frame; None, with a warning, if its name or encoding is invalid."""
    try:
        topic = decode_msgpack(frame.payload, _TopicDescription)
        name = topic_chunks("/" + topic.name.lstrip("/"))
    except (InvalidData, InvalidKey) as error:
        rejected = log_event("topic-rejected", id=frame.id)
        log.warning("topic %d of the board can't be used: %s", frame.id, error, extra=rejected)
        return None
    flow = Flow.SUBSCRIBES if topic.callable else Flow.PUBLISHES
    return BoardTopic(name, flow, TYPES.get(topic.type, JSON), frame.id)


def encode_payload(topic: str, kind: PayloadType, payload: bytes) -> bytes:
    """A topic's payload as a frame carries it. Raises `CommandRefused` if it is not of its type, or too long."""
    encoded = payload
    try:
        if kind == EMPTY:
            Empty.decode(payload)
        elif kind == STRING:
            encoded = msgspec.msgpack.encode(String.decode(payload).data)
        elif kind == JSON and payload:
            encoded = msgspec.msgpack.encode(decode_json(payload))
    except (InvalidPayload, InvalidData, OverflowError) as error:
        raise CommandRefused(topic, str(error)) from None
    if len(encoded) > FRAME.payload:
        raise CommandRefused(topic, f"it takes {len(encoded)} bytes; the limit is {FRAME.payload}")
    return encoded


def decode_payload(kind: PayloadType, encoded: bytes) -> bytes:
    """The payload in the mesh of what a frame carried. Raises `InvalidPayload` if it is not of its type."""
    try:
        if kind == EMPTY:
            return Empty.decode(encoded).encode()
        if kind == STRING:
            return String(decode_msgpack(encoded, str)).encode()
        if kind == JSON:
            return msgspec.json.encode(decode_msgpack(encoded) if encoded else None)
    except InvalidPayload:
        raise
    except (TypeError, ValueError) as error:
        raise InvalidPayload(kind.schema_name or kind.encoding, str(error)) from None
    return encoded


class FramesPace(NamedTuple):
    """How long a board is waited for."""

    quiet: float = 2.0
    """Seconds of silence after which the board is asked whether it is still there."""
    lost: float = 5.0
    """Seconds of silence after which the board is lost."""
    answer: float = 0.03
    """Seconds that a board has for an answer, besides the time on the line, before the request is repeated."""
    answer_bytes: int = 24
    """Bytes of an answer that the time on the line allows for."""
    taken: float = 0.25
    """Seconds between two repetitions once the board has said that it is working on the call."""


FRAMES_PACE: Final = FramesPace()
ANSWERS: Final = {
    FrameKind.ASK: (FrameKind.BOARD, FrameKind.TOPIC),
    FrameKind.OPEN: (FrameKind.OPENED,),
    FrameKind.CALL: (FrameKind.DONE, FrameKind.FAILED, FrameKind.TAKEN),
}


@dataclass
class Request:
    """A frame that is repeated, at `repeat_at` next, until it is answered; `command` if it is a call."""

    frame: Frame
    repeat_at: float
    delay: float
    command: Command | None = None

    def is_answered_by(self, frame: Frame) -> bool:
        """Whether this frame answers this request, and not an earlier one."""
        same = (frame.sequence, frame.id) == (self.frame.sequence, self.frame.id)
        return same and frame.kind in ANSWERS[self.frame.kind]


class FramesDialect(Dialect):
    """Own frames. `session` is the number from 1 to 65535 of the first session; a random one by default."""

    def __init__(
        self, *, baud: int, parameters: Mapping[str, object] | None = None, session: int | None = None
    ) -> None:
        super().__init__(baud=baud, parameters=parameters)
        self._session = session or int.from_bytes(os.urandom(2), "little") or FRAME.last_session
        self._decoder = FrameDecoder(self.counters)
        self._board: BoardDescription | None = None
        self._topics: list[BoardTopic] = []
        self._known: DeviceInfo | None = None
        self._pending: Request | None = None
        self._call: Request | None = None
        self._ask_sequence = self._call_sequence = 0
        self._event_sequence: int | None = None
        self._last_heard = 0.0

    @property
    def next_tick(self) -> float:
        times = [self._next_expiry]
        if self._call is not None and self._call.command is not None:
            times.append(self._call.command.deadline)
        if self._is_open:
            times.append(self._pending.repeat_at if self._pending is not None else self._last_heard + FRAMES_PACE.quiet)
        return min(times)

    def opened(self, now: float) -> None:
        self._is_open, self._last_heard = True, now
        self._decoder.reset()
        self._out += b"\0"  # ends what noise on the line has begun
        self._ask(FRAME.board, now)

    def closed(self, now: float) -> None:
        """A pending call is resumed if the same board, still running, is found again."""
        self._is_open, self._pending = False, None
        self._out.clear()
        self._lose_board("the line is closed")

    def receive(self, data: bytes, now: float) -> None:
        for frame in self._decoder.feed(data):
            self._last_heard = now
            self._handle(frame, now)

    def tick(self, now: float) -> None:
        self._expire_queued(now)
        call = self._call
        if call is not None and call.command is not None and call.command.deadline <= now:
            self._give_up(call.command, now)
        if not self._is_open:
            return
        request = self._pending
        if self._last_heard + FRAMES_PACE.lost <= now and (request is None or request.command is None):
            self._lose_board("the board does not answer")
        if request is None and self._last_heard + FRAMES_PACE.quiet <= now:
            self._ask(FRAME.board, now)
        elif request is not None and request.repeat_at <= now:
            self._repeat(request, now)

    def submit(self, command: Command, now: float) -> None:
        if self._known is not None:
            self._find(command)
        self._enqueue(command)
        self._call_next(now)

    def _handle(self, frame: Frame, now: float) -> None:
        if frame.kind is FrameKind.EVENT:
            self._handle_event(frame)
            return
        if frame.kind is FrameKind.BOARD and self._handle_board(frame, now):
            return
        request = self._pending
        if request is None or not request.is_answered_by(frame):
            self.counters.stray += 1
        elif frame.kind is FrameKind.TAKEN:
            request.delay, request.repeat_at = FRAMES_PACE.taken, now + FRAMES_PACE.taken
        elif request.command is not None:
            self._events.append(self._outcome(request.command, frame))
            self._end_call(now)
        else:
            self._pending = None
            self._continue_handshake(frame, now)

    def _handle_board(self, frame: Frame, now: float) -> bool:
        """Whether this board has not opened our session: it was just started, or it is another one."""
        board = decode_board(frame)
        if board is None:
            self.counters.refused += 1
            return True
        if board.session == self._session and self._known is not None:
            return False
        if self._call is not None and self._call.command is not None:
            command, self._call = self._call.command, None
            self._fail(command, "doubt", "the board was restarted before it answered")
        self._lose_board("the board was restarted")
        self._board, self._known, self._topics, self._event_sequence = board, None, [], None
        self._ask_next_topic(now)
        return True

    def _continue_handshake(self, frame: Frame, now: float) -> None:
        if frame.kind is FrameKind.TOPIC:
            topic = decode_topic(frame)
            self.counters.refused += topic is None
            self._topics.append(topic or BoardTopic(f"/unusable/{frame.id}", Flow.PUBLISHES, RAW, frame.id))
            self._ask_next_topic(now)
        elif frame.kind is FrameKind.OPENED and self._board is not None:
            self._known = DeviceInfo(self._board.name, self._board.version, tuple(self._topics))
            self._board_ready(now)
        elif self.info is None:
            self._board_ready(now)  # the same board, still running
        else:
            self._call_next(now)

    def _ask_next_topic(self, now: float) -> None:
        """Ask for the next topic, or open the session when all are known."""
        assert self._board is not None
        if len(self._topics) < self._board.topics:
            self._ask(len(self._topics), now)
        else:
            self._ask(FRAME.board, now, FrameKind.OPEN, self._session.to_bytes(2, "little"))

    def _board_ready(self, now: float) -> None:
        assert self._known is not None
        self.info = self._known
        self._events.append(BoardReady(self._known))
        if self._call is not None:
            self._repeat(self._call, now)
        else:
            self._call_next(now)

    def _lose_board(self, why: str) -> None:
        if self.info is not None:
            self.info = None
            self._events.append(BoardLost(why))

    def _call_next(self, now: float) -> None:
        if self.info is None or self._pending is not None or (found := self._next_of(self._encoded)) is None:
            return
        command, (topic, payload) = found
        self._call_sequence = (self._call_sequence + 1) % FRAME.sequences
        self._call = self._send(Frame(FrameKind.CALL, self._call_sequence, topic, payload), now, command)

    def _encoded(self, command: Command) -> tuple[int, bytes]:
        topic = self._find(command)
        return topic.id, encode_payload(topic.name, topic.type, command.payload)

    def _find(self, command: Command) -> BoardTopic:
        """The topic of a command. Raises `CommandRefused`."""
        topic = None if self._known is None else self._known.find(command.topic, Flow.SUBSCRIBES)
        if topic is None:
            raise CommandRefused(command.topic, "the board has no such topic to call")
        return topic

    def _outcome(self, command: Command, frame: Frame) -> CommandFinished:
        try:
            payload = decode_payload(JSON, frame.payload)
        except InvalidPayload as error:
            self.counters.refused += 1
            payload = b"null"
            undecodable = log_event("answer-undecodable", topic=command.topic)
            log.warning("the answer to a call of %s can't be decoded: %s", command.topic, error, extra=undecodable)
        if frame.kind is FrameKind.DONE:
            return CommandFinished(command, CallStatus.DONE, payload, JSON)
        why = str(decode_json(payload) or "the board has not done it")
        return CommandFinished(command, CallStatus.FAILED, reason="refused", detail=why)

    def _give_up(self, command: Command, now: float) -> None:
        """Fail the pending call, and begin a new session, in which its sequence number means nothing."""
        self._lose_board("the board did not answer a call")
        self._session = self._session % FRAME.last_session + 1
        self._fail(command, "doubt", "the board did not answer")
        self._end_call(now)
        if self._is_open:
            self._ask(FRAME.board, now)

    def _end_call(self, now: float) -> None:
        if self._pending is self._call:
            self._pending = None
        self._call = None
        self._call_next(now)

    def _handle_event(self, frame: Frame) -> None:
        if self._event_sequence is not None:
            self.counters.missed += (frame.sequence - self._event_sequence - 1) % FRAME.sequences
        self._event_sequence = frame.sequence
        topics = self._known.topics if self._known else ()
        topic = next((each for each in topics if each.id == frame.id and each.flow is Flow.PUBLISHES), None)
        if topic is None:
            self.counters.stray += 1
            return
        try:
            self._events.append(MessageReceived(topic, decode_payload(topic.type, frame.payload)))
        except InvalidPayload as error:
            self.counters.refused += 1
            undecodable = log_event("message-undecodable", topic=topic.name)
            log.info("a message of the board on %s can't be decoded: %s", topic.name, error, extra=undecodable)

    def _ask(self, what: int, now: float, kind: FrameKind = FrameKind.ASK, payload: bytes = b"") -> None:
        self._ask_sequence = (self._ask_sequence + 1) % FRAME.sequences
        self._send(Frame(kind, self._ask_sequence, what, payload), now)

    def _send(self, frame: Frame, now: float, command: Command | None = None) -> Request:
        """Send a request, in place of the one that is pending."""
        data = encode_frame(frame)
        delay = (len(data) + FRAMES_PACE.answer_bytes) * 10 / self.baud + FRAMES_PACE.answer
        self._pending = Request(frame, now + delay, delay, command)
        self._out += data
        self.counters.sent += 1
        return self._pending

    def _repeat(self, request: Request, now: float) -> None:
        """Send a request again after a zero byte, which ends what noise has begun. The next delay is longer."""
        request.delay = min(request.delay * 1.5, 1.0)
        request.repeat_at = now + request.delay
        self._pending = request
        self._out += b"\0" + encode_frame(request.frame)
        self.counters.sent += 1
        self.counters.repeated += 1
