from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from mcap.reader import make_reader

from mesh.recording import CorruptRecording, NotARecording, RecordingExists, open_objective, recover
from tests.mesh.recording.files import T0, mcap_file, with_messages

if TYPE_CHECKING:
    from pathlib import Path

    from mcap.writer import Writer

ZSTD = b"\x28\xb5\x2f\xfd"
TIMES = [T0 + n * 7919 % 500 for n in range(500)]


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}], ids=["chunks", "plain"])
def test_the_readable_beginning_of_a_cut_file_becomes_a_whole_one(tmp_path: Path, options: dict[str, Any]) -> None:
    whole = with_messages(TIMES, **options)
    found = []
    for length in range(400, len(whole), 611):
        cut = tmp_path / f"{length}.mcap.part"
        cut.write_bytes(whole[:length])
        recovered = recover(cut)
        assert recovered.path == tmp_path / f"{length}.mcap"
        assert recovered.why or recovered.messages == 500
        objective = open_objective(recovered.path)
        assert objective.count == recovered.messages
        numbers = sorted(one.sequence for one in objective.messages())
        assert numbers == list(range(recovered.messages))
        assert objective.metadata["aira-recovered"] == {"messages": str(recovered.messages), "why": recovered.why}
        assert cut.read_bytes() == whole[:length]
        found.append(recovered.messages)
    assert found == sorted(found)
    assert found[0] < 20
    assert found[-1] > 490


def test_what_is_recovered_is_as_it_was(tmp_path: Path) -> None:
    def write(writer: Writer) -> None:
        writer.add_metadata("aira", {"liability": "0x1"})
        schema = writer.register_schema("thing", "jsonschema", b'{"type":"object"}')
        channel = writer.register_channel("/a", "json", schema, {"color": "red"})
        writer.add_message(channel, T0, b"{}", T0 + 1, 77)
        writer.flush()  # type: ignore[no-untyped-call]

    (tmp_path / "it.mcap").write_bytes(mcap_file(write)[:-40])
    recovered = recover(tmp_path / "it.mcap")
    assert recovered.path == tmp_path / "it.recovered.mcap"
    with recovered.path.open("rb") as file:
        ((schema, channel, message),) = make_reader(file, validate_crcs=True).iter_messages()
    assert schema is not None
    assert (schema.name, schema.encoding, schema.data) == ("thing", "jsonschema", b'{"type":"object"}')
    assert (channel.topic, channel.message_encoding, channel.metadata) == ("/a", "json", {"color": "red"})
    assert (message.log_time, message.publish_time, message.sequence, message.data) == (T0, T0 + 1, 77, b"{}")
    assert open_objective(recovered.path).metadata["aira"] == {"liability": "0x1"}


def test_reading_stops_at_a_rotten_chunk(tmp_path: Path) -> None:
    whole = bytearray(with_messages(TIMES, chunk_size=2000))
    second = whole.index(ZSTD, whole.index(ZSTD) + 1)
    whole[second + 30] ^= 1
    (tmp_path / "it.mcap").write_bytes(whole)
    recovered = recover(tmp_path / "it.mcap", tmp_path / "saved.mcap")
    assert 0 < recovered.messages < 500
    assert open_objective(tmp_path / "saved.mcap").count == recovered.messages


def test_a_whole_file_is_recovered_whole(tmp_path: Path) -> None:
    (tmp_path / "it.mcap").write_bytes(with_messages(TIMES))
    recovered = recover(tmp_path / "it.mcap")
    assert (recovered.messages, recovered.why) == (500, "")


def test_nothing_is_written_over(tmp_path: Path) -> None:
    (tmp_path / "it.mcap.part").write_bytes(with_messages(TIMES)[:500])
    (tmp_path / "it.mcap").write_bytes(b"precious")
    with pytest.raises(RecordingExists):
        recover(tmp_path / "it.mcap.part")
    assert (tmp_path / "it.mcap").read_bytes() == b"precious"


@pytest.mark.parametrize("content", [b"", b"no recording at all"])
def test_from_what_is_no_mcap_file_nothing_is_made(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "it.mcap.part").write_bytes(content)
    with pytest.raises(NotARecording):
        recover(tmp_path / "it.mcap.part")
    assert [path.name for path in tmp_path.iterdir()] == ["it.mcap.part"]


def with_attachment(writer: Writer) -> None:
    writer.add_attachment(T0, T0 + 1, "map.png", "image/png", bytes(range(256)) * 1000)
    writer.add_message(writer.register_channel("/a", "json", 0), T0, b"{}", T0)
    writer.flush()  # type: ignore[no-untyped-call]


def test_attachments_are_kept(tmp_path: Path) -> None:
    (tmp_path / "it.mcap").write_bytes(mcap_file(with_attachment)[:-60])
    recovered = recover(tmp_path / "it.mcap")
    assert recovered.messages == 1
    with recovered.path.open("rb") as file:
        (kept,) = make_reader(file, validate_crcs=True).iter_attachments()
    assert (kept.name, kept.media_type, kept.create_time, kept.log_time) == ("map.png", "image/png", T0, T0 + 1)
    assert kept.data == bytes(range(256)) * 1000
    (attachment,) = open_objective(recovered.path).attachments
    assert (attachment.name, attachment.size) == ("map.png", 256_000)


def test_a_rotten_attachment_is_found_out(tmp_path: Path) -> None:
    whole = bytearray(mcap_file(with_attachment))
    whole[whole.index(b"image/png") + 1000] ^= 1
    (tmp_path / "it.mcap").write_bytes(whole)
    with pytest.raises(CorruptRecording, match="checksum"):
        open_objective(tmp_path / "it.mcap")
