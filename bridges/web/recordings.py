"""Recordings for the page: what they hold, their messages, numbers to plot, images. Everything here blocks: use a
thread. What is in a recording comes from strangers; it is returned as data, and never as HTML."""

from __future__ import annotations

import base64
import math
from collections import Counter
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.recording import GENEROUS, numbers_of, open_objective

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.recording import Objective, Played

MOST_MESSAGES: Final = 500
"""Messages in one answer."""
MOST_POINTS: Final = 4000
MOST_COLUMNS: Final = 32
MOST_TOPICS: Final = 512
LONGEST_VALUE: Final = 4096
"""Bytes of a message's JSON that are returned."""
MOST_NUMBERS: Final = 1_000_000
"""Messages of a topic that are read for a plot."""
_MAGIC: Final = (
    (b"\x89PNG\r\n\x1a\n", "image/png"),
    (b"\xff\xd8\xff", "image/jpeg"),
    (b"GIF87a", "image/gif"),
    (b"GIF89a", "image/gif"),
    (b"BM", "image/bmp"),
)
_COMPRESSED_IMAGE: Final = "sensor_msgs/CompressedImage"


def summary(path: Path, cid: str) -> dict[str, Any]:
    """What a file holds; a file that is no recording has no topics. Raises `CorruptRecording` and others."""
    recording = open_objective(path, GENEROUS)
    counts: Counter[tuple[str, str]] = Counter()
    shown: dict[tuple[str, str], str] = {}
    for message in recording.messages():
        topic = message.topic, _role(message)
        counts[topic] += 1
        if shown.get(topic, "none") == "none":
            shown[topic] = _how_shown(message)
    kinds: dict[str, list[str]] = {}
    for one in recording.topics:
        kinds.setdefault(one.name, []).append(one.type.zenoh_encoding)
    return {
        "cid": cid,
        "format": recording.format,
        "size": recording.size,
        "messages": recording.count,
        "startNs": str(recording.start_ns),
        "durationNs": str(recording.duration_ns),
        "topics": [
            {"topic": name, "role": role, "messages": count, "types": kinds[name], "shown": shown[name, role]}
            for (name, role), count in islice(counts.items(), MOST_TOPICS)
        ],
        "metadata": recording.metadata,
        "attachments": [
            {"name": one.name, "mediaType": one.media_type, "size": one.size} for one in recording.attachments
        ],
    }


def messages(path: Path, cid: str, *, topic: str, after: int, limit: int) -> dict[str, Any]:
    """Up to `limit` messages behind the one with the number `after` (-1: from the first)."""
    recording = open_objective(path, GENEROUS)
    found: list[dict[str, Any]] = []
    more = None
    for number, message in _of_topic(recording, topic, after + 1):
        if len(found) == min(limit, MOST_MESSAGES):
            more = found[-1]["number"] if found else after
            break
        found.append(_facts(message, number, recording.start_ns, cid))
    return {"messages": found, "next": more}


def values(path: Path, topic: str) -> dict[str, Any]:
    """The numbers of a topic as columns, at most `MOST_POINTS` of each, evenly taken."""
    recording = open_objective(path, GENEROUS)
    count = sum(1 for _ in _of_topic(recording, topic, 0))
    step = max(1, math.ceil(min(count, MOST_NUMBERS) / MOST_POINTS))
    at: list[float] = []
    columns: dict[str, list[float | None]] = {}
    for place, (_, message) in enumerate(islice(_of_topic(recording, topic, 0), MOST_NUMBERS)):
        if place % step:
            continue
        at.append((message.log_time_ns - recording.start_ns) / 1e9)
        for name, number in numbers_of(message):
            name = name.removeprefix(".")
            if name in columns or len(columns) < MOST_COLUMNS:
                column = columns.setdefault(name, [])
                column += [None] * (len(at) - 1 - len(column))
                column.append(number)
    listed = [{"name": name, "values": column + [None] * (len(at) - len(column))} for name, column in columns.items()]
    return {"topic": topic, "messages": count, "points": len(at), "at": at, "columns": listed}


def image(path: Path, number: int) -> tuple[bytes, str] | None:
    """The image in the message of that number, and its media type."""
    message = next(open_objective(path, GENEROUS).messages(from_index=number), None)
    return None if message is None else _image(message)


def _of_topic(recording: Objective, topic: str, first: int) -> Iterator[tuple[int, Played]]:
    """The messages from a number on, those of a topic or all."""
    numbered = enumerate(recording.messages(from_index=first), first)
    return ((number, message) for number, message in numbered if not topic or message.topic == topic)


def _facts(message: Played, number: int, start_ns: int, cid: str) -> dict[str, Any]:
    value, is_cut = message.value, False
    if isinstance(value, bytes):
        is_cut = len(value) > LONGEST_VALUE
        value = base64.b64encode(value[:LONGEST_VALUE]).decode()
    elif len(encoded := msgspec.json.encode(value)) > LONGEST_VALUE:
        value, is_cut = encoded[:LONGEST_VALUE].decode(errors="ignore"), True
    return {
        "number": number,
        "topic": message.topic,
        "role": _role(message),
        "type": message.type.zenoh_encoding,
        "at": (message.log_time_ns - start_ns) / 1e9,
        "size": len(message.payload),
        "value": value,
        "cut": is_cut,
        "image": f"/api/v1/files/{cid}/images/{number}" if _image(message) else None,
    }


def _role(message: Played) -> str:
    return message.role or "objective"


def _how_shown(message: Played) -> str:
    """How the messages of a topic are shown: `values`, `image`, `text`, `bytes` or `none`."""
    if _image(message):
        return "image"
    value = message.value
    if value is None:
        return "none"
    if isinstance(value, bytes):
        return "bytes"
    return "values" if next(numbers_of(message), None) else "text"


def _image(message: Played) -> tuple[bytes, str] | None:
    """The image in a message: its payload, or that of a ROS 1 compressed image. Never SVG, which may hold scripts."""
    data = message.payload
    if message.type.encoding == "ros1" and message.type.schema_name == _COMPRESSED_IMAGE:
        data = _third_field(data)
    elif message.type.encoding in ("json", "ros1", "cdr", "protobuf"):
        return None
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return data, "image/webp"
    return next(((data, kind) for magic, kind in _MAGIC if data.startswith(magic)), None)


def _third_field(payload: bytes) -> bytes:
    """The data of a sensor_msgs/CompressedImage: behind a header (12 bytes and a text), and the text of its format."""
    at = 12
    for _ in range(2):
        at += 4 + int.from_bytes(payload[at : at + 4], "little")
    length = int.from_bytes(payload[at : at + 4], "little")
    data = payload[at + 4 : at + 4 + length]
    return data if len(data) == length else b""
