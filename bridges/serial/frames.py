"""Our own frames, to the byte as docs/frames.md has them: encoding, and finding them in what arrives.

A frame is `kind << 4 | sequence`, an id, at most 96 bytes of payload, and a CRC-16/CCITT-FALSE of all that (low byte
first); stuffed by COBS, so that a zero byte ends it and stands nowhere else.
"""

from __future__ import annotations

from binascii import crc_hqx
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final

from cobs import cobs  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from bridges.serial.dialect import Counters

MAX_PAYLOAD: Final = 96
SEQUENCES: Final = 16
BOARD_ID: Final = 0xFF
"""The id of what concerns the board as a whole."""
_HEAD: Final = 2
_CHECK: Final = 2
_LONGEST: Final = _HEAD + MAX_PAYLOAD + _CHECK + 1
"""Bytes of a frame once stuffed, without its end: below 254 bytes COBS adds one."""


class Kind(IntEnum):
    """What a frame says; below 8 the host speaks, from 8 on the board."""

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


_KINDS: Final = frozenset(map(int, Kind))


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame. `sequence` is 0 to 15, `id` 0 to 255."""

    kind: Kind
    sequence: int
    id: int
    payload: bytes = b""


def encode(frame: Frame) -> bytes:
    """The bytes on the line, their end included. Raises `ValueError` for a payload that is too long."""
    if len(frame.payload) > MAX_PAYLOAD:
        raise ValueError(f"{len(frame.payload)} bytes of payload, and {MAX_PAYLOAD} are the most")
    body = bytes((frame.kind << 4 | frame.sequence, frame.id)) + frame.payload
    return bytes(cobs.encode(body + checksum(body).to_bytes(_CHECK, "little"))) + b"\0"


def checksum(body: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, beginning with 0xFFFF."""
    return crc_hqx(body, 0xFFFF)


def decode(stuffed: bytes) -> Frame | None:
    """The frame in what stood between two zero bytes; None if its check does not hold."""
    try:
        body = bytes(cobs.decode(stuffed))
    except cobs.DecodeError:
        return None
    if len(body) < _HEAD + _CHECK or checksum(body[:-_CHECK]) != int.from_bytes(body[-_CHECK:], "little"):
        return None
    kind = body[0] >> 4
    if kind not in _KINDS or len(body) > _HEAD + MAX_PAYLOAD + _CHECK:
        return None
    return Frame(Kind(kind), body[0] & 0x0F, body[1], body[_HEAD:-_CHECK])


class Deframer:
    """Finds the frames in what arrives, in pieces of any size; counts what is none."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._pending = bytearray()

    def reset(self) -> None:
        """What comes next does not belong to what came before."""
        self._pending.clear()

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that these bytes complete."""
        *ended, rest = data.split(b"\0")
        frames = []
        for piece in ended:
            stuffed = bytes(self._pending) + piece
            self._pending.clear()
            if stuffed and (frame := self._frame(stuffed)) is not None:
                frames.append(frame)
        self._pending += rest
        if len(self._pending) > 4 * _LONGEST:  # no frame any more: keep enough to see that at its end
            self._counters.noise += len(self._pending) - 2 * _LONGEST
            del self._pending[: -2 * _LONGEST]
        return frames

    def _frame(self, stuffed: bytes) -> Frame | None:
        frame = decode(stuffed)
        if frame is None:
            self._counters.damaged += 1
        else:
            self._counters.received += 1
        return frame
