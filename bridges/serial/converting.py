"""The same value in another type: what callers write as text or JSON, as a board has announced its topic."""

from __future__ import annotations

import msgspec

from schemas.errors import InvalidPayload
from schemas.payloads import EMPTY, JSON, STRING, PayloadType, String


def converted(payload: bytes, given: PayloadType, wanted: PayloadType) -> bytes:
    """The payload as `wanted`, where the value is a text or nothing; any other comes back as it is, to be checked."""
    try:
        if (given, wanted) == (STRING, JSON):
            return msgspec.json.encode(String.decode(payload).data)
        if (given, wanted) == (JSON, STRING) and isinstance(text := msgspec.json.decode(payload), str):
            return String(text).encode()
        if (given, wanted) == (JSON, EMPTY) and msgspec.json.decode(payload) is None:
            return b""
    except (InvalidPayload, msgspec.DecodeError, UnicodeDecodeError):
        pass  # it is not what it was said to be, and the board's own type will say so
    return payload
