from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import pytest

from mesh.recording import CorruptRecording, Limits, NotARecording, RecordingError, open_objective
from schemas.payloads import STRING, PayloadType
from tests.support.bags import MAGIC, Bag, BagMessage, Compression, record, string
from tests.support.raising import raises_with
from tests.support.recording.files import SECOND, T0

if TYPE_CHECKING:
    from pathlib import Path

MESSAGES = [BagMessage("/blink" if n % 3 else "/other", string(f"message {n}"), T0 + n * SECOND) for n in range(250)]


def kept(directory: Path, content: bytes) -> Path:
    path = directory / "it.bag"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_all_content_of_a_bag_is_read(tmp_path: Path, compression: Compression, indexed: bool) -> None:
    objective = open_objective(kept(tmp_path, Bag(MESSAGES, compression, indexed=indexed).encode()))
    assert objective.format == "bag"
    assert objective.count == 250
    assert (objective.start_ns, objective.duration_ns) == (T0, 249 * SECOND)
    assert {topic.name for topic in objective.topics} == {"/blink", "/other"}
    assert {topic.type for topic in objective.topics} == {STRING}
    played = [(one.topic, one.payload, one.log_time_ns, one.publish_time_ns) for one in objective.messages()]
    assert played == [(one.topic, one.payload, one.time_ns, one.time_ns) for one in MESSAGES]


def test_messages_of_a_bag_are_sorted_by_time(tmp_path: Path) -> None:
    shuffled = [MESSAGES[n * 97 % 250] for n in range(250)]
    objective = open_objective(kept(tmp_path, Bag(shuffled, per_chunk=20).encode()))
    assert [one.log_time_ns for one in objective.messages()] == [one.time_ns for one in MESSAGES]


def test_messages_outside_chunks_are_read_too(tmp_path: Path) -> None:
    loose = record({"op": b"\x02", "conn": struct.pack("<I", 0), "time": struct.pack("<II", 5, 6)}, string("loose"))
    bag = Bag(MESSAGES[:1], indexed=False).encode() + loose
    first, *_ = open_objective(kept(tmp_path, bag)).messages()
    assert (first.payload, first.log_time_ns) == (string("loose"), 5 * SECOND + 6)


def test_the_payload_type_comes_from_the_connection(tmp_path: Path) -> None:
    sent = BagMessage("/scan", b"\0", T0, type="sensor_msgs/LaserScan", md5sum="90c7", definition="float32 angle\n\xff")
    (topic,) = open_objective(kept(tmp_path, Bag([sent]).encode())).topics
    assert topic.type == PayloadType("ros1", "sensor_msgs/LaserScan", "ros1msg", "float32 angle\n\xff".encode())


@pytest.mark.parametrize("indexed", [True, False])
def test_a_bag_cut_within_a_record_is_corrupt(tmp_path: Path, indexed: bool) -> None:
    whole = Bag(MESSAGES, indexed=indexed).encode()
    for length in range(len(MAGIC) + 1, len(whole) - 1, 997):
        with pytest.raises(CorruptRecording):
            open_objective(kept(tmp_path, whole[:length]))


def test_a_closed_bag_without_an_index_is_corrupt_and_an_unclosed_one_is_not(tmp_path: Path) -> None:
    closed, unclosed = (Bag(MESSAGES, per_chunk=250, indexed=indexed).encode() for indexed in (True, False))
    with pytest.raises(CorruptRecording) as caught:
        open_objective(kept(tmp_path, closed[: len(unclosed) - 200]))
    assert "before its index" in caught.value.why
    assert open_objective(kept(tmp_path, unclosed)).count == 250


def test_an_encrypted_bag_is_not_a_recording(tmp_path: Path) -> None:
    header = {"op": b"\x03", "index_pos": bytes(8), "encryptor": b"rosbag/AesCbcEncryptor"}
    with pytest.raises(NotARecording) as caught:
        open_objective(kept(tmp_path, MAGIC + record(header, b"")))
    assert "encrypted" in caught.value.why


BAG = record({"op": b"\x03", "index_pos": bytes(8)}, b"")


def message(connection: int) -> bytes:
    return record({"op": b"\x02", "conn": struct.pack("<I", connection), "time": bytes(8)}, b"")


def chunk(data: bytes, *, compression: bytes = b"none", size: int | None = None) -> bytes:
    stated = len(data) if size is None else size
    return record({"op": b"\x05", "compression": compression, "size": struct.pack("<I", stated)}, data)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (message(0), "first record"),
        (record({"op": b"\x03"}, b""), "a field of 8 bytes"),
        (BAG + message(0), "undefined channel 0"),
        (BAG + chunk(message(0)), "undefined channel 0"),
        (BAG + chunk(BAG), "something else"),
        (BAG + chunk(b"\0"), "cut off"),
        (BAG + chunk(struct.pack("<I", 0xFFFFFFFF)), "cut off"),
        (BAG + chunk(b"", size=1), "states a size"),
        (BAG + chunk(b"?", compression=b"bz2"), "can't be decompressed"),
        (BAG + chunk(b"?", compression=b"rar"), "unknown compression"),
        (BAG + record({"op": b"\x09"}, b""), "opcode 9"),
        (BAG + record({}, b""), "opcode -1"),
        (BAG + struct.pack("<I", 0xFFFFFFFF), "a record header of"),
        (BAG + struct.pack("<II", 5, 1) + b"x" + bytes(4), "no name"),
        (BAG + record({"op": b"\x07", "conn": bytes(4), "topic": b"/a"}, b""), "without topic or type"),
        (BAG + record({"op": b"\x07", "topic": b"/a"}, b""), "without its field conn"),
    ],
)
def test_malformed_records_are_corrupt(tmp_path: Path, content: bytes, why: str) -> None:
    with pytest.raises(CorruptRecording) as caught:
        open_objective(kept(tmp_path, MAGIC + content))
    assert why in caught.value.why


@pytest.mark.parametrize(
    ("limits", "limit"),
    [
        (Limits(messages=249), "messages"),
        (Limits(channels=1), "channels"),
        (Limits(definitions=80), "definitions"),
        (Limits(record=500), "record"),
        (Limits(expanded=10_000), "expanded"),
    ],
)
def test_every_limit_is_enforced(tmp_path: Path, limits: Limits, limit: str) -> None:
    with raises_with(RecordingError, code="recording-too-large") as caught:
        open_objective(kept(tmp_path, Bag(MESSAGES, "bz2").encode()), limits)
    assert caught.value.limit == limit
