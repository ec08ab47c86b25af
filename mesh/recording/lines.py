"""Objectives as people and scripts write them: a JSON object a line.

Fields of a line:

- `topic`: the topic, `/blink`; required.
- `time`: seconds from the beginning, not negative, to the nanosecond; left out, it is that of the line before (0 at
  first). Lines may be in any order.
- `data`: what the message says. Left out or null, it is a std_msgs/Empty; a text is a std_msgs/String; anything else is
  JSON.
- `type`: only where that is not what is meant. `std_msgs/Empty` and `std_msgs/String`; `json`, or `json;NAME` to name
  the type; or any other encoding as Zenoh has it (`application/octet-stream`, `ros1;my_msgs/Move`,
  `application/cdr;my_msgs/msg/Move`), whose payload is then `data` in base64.
"""

from __future__ import annotations

import base64
import binascii
from decimal import Decimal
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.errors import InputError, InvalidKey
from mesh.recording.mcap_file import MAX_TIME
from mesh.recording.objective import Played
from schemas.errors import InvalidPayload
from schemas.key_chunks import topic_chunks
from schemas.payloads import EMPTY, JSON, STRING, Empty, PayloadType, String, encode_value, payload_type

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

_SECOND: Final = 10**9
_LONGEST: Final = 16 << 20
"""Bytes of the longest line."""


class InvalidLine(InputError):
    """A line is no message of an objective. `number` counts from 1."""

    code = "invalid-line"

    def __init__(self, number: int, why: str) -> None:
        super().__init__(
            f"line {number}: {why}", hint='a line is like {"topic": "/blink", "time": 0.5, "data": "blue"}'
        )
        self.number = number
        self.why = why


class _Line(msgspec.Struct, forbid_unknown_fields=True):
    topic: str
    time: Decimal | None = None
    data: Any = None
    type: str = ""


_DECODER: Final = msgspec.json.Decoder(_Line)


def messages_in(lines: Iterable[bytes]) -> Iterator[Played]:
    """The messages of the lines (see the module), in their order; empty lines are skipped. Times are in nanoseconds.

    Raises `InvalidLine`.
    """
    time = Decimal(0)
    for number, text in enumerate(lines, 1):
        if not text.strip():
            continue
        try:
            line = _decoded(text)
            time = time if line.time is None else line.time
            topic, moment = topic_chunks(line.topic), _nanoseconds(time)
            payload, kind = _payload(line)
        except (InvalidKey, InvalidPayload, ValueError) as error:
            raise InvalidLine(number, str(error)) from None
        yield Played(topic, payload, moment, moment, 0, kind)


def _decoded(text: bytes) -> _Line:
    if len(text) > _LONGEST:
        raise ValueError(f"it has {len(text)} bytes, more than {_LONGEST}")
    try:
        return _DECODER.decode(text)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(str(error)) from None


def _nanoseconds(seconds: Decimal) -> int:
    if not seconds.is_finite() or not 0 <= seconds <= MAX_TIME // _SECOND:
        raise ValueError(f"{seconds} is no time in seconds from the beginning")
    return int(seconds * _SECOND)


def _payload(line: _Line) -> tuple[bytes, PayloadType]:
    data = line.data
    match line.type:
        case "":
            return encode_value(Empty() if data is None else data)
        case EMPTY.schema_name:
            if data is not None:
                raise ValueError("a std_msgs/Empty has no data")
            return b"", EMPTY
        case STRING.schema_name:
            if not isinstance(data, str):
                raise ValueError("the data of a std_msgs/String is a text")
            return String(data).encode(), STRING
    encoding, _, name = line.type.partition(";")
    if encoding == "json":
        return msgspec.json.encode(data), PayloadType("json", name, JSON.schema_encoding, JSON.schema_data)
    if not isinstance(data, str):
        raise ValueError(f"the data of a {line.type} is its payload in base64")
    try:
        return base64.b64decode(data, validate=True), payload_type(line.type)
    except binascii.Error as error:
        raise ValueError(f"the data is not base64: {error}") from None
