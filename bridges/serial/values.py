"""Payloads of topics as they travel in the mesh and in our own frames (msgpack), by the topic's type."""

from __future__ import annotations

from typing import Final

import msgspec

from bridges.serial.errors import UnfitMessage
from bridges.serial.frames import MAX_PAYLOAD
from schemas.errors import InvalidPayload
from schemas.payloads import EMPTY, JSON, RAW, STRING, Empty, PayloadType, String

TYPES: Final = {"std_msgs/Empty": EMPTY, "std_msgs/String": STRING, "json": JSON, "raw": RAW}
"""What a firmware may call the type of a topic. `raw` bytes are not msgpack but carried as they are."""

_UNREADABLE: Final = (InvalidPayload, msgspec.DecodeError, UnicodeDecodeError, RecursionError)


def to_board(topic: str, kind: PayloadType, payload: bytes) -> bytes:
    """What a frame carries for this payload. Raises `UnfitMessage` for one that is not of its type, or too long."""
    try:
        carried = _encoded(kind, payload)
    except (*_UNREADABLE, OverflowError) as error:
        raise UnfitMessage(topic, str(error)) from None
    if len(carried) > MAX_PAYLOAD:
        raise UnfitMessage(topic, f"it takes {len(carried)} bytes, and {MAX_PAYLOAD} are the most")
    return carried


def from_board(kind: PayloadType, carried: bytes) -> bytes:
    """The payload in the mesh of what a frame carried. Raises `InvalidPayload` if it is not of its type."""
    try:
        return _decoded(kind, carried)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, TypeError, ValueError) as error:
        if isinstance(error, InvalidPayload):
            raise
        raise InvalidPayload(kind.schema_name or kind.encoding, str(error)) from None


def _encoded(kind: PayloadType, payload: bytes) -> bytes:
    if kind == EMPTY:
        Empty.decode(payload)
        return b""
    if kind == STRING:
        return msgspec.msgpack.encode(String.decode(payload).data)
    if kind == JSON and payload:
        return msgspec.msgpack.encode(msgspec.json.decode(payload))
    return payload


def _decoded(kind: PayloadType, carried: bytes) -> bytes:
    if kind == EMPTY:
        return Empty.decode(carried).encode()
    if kind == STRING:
        return String(msgspec.msgpack.decode(carried, type=str)).encode()
    if kind == JSON:
        return msgspec.json.encode(msgspec.msgpack.decode(carried) if carried else None)
    return carried
