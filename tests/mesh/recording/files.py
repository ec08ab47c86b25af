"""MCAP files as other programs write them, and as nobody should."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from mcap.writer import CompressionType, Writer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

SECOND = 10**9
T0 = 1_535_622_771 * SECOND


def mcap_file(write: Callable[[Writer], None], **options: Any) -> bytes:
    """A file with whatever `write` does to its writer."""
    stream = io.BytesIO()
    writer = Writer(stream, **options)
    writer.start("", "a test")
    write(writer)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def with_messages(
    times: Iterable[int], *, chunk_size: int = 1024, compression: CompressionType = CompressionType.ZSTD, **options: Any
) -> bytes:
    """A file with a JSON message on `/a` and one on `/b` in turn, at each of these times."""

    def write(writer: Writer) -> None:
        schema = writer.register_schema("thing", "jsonschema", b'{"type":"object"}')
        channels = [writer.register_channel(topic, "json", schema, {"color": "red"}) for topic in ("/a", "/b")]
        for number, time in enumerate(times):
            writer.add_message(channels[number % 2], time, b'{"n":%d}' % number, time + 5, number)

    return mcap_file(write, chunk_size=chunk_size, compression=compression, **options)
