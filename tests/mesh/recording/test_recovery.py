"""What is recovered of files in which any byte is wrong, a part is missing, or a compressed chunk is cut."""

from __future__ import annotations

import random
from struct import Struct
from typing import TYPE_CHECKING, Any, Final

import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer

from mesh.recording import CorruptRecording, NotARecording, open_objective, recover
from mesh.recording._bag_reader import BagOp, bag_records
from mesh.recording._mcap import mcap_records
from mesh.recording._recovery import readable_part
from tests.mesh.recording.test_damaged import write_bag

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

_U32: Final = Struct("<I")
CHUNKS: Final = [["one", "two"], ["three"], ["four", "five"]]
TEXTS: Final = [text for chunk in CHUNKS for text in chunk]
FORMATS: Final = ["mcap-none", "mcap-lz4", "mcap-zstd", "bag-none", "bag-lz4", "bag-bz2"]


def write_mcap(path: Path, chunks: Iterable[Iterable[str]], *, compression: str = "none", **options: Any) -> None:
    """Write an MCAP file with a std_msgs/String on /said for each text of each chunk, a metadata record after each."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType[compression.upper()], chunk_size=1 << 30, **options)
        writer.start()
        schema = writer.register_schema("std_msgs/String", "ros1msg", b"string data")
        channel = writer.register_channel("/said", "ros1", schema)
        time = 0
        for number, texts in enumerate(chunks):
            for text in texts:
                time += 1
                writer.add_message(channel, time, _U32.pack(len(text)) + text.encode(), time)
            writer.flush()  # type: ignore[no-untyped-call]
            writer.add_metadata(f"chunk{number}", {"number": str(number)})
        writer.finish()  # type: ignore[no-untyped-call]


def write(path: Path, name: str, chunks: list[list[str]] = CHUNKS) -> bytes:
    """Write a file in one of the `FORMATS`."""
    kind, compression = name.split("-")
    writers: dict[str, Callable[..., None]] = {"mcap": write_mcap, "bag": write_bag}
    writers[kind](path, chunks, compression=compression)
    return path.read_bytes()


def recovered(path: Path, content: bytes | bytearray) -> tuple[list[str], str]:
    """The texts that are readable in a file of that content, and what is said to be missing."""
    path.write_bytes(content)
    source, why = readable_part(path)
    return [message.payload[4:].decode(errors="replace") for message in source.in_file_order()], why


@pytest.mark.sample("mask")
@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("mask", [0x01, 0x80, 0xFF])
def test_no_wrong_byte_makes_messages_disappear_unsaid(tmp_path: Path, name: str, mask: int) -> None:
    content = write(tmp_path / "whole", name)
    padding = content.find(b" " * 100)
    for position in range(len(content)):
        if padding <= position < padding + 3800:
            continue
        damaged = bytearray(content)
        damaged[position] ^= mask
        try:
            found, why = recovered(tmp_path / "damaged", damaged)
        except NotARecording:
            assert position < 13
            continue
        assert why or len(found) == len(TEXTS), position
        if name not in ("bag-none", "bag-lz4"):  # without any checksum, a wrong byte in a text can't be noticed
            assert set(found) <= set(TEXTS), position


@pytest.mark.parametrize("name", FORMATS)
def test_what_follows_a_record_of_a_wrong_length_is_recovered(tmp_path: Path, name: str) -> None:
    """Where the index says that the next chunk begins."""
    content = write(tmp_path / "whole", name)
    for begin, _ in chunks_of(tmp_path / "whole")[:-1]:
        damaged = bytearray(content)
        damaged[begin + (1 if name.startswith("mcap") else 0)] ^= 0x40
        found, why = recovered(tmp_path / "damaged", damaged)
        assert found[-2:] == ["four", "five"]
        assert why


@pytest.mark.parametrize("name", FORMATS)
def test_a_chunk_that_was_taken_out_is_missed(tmp_path: Path, name: str) -> None:
    content = write(tmp_path / "whole", name)
    for number, (begin, end) in enumerate(chunks_of(tmp_path / "whole")):
        found, why = recovered(tmp_path / "damaged", content[:begin] + content[end:])
        assert found == [text for other, chunk in enumerate(CHUNKS) if other != number for text in chunk]
        assert "missing" in why


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"use_statistics": False}, "1 of its 3 chunks"),
        ({"use_statistics": False, "index_types": IndexType.NONE}, "can't be known"),
        ({"use_statistics": False, "index_types": IndexType.NONE, "enable_data_crcs": True}, "checksum of the data"),
    ],
)
def test_what_can_be_known_of_missing_chunks_is_said(tmp_path: Path, options: dict[str, Any], why: str) -> None:
    write_mcap(tmp_path / "whole", CHUNKS, **options)
    content = (tmp_path / "whole").read_bytes()
    assert recovered(tmp_path / "copy", content)[0] == TEXTS
    begin, end = chunks_of(tmp_path / "whole")[1]
    assert why in recovered(tmp_path / "damaged", content[:begin] + content[end:])[1]


@pytest.mark.parametrize(("taken", "what"), [(Opcode.METADATA, "metadata records"), (Opcode.ATTACHMENT, "attachments")])
def test_other_records_that_were_taken_out_are_missed(tmp_path: Path, taken: Opcode, what: str) -> None:
    path = tmp_path / "whole"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_attachment(1, 1, "map.png", "image/png", b"image")
        writer.add_metadata("robot", {"color": "red"})
        writer.finish()  # type: ignore[no-untyped-call]
    content = path.read_bytes()
    assert recovered(path, content) == ([], "")
    with path.open("rb") as file:
        record = next(one for one in mcap_records(file, len(content)) if one.opcode == taken)
    left = content[: record.offset - 9] + content[record.offset + record.length :]
    assert recovered(tmp_path / "damaged", left)[1] == f"1 of its 1 {what} are missing"


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_messages_stay_readable_when_the_chunk_with_their_channel_is_damaged(tmp_path: Path, kind: str) -> None:
    """The channel is in the index, too."""
    content = bytearray(write(tmp_path / "whole", f"{kind}-lz4"))
    begin, end = chunks_of(tmp_path / "whole")[0]
    content[content.index(b"\x04\x22\x4d\x18", begin, end)] ^= 0xFF
    assert recovered(tmp_path / "damaged", bytes(content))[0] == ["three", "four", "five"]


@pytest.mark.parametrize("name", ["mcap-zstd", "mcap-lz4", "bag-lz4", "bag-bz2"])
@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_the_beginning_of_a_compressed_chunk_that_is_cut_is_recovered(tmp_path: Path, name: str, share: float) -> None:
    """A decompressor returns whole blocks: the largest have 900 kB (bz2)."""
    random.seed(1)
    texts = [random.randbytes(2000).hex() for _ in range(1000)]
    content = write(tmp_path / "whole", name, [texts])
    (begin, end), *_ = chunks_of(tmp_path / "whole")
    found, why = recovered(tmp_path / "cut", content[: begin + int(share * (end - begin))])
    assert found == texts[: len(found)]
    block = 900_000 if name == "bag-bz2" else 300_000
    assert share * 1000 - block / 4000 <= len(found) <= share * 1000
    assert why
    done = recover(tmp_path / "cut", tmp_path / "out.mcap")
    assert done.messages == len(found)


@pytest.mark.parametrize("name", ["mcap-zstd", "mcap-lz4", "bag-lz4", "bag-bz2"])
def test_the_beginning_of_a_compressed_chunk_with_a_fault_is_recovered(tmp_path: Path, name: str) -> None:
    random.seed(1)
    texts = [random.randbytes(2000).hex() for _ in range(1000)]
    content = bytearray(write(tmp_path / "whole", name, [texts, ["behind"]]))
    (begin, end), *_ = chunks_of(tmp_path / "whole")
    middle = (begin + end) // 2
    content[middle : middle + 2000] = bytes(2000)
    found, why = recovered(tmp_path / "damaged", bytes(content))
    assert found[-1] == "behind"
    assert why
    assert found[:-1] == texts[: len(found) - 1]


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """Where the chunks of a file begin and end; in MCAP with the index of each."""
    content = path.read_bytes()
    found: list[tuple[int, int]] = []
    with path.open("rb") as file:
        if content.startswith(b"#ROSBAG"):
            records = bag_records(file, len(content))
            return [(one.begin, one.offset + one.length) for one in records if one.opcode == BagOp.CHUNK]
        for one in mcap_records(file, len(content)):
            end = one.offset + one.length
            if one.opcode == Opcode.CHUNK:
                found.append((one.offset - 9, end))
            elif one.opcode == Opcode.MESSAGE_INDEX:
                found[-1] = found[-1][0], end
    return found


def test_what_follows_the_end_of_a_file_is_named(tmp_path: Path) -> None:
    content = write(tmp_path / "whole", "mcap-zstd")
    assert recovered(tmp_path / "first", content) == (TEXTS, "")
    for rest in (b"\n", bytes(4096), content[:-8], content):
        found, why = recovered(tmp_path / "first", content + rest)
        assert found == TEXTS
        assert f"{len(rest)} bytes that follow its end" in why
        with pytest.raises(CorruptRecording, match=f"ends at byte {len(content)}, and {len(rest)} bytes follow"):
            open_objective(tmp_path / "first")
