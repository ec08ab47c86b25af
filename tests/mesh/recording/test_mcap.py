from __future__ import annotations

import struct
import tracemalloc
from typing import TYPE_CHECKING, Any

import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Message
from mcap.writer import CompressionType, Writer

from mesh.recording import CorruptRecording, Limits, NotARecording, RecordingError, open_objective
from schemas.payloads import PayloadType
from tests.support.bags import Bag, BagMessage
from tests.support.raising import raises_with
from tests.support.recording.files import (
    CHANNEL,
    MAGIC,
    SCHEMA,
    T0,
    chunk,
    mcap_file,
    message,
    raw_file,
    record,
    text,
    with_messages,
)

if TYPE_CHECKING:
    from pathlib import Path


def kept(directory: Path, content: bytes) -> Path:
    path = directory / "it.mcap"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"enable_data_crcs": True},
        {"use_statistics": False, "use_summary_offsets": False, "repeat_channels": False, "repeat_schemas": False},
    ],
    ids=lambda options: ",".join(options),
)
def test_all_content_of_a_file_is_read(tmp_path: Path, options: dict[str, Any]) -> None:
    times = [T0 + n * 1000 for n in range(500)]
    objective = open_objective(kept(tmp_path, with_messages(times, **options)))
    assert objective.format == "mcap"
    assert objective.count == 500
    assert objective.start_ns == T0
    assert objective.duration_ns == 499_000
    assert [topic.name for topic in objective.topics] == ["/a", "/b"]
    kind = PayloadType("json", "thing", "jsonschema", b'{"type":"object"}')
    played = list(objective.messages())
    for number, one in enumerate(played):
        assert (one.topic, one.payload) == ("/a" if number % 2 == 0 else "/b", b'{"n":%d}' % number)
        assert (one.log_time_ns, one.publish_time_ns) == (times[number], times[number] + 5)
        assert (one.sequence, one.type) == (number, kind)


def test_messages_of_a_file_are_sorted_by_time(tmp_path: Path) -> None:
    times = [T0 + n * 7919 % 1000 for n in range(1000)]
    objective = open_objective(kept(tmp_path, with_messages(times)))
    played = [one.log_time_ns for one in objective.messages()]
    assert played == sorted(times)
    assert objective.start_ns == T0


def test_messages_of_equal_time_keep_the_order_of_the_file(tmp_path: Path) -> None:
    objective = open_objective(kept(tmp_path, with_messages([T0] * 300)))
    assert [one.sequence for one in objective.messages()] == list(range(300))


@pytest.mark.parametrize("disorder", [1, 7919])
@pytest.mark.parametrize("skip", [0, 1, 99, 100, 499, 500, 501])
def test_reading_can_start_at_any_message(tmp_path: Path, skip: int, disorder: int) -> None:
    times = [T0 + n * disorder % 500 for n in range(500)]
    objective = open_objective(kept(tmp_path, with_messages(times)))
    everything = list(objective.messages())
    assert list(objective.messages(from_index=skip)) == everything[skip:]


def test_schema_text_is_never_parsed(tmp_path: Path) -> None:
    hostile = b"import os; os.abort()\n=====\nMSG: \xff\xfe"

    def write(writer: Writer) -> None:
        schema = writer.register_schema("a/B", "ros1msg", hostile)
        writer.add_message(writer.register_channel("/a", "ros1", schema), T0, b"\xff", T0)

    objective = open_objective(kept(tmp_path, mcap_file(write)))
    assert objective.topics[0].type.schema_data == hostile


def test_a_channel_may_have_no_schema(tmp_path: Path) -> None:
    def write(writer: Writer) -> None:
        writer.add_message(writer.register_channel("/a", "json", 0), T0, b"{}", T0)

    objective = open_objective(kept(tmp_path, mcap_file(write)))
    assert objective.topics[0].type == PayloadType("json")


def test_metadata_is_given_by_name(tmp_path: Path) -> None:
    objective = open_objective(kept(tmp_path, mcap_file(lambda writer: writer.add_metadata("aira", {"agent": "0x1"}))))
    assert objective.metadata == {"aira": {"agent": "0x1"}}
    assert objective.count == 0
    assert list(objective.messages()) == []


def test_unknown_records_are_skipped_and_attachments_listed(tmp_path: Path) -> None:
    def write(writer: Writer) -> None:
        writer.add_attachment(T0, T0, "photo", "image/png", bytes(3 << 20))

    assert open_objective(kept(tmp_path, mcap_file(write))).count == 0
    strange = raw_file(record(0x80, b"private"), SCHEMA, CHANNEL, message())
    assert open_objective(kept(tmp_path, strange)).count == 1


def test_a_file_cut_anywhere_is_corrupt(tmp_path: Path) -> None:
    whole = with_messages([T0 + n for n in range(200)])
    for length in range(len(MAGIC) + 5, len(whole), 41):
        with pytest.raises((CorruptRecording, NotARecording)) as caught:
            open_objective(kept(tmp_path, whole[:length]))
        assert caught.value.reason in ("corrupt", "not-a-recording")
    with pytest.raises(CorruptRecording):
        open_objective(kept(tmp_path, whole + b"\0"))


@pytest.mark.parametrize("options", [{}, {"enable_data_crcs": True, "use_chunking": False}], ids=["chunks", "plain"])
def test_a_flipped_bit_in_the_data_fails_its_checksum(tmp_path: Path, options: dict[str, Any]) -> None:
    times = [T0 + n for n in range(50)]
    whole = bytearray(with_messages(times, compression=CompressionType.NONE, **options))
    whole[whole.index(b'{"n":7}') + 5] ^= 1
    with pytest.raises(CorruptRecording) as caught:
        open_objective(kept(tmp_path, bytes(whole)))
    assert "checksum" in caught.value.why


def test_a_flipped_bit_in_the_index_fails_its_checksum(tmp_path: Path) -> None:
    whole = bytearray(with_messages([T0]))
    whole[whole.rindex(b"/b")] ^= 1
    with pytest.raises(CorruptRecording) as caught:
        open_objective(kept(tmp_path, bytes(whole)))
    assert "checksum" in caught.value.why


def test_a_file_over_the_size_limit_is_not_read(tmp_path: Path) -> None:
    with raises_with(RecordingError, code="recording-too-large") as caught:
        open_objective(kept(tmp_path, bytes(1001)), Limits(size=1000))
    assert caught.value.reason == "too-large"


def test_a_small_file_that_expands_too_much_is_refused_without_expanding_it(tmp_path: Path) -> None:
    inner = SCHEMA + CHANNEL + message(bytes(32 << 20))
    bomb = chunk(zstandard.compress(inner), compression="zstd", size=len(inner))
    path = kept(tmp_path, raw_file(*[bomb] * 40))
    assert path.stat().st_size < 100_000
    tracemalloc.start()
    try:
        with raises_with(RecordingError, code="recording-too-large") as caught:
            open_objective(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert caught.value.reason == "expands-too-much"
    assert peak < 1 << 20


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_never_expands_beyond_its_stated_size(tmp_path: Path, compression: str) -> None:
    import lz4.frame  # type: ignore[import-untyped]

    inner = bytes(256 << 20)
    data = zstandard.compress(inner) if compression == "zstd" else bytes(lz4.frame.compress(inner))
    del inner
    path = kept(tmp_path, raw_file(chunk(data, compression=compression, size=1000)))
    tracemalloc.start()
    try:
        with pytest.raises(CorruptRecording):
            open_objective(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 8 << 20


def test_messages_too_far_out_of_order_to_sort_are_refused(tmp_path: Path) -> None:
    path = kept(tmp_path, with_messages([T0 + n * 7919 % 5000 for n in range(5000)]))
    assert open_objective(path).count == 5000
    with raises_with(RecordingError, code="recording-too-large") as caught:
        open_objective(path, Limits(window=100_000))
    assert caught.value.limit == "window"


@pytest.mark.parametrize(
    ("limits", "limit"),
    [
        (Limits(messages=99), "messages"),
        (Limits(channels=1), "channels"),
        (Limits(definitions=40), "definitions"),
        (Limits(record=500), "record"),
        (Limits(expanded=2000), "expanded"),
    ],
)
def test_every_limit_is_enforced(tmp_path: Path, limits: Limits, limit: str) -> None:
    path = kept(tmp_path, with_messages([T0 + n for n in range(100)]))
    assert open_objective(path).count == 100
    with raises_with(RecordingError, code="recording-too-large") as caught:
        open_objective(path, limits)
    assert (caught.value.reason, caught.value.limit) == ("expands-too-much", limit)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (raw_file(message()), "undefined channel 1"),
        (raw_file(CHANNEL), "undefined schema"),
        (raw_file(SCHEMA, record(Opcode.SCHEMA, struct.pack("<H", 1) + text("y") + text("") + text(""))), "number 1"),
        (raw_file(SCHEMA, CHANNEL, record(Opcode.MESSAGE, bytes(21))), "a message of 21 bytes"),
        (raw_file(record(Opcode.SCHEMA, struct.pack("<HI", 1, 1 << 31))), "a field of"),
        (raw_file(record(Opcode.SCHEMA, struct.pack("<H", 1) + struct.pack("<I", 1) + b"\xff" + bytes(8))), "UTF-8"),
        (raw_file(chunk(b"\x05")), "ends within a record"),
        (raw_file(chunk(struct.pack("<BQ", 5, 1 << 60))), "beyond the end of its chunk"),
        (raw_file(chunk(b"?", compression="rar")), "unknown compression"),
        (raw_file(chunk(SCHEMA, inner=b"other")), "checksum of a chunk"),
        (raw_file(chunk(SCHEMA, size=len(SCHEMA) + 1)), "states a size"),
        (raw_file(record(Opcode.CHUNK, bytes(39))), "a field of"),
        (raw_file(struct.pack("<BQ", Opcode.MESSAGE, 1 << 63)), "beyond the end of the file"),
        (MAGIC + record(Opcode.FOOTER, bytes(20)) + MAGIC, "has no end"),
        (MAGIC + record(Opcode.DATA_END, b"") + record(Opcode.FOOTER, bytes(20)) + MAGIC, "a field of"),
        (
            MAGIC + record(Opcode.DATA_END, bytes(4)) + record(Opcode.FOOTER, b"\xff" * 20) + MAGIC,
            "a checksum is wrong",
        ),
    ],
)
def test_malformed_records_are_corrupt(tmp_path: Path, content: bytes, why: str) -> None:
    with pytest.raises(CorruptRecording) as caught:
        open_objective(kept(tmp_path, content))
    assert why in caught.value.why
    assert caught.value.reason == "corrupt"
    assert caught.value.hint


def test_a_file_changed_after_opening_is_corrupt(tmp_path: Path) -> None:
    path = kept(tmp_path, with_messages([T0 + n for n in range(20_000)]))  # more than Python reads at once
    objective = open_objective(path)
    messages = objective.messages()
    next(messages)
    path.write_bytes(path.read_bytes()[:1500])
    with pytest.raises(CorruptRecording):
        list(messages)


def test_a_message_record_is_read_as_the_package_writes_it() -> None:
    builder = RecordBuilder()
    Message(channel_id=1, log_time=T0, data=b"{}", publish_time=T0, sequence=0).write(builder)
    assert builder.end() == message(b"{}")  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("content", [with_messages([T0] * 500), Bag([BagMessage("/a", b"", T0)] * 500).encode()])
def test_progress_is_reported_in_bytes_of_the_file(tmp_path: Path, content: bytes) -> None:
    reported: list[tuple[int, int | None]] = []
    open_objective(kept(tmp_path, content), progress=lambda done, total: reported.append((done, total)))
    assert len(reported) > 3
    assert reported == sorted(reported)
    assert {total for _, total in reported} == {len(content)}
    assert reported[-1][0] == len(content)
