"""Our writer's files are those of the package's own writer, to every reader and to the last field."""

from __future__ import annotations

import io
import random
import struct
from dataclasses import asdict
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, Writer

from mesh.recording.mcap_writer import McapWriter

Row = tuple[int, int, bytes, int, int]
CHUNK = 4096


def ours(rows: list[Row], *, channels: int, finish: bool = True) -> bytes:
    stream = io.BytesIO()
    writer = McapWriter(stream, chunk_size=CHUNK)
    writer.start("test")
    prepare(writer, channels)
    for number, row in enumerate(rows):
        writer.add_message(*row)
        if number == 10:
            writer.add_metadata("note", {"key": "value"})
            writer.add_attachment(3, 4, "name", "text/plain", b"attached")
    if finish:
        writer.finish()
    else:
        writer.flush()
    return stream.getvalue()


def theirs(rows: list[Row], *, channels: int) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=CHUNK, compression=CompressionType.ZSTD)
    writer.start("test", library="aira-mesh")
    prepare(writer, channels)
    for number, (channel, log_time, data, publish_time, sequence) in enumerate(rows):
        writer.add_message(channel, log_time, data, publish_time, sequence)
        if number == 10:
            writer.add_metadata("note", {"key": "value"})
            writer.add_attachment(3, 4, "name", "text/plain", b"attached")
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def prepare(writer: Any, channels: int) -> None:
    schema = writer.register_schema("Pose", "jsonschema", b'{"type":"object"}')
    for number in range(channels):
        assert writer.register_channel(f"/topic/{number}", "json", schema, {"role": "device"}) == number + 1


def rows_of(count: int, channels: int, seed: int = 1) -> list[Row]:
    chance = random.Random(seed)
    times = [10**18 + chance.randrange(10**9) for _ in range(count)]
    return [
        (chance.randint(1, channels), time, chance.randbytes(chance.randint(0, 300)), time + 5, number)
        for number, time in enumerate(times)
    ]


def content_of(data: bytes) -> dict[str, Any]:
    """All that the package's readers find in a file."""
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    summary = reader.get_summary()
    assert summary is not None
    plain = NonSeekingReader(io.BytesIO(data), validate_crcs=True)
    return {
        "header": reader.get_header(),
        "statistics": asdict(summary.statistics) if summary.statistics else None,
        "schemas": summary.schemas,
        "channels": summary.channels,
        "chunks": [
            (index.message_start_time, index.message_end_time, index.uncompressed_size, index.compression)
            for index in summary.chunk_indexes
        ],
        "by time": [message for _, _, message in reader.iter_messages()],
        "in order": [message for _, _, message in plain.iter_messages(log_time_order=False)],
        "of one topic": [message for _, _, message in reader.iter_messages(topics=["/topic/0"])],
        "metadata": list(reader.iter_metadata()),
        "attachments": list(reader.iter_attachments()),
    }


@pytest.mark.parametrize(("count", "channels"), [(0, 1), (1, 1), (11, 2), (1000, 1), (1000, 40), (3000, 3)])
def test_a_file_is_that_of_the_packages_own_writer(count: int, channels: int) -> None:
    rows = rows_of(count, channels)
    assert content_of(ours(rows, channels=channels)) == content_of(theirs(rows, channels=channels))


def test_the_index_leads_to_each_message_of_a_window() -> None:
    rows = rows_of(2000, 5)
    reader = make_reader(io.BytesIO(ours(rows, channels=5)), validate_crcs=True)
    start, end = 10**18 + 2 * 10**8, 10**18 + 3 * 10**8
    found = [message.sequence for _, _, message in reader.iter_messages(starting_at=start, ending_before=end)]
    due = sorted((row for row in rows if start <= row[1] < end), key=lambda row: row[1])
    assert found == [row[4] for row in due]


def test_what_was_flushed_is_readable_without_an_end() -> None:
    rows = rows_of(100, 2)
    messages = NonSeekingReader(io.BytesIO(ours(rows, channels=2, finish=False))).iter_messages(log_time_order=False)
    found = [next(messages)[2].sequence for _ in rows]
    assert found == [row[4] for row in rows]


@pytest.mark.parametrize("row", [(1, -1, b"", 0, 0), (1, 0, b"", 1 << 64, 0), (1 << 16, 0, b"", 0, 0), (1, 0, 5, 0, 0)])
def test_a_message_that_no_record_can_hold_leaves_no_trace(row: Any) -> None:
    stream = io.BytesIO()
    writer = McapWriter(stream, chunk_size=CHUNK)
    writer.start("")
    prepare(writer, 1)
    writer.add_message(1, 1, b"before", 1, 0)
    with pytest.raises((struct.error, TypeError)):
        writer.add_message(*row)
    writer.add_message(1, 2, b"after", 2, 1)
    writer.finish()
    reader = make_reader(io.BytesIO(stream.getvalue()), validate_crcs=True)
    assert [message.data for _, _, message in reader.iter_messages()] == [b"before", b"after"]


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2**64 - 1), st.binary(max_size=2 * CHUNK)), max_size=20))
def test_any_times_and_payloads_are_read_as_written(messages: list[tuple[int, bytes]]) -> None:
    rows = [(1, time, data, time, number) for number, (time, data) in enumerate(messages)]
    data = ours(rows, channels=1)
    plain = NonSeekingReader(io.BytesIO(data), validate_crcs=True).iter_messages(log_time_order=False)
    assert [(message.log_time, message.data) for _, _, message in plain] == messages
