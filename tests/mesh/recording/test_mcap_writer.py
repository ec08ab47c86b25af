"""Our writer makes the same files as the package's own, down to the last field."""

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

from mesh.recording import Attachment, Unrecordable
from mesh.recording._mcap import MAX_CHANNELS, McapWriter, WriterChannel
from schemas.payloads import RAW, PayloadType
from tests.support.recording.files import T0

Row = tuple[int, int, bytes, int, int]
CHUNK = 4096
POSE = PayloadType("json", "Pose", "jsonschema", b'{"type":"object"}')


def ours(rows: list[Row], *, channels: int, finish: bool = True) -> bytes:
    stream = io.BytesIO()
    writer = McapWriter(stream, profile="test", chunk_size=CHUNK)
    added = [writer.channel(f"/topic/{number}", POSE, {"role": "device"}) for number in range(channels)]
    assert [channel.id for channel in added] == list(range(1, channels + 1))
    for number, (channel, log_time, data, publish_time, sequence) in enumerate(rows):
        writer.write(added[channel - 1], data, log_time, publish_time, sequence)
        if number == 10:
            writer.add_metadata("note", {"key": "value"})
            writer.add_attachment(Attachment("name", "text/plain", 4, 3, 0, 8), b"attached")
    if finish:
        writer.finish()
    else:
        writer.flush()
    return stream.getvalue()


def theirs(rows: list[Row], *, channels: int) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=CHUNK, compression=CompressionType.ZSTD)
    writer.start("test", library="aira-mesh")
    schema = writer.register_schema(POSE.schema_name, POSE.schema_encoding, POSE.schema_data)
    for number in range(channels):
        writer.register_channel(f"/topic/{number}", "json", schema, {"role": "device"})
    for number, (channel, log_time, data, publish_time, sequence) in enumerate(rows):
        writer.add_message(channel, log_time, data, publish_time, sequence)
        if number == 10:
            writer.add_metadata("note", {"key": "value"})
            writer.add_attachment(3, 4, "name", "text/plain", b"attached")
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def rows_of(count: int, channels: int, seed: int = 1) -> list[Row]:
    chance = random.Random(seed)
    times = [10**18 + chance.randrange(10**9) for _ in range(count)]
    return [
        (chance.randint(1, channels), time, chance.randbytes(chance.randint(0, 300)), time + 5, number)
        for number, time in enumerate(times)
    ]


def content_of(data: bytes) -> dict[str, Any]:
    """Everything that the package's readers find in a file."""
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
def test_a_file_has_the_same_content_as_one_by_the_mcap_package(count: int, channels: int) -> None:
    rows = rows_of(count, channels)
    assert content_of(ours(rows, channels=channels)) == content_of(theirs(rows, channels=channels))


def test_the_index_finds_each_message_of_a_time_window() -> None:
    rows = rows_of(2000, 5)
    reader = make_reader(io.BytesIO(ours(rows, channels=5)), validate_crcs=True)
    start, end = 10**18 + 2 * 10**8, 10**18 + 3 * 10**8
    found = [message.sequence for _, _, message in reader.iter_messages(starting_at=start, ending_before=end)]
    due = sorted((row for row in rows if start <= row[1] < end), key=lambda row: row[1])
    assert found == [row[4] for row in due]


def test_flushed_messages_are_readable_without_an_end() -> None:
    rows = rows_of(100, 2)
    messages = NonSeekingReader(io.BytesIO(ours(rows, channels=2, finish=False))).iter_messages(log_time_order=False)
    found = [next(messages)[2].sequence for _ in rows]
    assert found == [row[4] for row in rows]


@pytest.mark.parametrize(
    ("channel_id", "log_time", "payload", "publish_time"),
    [(1, -1, b"", 0), (1, 0, b"", 1 << 64), (1 << 16, 0, b"", 0), (1, 0, 5, 0)],
)
def test_a_message_that_no_record_can_hold_leaves_no_trace(
    channel_id: int, log_time: int, payload: Any, publish_time: int
) -> None:
    stream = io.BytesIO()
    writer = McapWriter(stream, chunk_size=CHUNK)
    channel = writer.channel("/topic/0", POSE, {})
    writer.write(channel, b"before", 1, 1)
    with pytest.raises((struct.error, TypeError)):
        writer.write(WriterChannel(channel_id), payload, log_time, publish_time)
    writer.write(channel, b"after", 2, 2)
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


GOOD: dict[str, Any] = {
    "topic": "/a",
    "payload": b"x",
    "type": RAW,
    "metadata": {"role": "device"},
    "log_time_ns": T0,
    "publish_time_ns": T0,
}


@pytest.mark.parametrize(
    "bad",
    [
        {"payload": "text"},
        {"log_time_ns": -1},
        {"publish_time_ns": 1 << 64},
        {"topic": "/\udcff"},
        {"type": PayloadType("ros1", "\udcff")},
        {"metadata": {"role": "\udcff"}},
    ],
)
def test_an_unrecordable_message_leaves_the_file_intact(bad: dict[str, Any]) -> None:
    stream = io.BytesIO()
    writer = McapWriter(stream)
    writer.add(**GOOD)
    with pytest.raises(Unrecordable):
        writer.add(**(GOOD | bad))
    writer.add(**GOOD)
    with pytest.raises(Unrecordable):
        writer.add_metadata("x", {"y": "\udcff"})
    writer.finish()
    found = list(make_reader(io.BytesIO(stream.getvalue()), validate_crcs=True).iter_messages())
    assert [(channel.topic, message.data) for _, channel, message in found] == [("/a", b"x")] * 2
    assert [message.sequence for _, _, message in found] == [0, 1]


def test_more_channels_than_the_format_can_number_are_refused() -> None:
    writer = McapWriter(io.BytesIO())
    for number in range(MAX_CHANNELS):
        writer.add(**(GOOD | {"topic": f"/{number}"}))
    with pytest.raises(Unrecordable):
        writer.add(**(GOOD | {"topic": "/one-more"}))
    writer.add(**(GOOD | {"topic": "/0"}))
    assert writer.messages == MAX_CHANNELS + 1
