"""Our own frames, to the byte as docs/frames.md specifies them: the codec of frames and of what they carry.

A frame is `kind << 4 | sequence`, an id, at most 96 bytes of payload, and a CRC-16/CCITT-FALSE of these (low byte
first), stuffed by COBS so that a zero byte ends it and occurs nowhere else. Payloads are msgpack.
"""

from __future__ import annotations

import logging
from binascii import crc_hqx
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final

import msgspec

from bridges.serial.dialect import BoardTopic, Flow
from bridges.serial.errors import InvalidBoardMessage
from mesh.extras import needs_extra
from mesh.log_context import log_event
from schemas.agent_keys import topic_chunks
from schemas.errors import InvalidKey, InvalidPayload
from schemas.payloads import EMPTY, JSON, RAW, STRING, Empty, PayloadType, String

with needs_extra("serial", "a serial line"):
    from cobs import cobs  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from bridges.serial.dialect import LineCounters

log = logging.getLogger(__name__)

PROTOCOL: Final = 1
"""The version of the protocol."""
MAX_PAYLOAD: Final = 96
SEQUENCES: Final = 16
BOARD_ID: Final = 0xFF
"""The id of frames that concern the board as a whole."""
TYPES: Final = {"std_msgs/Empty": EMPTY, "std_msgs/String": STRING, "json": JSON, "raw": RAW}
"""What firmware may give as the type of a topic. Payloads of `raw` are bytes, not msgpack."""

_HEAD: Final = 2
_CHECK: Final = 2
_LONGEST: Final = _HEAD + MAX_PAYLOAD + _CHECK + 1
"""Bytes of a stuffed frame without its end: below 254 bytes COBS adds one."""
_DECODE_ERRORS: Final = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


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
    if len(frame.payload) > MAX_PAYLOAD:
        raise ValueError(f"the payload has {len(frame.payload)} bytes; the limit is {MAX_PAYLOAD}")
    body = bytes((frame.kind << 4 | frame.sequence, frame.id)) + frame.payload
    return bytes(cobs.encode(body + crc16(body).to_bytes(_CHECK, "little"))) + b"\0"


def crc16(body: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF."""
    return crc_hqx(body, 0xFFFF)


def decode_frame(stuffed: bytes) -> Frame | None:
    """The frame in the bytes between two zero bytes; None if it is damaged."""
    try:
        body = bytes(cobs.decode(stuffed))
    except cobs.DecodeError:
        return None
    if len(body) < _HEAD + _CHECK or crc16(body[:-_CHECK]) != int.from_bytes(body[-_CHECK:], "little"):
        return None
    kind = body[0] >> 4
    if kind not in _KINDS or len(body) > _HEAD + MAX_PAYLOAD + _CHECK:
        return None
    return Frame(FrameKind(kind), body[0] & 0x0F, body[1], body[_HEAD:-_CHECK])


class FrameDecoder:
    """Decodes the frames in a stream of bytes, in pieces of any size, and counts damaged ones."""

    def __init__(self, counters: LineCounters) -> None:
        self._counters = counters
        self._pending = bytearray()

    @property
    def pending(self) -> int:
        """How many bytes wait for the end of their frame."""
        return len(self._pending)

    def reset(self) -> None:
        """Discard the beginning of a frame: the next bytes are from another stream."""
        self._pending.clear()

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that these bytes complete."""
        *ended, rest = data.split(b"\0")
        frames = []
        for piece in ended:
            stuffed = bytes(self._pending) + piece
            self._pending.clear()
            if stuffed and (frame := self._decode(stuffed)) is not None:
                frames.append(frame)
        self._pending += rest
        if len(self._pending) > 4 * _LONGEST:  # no frame: keep just enough to find it damaged at its end
            self._counters.noise += len(self._pending) - 2 * _LONGEST
            del self._pending[: -2 * _LONGEST]
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
        board = msgspec.msgpack.decode(frame.payload, type=BoardDescription)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        log.warning("the board's description can't be decoded: %s", error, extra=log_event("board-undecodable"))
        return None
    if board.protocol != PROTOCOL:
        unsupported = log_event("board-unsupported", board=board.name, protocol=board.protocol)
        log.warning(
            "%s uses version %d of the frames; supported is %d", board.name, board.protocol, PROTOCOL, extra=unsupported
        )
        return None
    return board


def decode_topic(frame: Frame) -> BoardTopic | None:
    """The topic in a TOPIC frame; None, with a warning, if its name or encoding is invalid."""
    try:
        topic = msgspec.msgpack.decode(frame.payload, type=_TopicDescription)
        name = topic_chunks("/" + topic.name.lstrip("/"))
    except (msgspec.DecodeError, UnicodeDecodeError, InvalidKey) as error:
        rejected = log_event("topic-rejected", id=frame.id)
        log.warning("topic %d of the board can't be used: %s", frame.id, error, extra=rejected)
        return None
    flow = Flow.SUBSCRIBES if topic.callable else Flow.PUBLISHES
    return BoardTopic(name, flow, TYPES.get(topic.type, JSON), frame.id)


def encode_payload(topic: str, kind: PayloadType, payload: bytes) -> bytes:
    """A topic's payload as a frame carries it. Raises `InvalidBoardMessage` if it is not of its type, or too long."""
    try:
        encoded = _encode(kind, payload)
    except (InvalidPayload, OverflowError, *_DECODE_ERRORS) as error:
        raise InvalidBoardMessage(topic, str(error)) from None
    if len(encoded) > MAX_PAYLOAD:
        raise InvalidBoardMessage(topic, f"it takes {len(encoded)} bytes; the limit is {MAX_PAYLOAD}")
    return encoded


def decode_payload(kind: PayloadType, encoded: bytes) -> bytes:
    """The payload in the mesh of what a frame carried. Raises `InvalidPayload` if it is not of its type."""
    try:
        return _decode(kind, encoded)
    except InvalidPayload:
        raise
    except (*_DECODE_ERRORS, TypeError, ValueError) as error:
        raise InvalidPayload(kind.schema_name or kind.encoding, str(error)) from None


def _encode(kind: PayloadType, payload: bytes) -> bytes:
    if kind == EMPTY:
        Empty.decode(payload)
        return b""
    if kind == STRING:
        return msgspec.msgpack.encode(String.decode(payload).data)
    if kind == JSON and payload:
        return msgspec.msgpack.encode(msgspec.json.decode(payload))
    return payload


def _decode(kind: PayloadType, encoded: bytes) -> bytes:
    if kind == EMPTY:
        return Empty.decode(encoded).encode()
    if kind == STRING:
        return String(msgspec.msgpack.decode(encoded, type=str)).encode()
    if kind == JSON:
        return msgspec.json.encode(msgspec.msgpack.decode(encoded) if encoded else None)
    return encoded
