"""Recordings that other programs wrote, or that are damaged: what is read, converted and recovered of them."""

from __future__ import annotations

import bz2
import re
from pathlib import Path
from struct import Struct
from typing import TYPE_CHECKING, Final

import lz4.frame  # type: ignore[import-untyped]
import pytest
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from mesh.errors import InputError
from mesh.recording import convert, open_objective, pack, recover
from mesh.recording._recovery import readable_part
from mesh.recording.objective import Played
from mesh.recording.ros import RosTypes
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from mesh.recording import RecordingFormat

FILES = Path(__file__).parent / "damaged"
_U32: Final = Struct("<I")


def test_records_with_bytes_after_their_fields_are_read(tmp_path: Path) -> None:
    read = open_objective(FILES / "attach_extended.mcap")
    assert (read.count, len(read.attachments)) == (1, 1)
    assert "can't be known" in recover(FILES / "attach_extended.mcap", tmp_path / "out.mcap").why


@pytest.mark.parametrize(
    ("name", "messages", "why"),
    [("bad_chunk_mid", 2, "checksum"), ("chunk_claims_2GiB", 1, "2147483648"), ("data_crc_bad", 1, "checksum")],
)
def test_what_is_whole_is_recovered_and_the_fault_is_named(tmp_path: Path, name: str, messages: int, why: str) -> None:
    done = recover(FILES / f"{name}.mcap", tmp_path / "out.mcap")
    assert done.messages == messages
    assert why in done.why
    assert "times)" not in done.why
    assert open_objective(done.path).count == messages


def test_metadata_are_kept_in_mcap(tmp_path: Path) -> None:
    before = open_objective(FILES / "metadata.mcap").metadata
    convert(FILES / "metadata.mcap", tmp_path / "out.mcap", to="mcap")
    after = open_objective(tmp_path / "out.mcap").metadata
    assert {"robot", "rosbag2"} <= before.keys()
    assert {name: after[name] for name in before} == before


def test_a_bag_begins_at_one_nanosecond_or_later(tmp_path: Path) -> None:
    text = RosTypes("jazzy").message("std_msgs/String", data="go")
    pack([Played("/said", text.data, time, time, 0, text.type) for time in (0, 5)], tmp_path / "in.mcap")
    convert(tmp_path / "in.mcap", tmp_path / "out.bag", to="bag")
    with AnyReader([tmp_path / "out.bag"]) as reader:
        assert [time for _, time, _ in reader.messages()] == [1, 5]


@pytest.mark.parametrize(
    ("to", "end"), [("bag", (1 << 32) * 10**9), ("rosbag2-mcap", 1 << 63), ("rosbag2-sqlite3", 1 << 63)]
)
def test_times_that_a_format_lacks_are_an_error(tmp_path: Path, to: RecordingFormat, end: int) -> None:
    text = RosTypes("jazzy").message("std_msgs/String", data="go")
    pack([Played("/said", text.data, end, end, 0, text.type)], tmp_path / "in.mcap")
    with raises_with(InputError, match=str(end), code="time-out-of-range"):
        convert(tmp_path / "in.mcap", tmp_path / "out", to=to)
    assert {path.name for path in tmp_path.iterdir()} == {"in.mcap"}


@pytest.mark.parametrize("to", ["bag", "rosbag2-mcap", "rosbag2-sqlite3"])
def test_formats_without_metadata_name_what_is_left_out(tmp_path: Path, to: RecordingFormat) -> None:
    convert(FILES / "crlf_def.bag", tmp_path / "in.mcap", to="mcap")
    done = convert(tmp_path / "in.mcap", tmp_path / "out", to=to)
    assert "metadata aira" in done.left_out


@pytest.mark.parametrize("to", ["bag", "rosbag2-sqlite3"])
def test_definitions_with_crlf_are_converted(tmp_path: Path, to: RecordingFormat) -> None:
    assert convert(FILES / "crlf_def.bag", tmp_path / "out.bag", to=to).messages == 4


def test_definitions_in_latin_1_are_converted(tmp_path: Path) -> None:
    content = (FILES / "crlf_def.bag").read_bytes()
    assert b"# c\r\n" in content
    path = tmp_path / "in.bag"
    path.write_bytes(content.replace(b"# c\r\n", b"# \xb0\r\n"))
    assert convert(path, tmp_path / "out.bag", to="bag").messages == 4


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_a_bag_cut_anywhere_keeps_every_whole_message(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "whole.bag"
    texts = [f"message {number}" for number in range(6)]
    write_bag(path, [texts[:4], texts[4:]], compression=compression)
    content = path.read_bytes()
    assert said(recover(path, tmp_path / "all.mcap").path) == texts
    # Messages outside compressed chunks are whole as soon as their last byte is there.
    ends = [content.find(text.encode()) + len(text) for text in texts]
    for cut in (*range(13, 4100, 500), *range(4100, len(content))):
        (tmp_path / "cut.bag").write_bytes(content[:cut])
        source, why = readable_part(tmp_path / "cut.bag")
        found = [message.payload[4:].decode() for message in source.in_file_order()]
        assert found == texts[: len(found)]
        if compression == "none":
            assert len(found) == sum(end <= cut for end in ends), cut
        elif cut > content.rfind(b"chunk_pos="):
            assert found == texts, cut
        assert why or found == texts, cut


@pytest.mark.parametrize("index", [0, 1 << 40])
def test_a_bag_without_an_index_is_recovered(tmp_path: Path, index: int) -> None:
    path = tmp_path / "in.bag"
    write_bag(path, [["one"], ["two"]])
    content = path.read_bytes()
    begin = content.find(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(content[:begin] + index.to_bytes(8, "little") + content[begin + 8 :])
    done = recover(path, tmp_path / "out.mcap")
    assert said(done.path) == ["one", "two"]
    assert done.why


def test_the_bag_of_a_killed_recorder_is_recovered(tmp_path: Path) -> None:
    done = recover(FILES / "cut_in_second_chunk.bag", tmp_path / "out.mcap")
    assert done.messages == 2
    assert "cut off" in done.why


def test_a_bag_goes_on_after_a_damaged_chunk(tmp_path: Path) -> None:
    path = tmp_path / "in.bag"
    write_bag(path, [["one"], ["two"], ["three"]], compression="bz2")
    content = bytearray(path.read_bytes())
    second = [match.start() for match in re.finditer(b"BZh", content)][1]
    content[second + 4 : second + 8] = b"0000"
    path.write_bytes(content)
    done = recover(path, tmp_path / "out.mcap")
    assert said(done.path) == ["one", "three"]
    assert "bz2" in done.why


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_an_mcap_file_cut_anywhere_keeps_every_whole_message(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "whole.mcap"
    texts = [f"message {number}" for number in range(6)]
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression)
        writer.start()
        schema = writer.register_schema("std_msgs/String", "ros1msg", b"string data")
        channel = writer.register_channel("/said", "ros1", schema)
        for number, text in enumerate(texts, 1):
            writer.add_message(channel, number, _U32.pack(len(text)) + text.encode(), number)
        writer.finish()  # type: ignore[no-untyped-call]
    content = path.read_bytes()
    ends = [content.find(text.encode()) + len(text) for text in texts]
    data_end = content.find(b"\x0f" + (4).to_bytes(8, "little"))
    for cut in range(8, len(content)):
        (tmp_path / "cut.mcap").write_bytes(content[:cut])
        source, why = readable_part(tmp_path / "cut.mcap")
        found = [message.payload[4:].decode() for message in source.in_file_order()]
        assert found == texts[: len(found)]
        if compression == CompressionType.NONE:
            assert len(found) == sum(end <= cut for end in ends), cut
        elif cut > data_end:
            assert found == texts, cut
        assert why or found == texts, cut


def said(path: Path) -> list[str]:
    """The texts in a recording of std_msgs/String."""
    return [message.message.payload[4:].decode() for message in open_objective(path).in_file_order()]


def write_bag(path: Path, chunks: list[list[str]], *, compression: str = "none") -> None:
    """Write a closed bag with a std_msgs/String on /said for each text of each chunk, at 1 ns, 2 ns..."""
    compress = {"none": bytes, "bz2": bz2.compress, "lz4": lz4.frame.compress}[compression]
    define = _record(
        {"op": b"\x07", "conn": _U32.pack(0), "topic": b"/said"},
        _fields(
            {
                "topic": b"/said",
                "type": b"std_msgs/String",
                "md5sum": b"992ce8a1687cec8c8bd883ec73ca41d1",
                "message_definition": b"string data\n",
            }
        ),
    )
    time, body, infos, start = 0, b"", b"", 13 + 4096
    for texts in chunks:
        data = b"" if body else define
        for text in texts:
            time += 1
            head = {"op": b"\x02", "conn": _U32.pack(0), "time": _U32.pack(0) + _U32.pack(time)}
            data += _record(head, _U32.pack(len(text)) + text.encode())
        counts = _U32.pack(0) + _U32.pack(len(texts))
        infos += _record({"op": b"\x06", "chunk_pos": (start + len(body)).to_bytes(8, "little")}, counts)
        head = {"op": b"\x05", "compression": compression.encode(), "size": _U32.pack(len(data))}
        body += _record(head, compress(data))
    head = {
        "op": b"\x03",
        "index_pos": (start + len(body)).to_bytes(8, "little"),
        "conn_count": _U32.pack(1),
        "chunk_count": _U32.pack(len(chunks)),
    }
    room = 4096 - 8 - len(_fields(head))
    path.write_bytes(b"#ROSBAG V2.0\n" + _record(head, b" " * room) + body + define + infos)


def _fields(fields: dict[str, bytes]) -> bytes:
    return b"".join(
        _U32.pack(len(name) + 1 + len(value)) + name.encode() + b"=" + value for name, value in fields.items()
    )


def _record(fields: dict[str, bytes], data: bytes) -> bytes:
    head = _fields(fields)
    return _U32.pack(len(head)) + head + _U32.pack(len(data)) + data
