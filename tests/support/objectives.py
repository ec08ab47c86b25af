"""Objectives for tests: MCAP files with a few messages."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from mcap.writer import Writer

from schemas.payloads import encode_value

if TYPE_CHECKING:
    from collections.abc import Iterable

MILLISECOND = 10**6
STEP = 20 * MILLISECOND
"""Nanoseconds between two messages, unless they are given times."""


def objective(*messages: tuple[str, object], step_ns: int = STEP) -> bytes:
    """An MCAP file with these messages, a topic and a value each (see `schemas.payloads`), `step_ns` apart."""
    return timed((topic, value, number * step_ns) for number, (topic, value) in enumerate(messages))


def timed(messages: Iterable[tuple[str, object, int]]) -> bytes:
    """An MCAP file with these messages: topic, value, log time in nanoseconds."""
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start("ros1", "a test")
    channels: dict[tuple[str, str], int] = {}
    for number, (topic, value, time_ns) in enumerate(messages):
        payload, kind = encode_value(value)
        if (topic, kind.zenoh_encoding) not in channels:
            schema = writer.register_schema(kind.schema_name or "raw", kind.schema_encoding, kind.schema_data)
            channels[topic, kind.zenoh_encoding] = writer.register_channel(topic, kind.encoding, schema)
        writer.add_message(channels[topic, kind.zenoh_encoding], time_ns, payload, time_ns, number)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()
