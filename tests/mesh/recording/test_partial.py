"""Recordings cut off by a crash: continuing them, and recovering their readable part."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from mcap.reader import make_reader

from mesh.errors import InputError
from mesh.recording import (
    CorruptRecording,
    NotARecording,
    Recorder,
    RecordingAbout,
    open_objective,
    recover,
)
from schemas.payloads import RAW
from tests.support.raising import raises_with
from tests.support.recording.files import T0, mcap_file, with_messages

if TYPE_CHECKING:
    from mcap.writer import Writer

ROOT = Path(__file__).parents[3]
ABOUT = RecordingAbout(liability="0x1")
KILLED = """
import sys, time
from pathlib import Path
from mesh.recording import Recorder, RecordingAbout
from tests.support.raising import raises_with
from mesh.errors import InputError
from schemas.payloads import RAW
recorder = Recorder(Path(sys.argv[1]), RecordingAbout(liability="0x1"))
for number in range(10_000):
    recorder.record("/a", b"%d" % number, RAW)
    print(number, flush=True)
    time.sleep(0.01)
"""


def test_a_kill_costs_about_a_second_and_the_next_recorder_continues(tmp_path: Path) -> None:
    path = tmp_path / "it.mcap"
    with subprocess.Popen([sys.executable, "-c", KILLED, str(path)], cwd=ROOT, stdout=subprocess.PIPE) as killed:
        assert killed.stdout is not None
        for line in killed.stdout:
            if int(line) == 250:
                break
        killed.send_signal(signal.SIGKILL)
        recorded = 250 + len(killed.stdout.readlines())
    assert not path.exists()
    with Recorder(path, ABOUT) as recorder:
        recorder.record("/a", b"after", RAW)
        summary = recorder.close()
    assert recorded - 130 <= summary.recovered <= recorded + 1
    assert summary.messages == summary.recovered + 1
    objective = open_objective(path)
    said = [one.payload for one in objective.messages()]
    assert said == [b"%d" % number for number in range(summary.recovered)] + [b"after"]
    assert [one.sequence for one in objective.messages()] == list(range(summary.messages))
    assert objective.metadata["aira-recovered"]["messages"] == str(summary.recovered)
    assert os.listdir(tmp_path) == ["it.mcap"]


@pytest.mark.parametrize("left", [b"", b"\x89MCAP0\r\n"])
def test_a_recorder_continues_after_a_kill_before_the_first_write(tmp_path: Path, left: bytes) -> None:
    (tmp_path / "it.mcap.part").write_bytes(left)
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        recorder.record("/a", b"x", RAW)
    assert open_objective(tmp_path / "it.mcap").count == 1
    assert os.listdir(tmp_path) == ["it.mcap"]


def test_a_kill_while_copying_an_interrupted_recording_loses_nothing(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        for number in range(100):
            recorder.record("/a", b"%d" % number, RAW)
    (tmp_path / "it.mcap").rename(tmp_path / "it.mcap.cut")
    (tmp_path / "it.mcap.part").write_bytes((tmp_path / "it.mcap.cut").read_bytes()[:200])
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        assert recorder.close().recovered == 100
    assert open_objective(tmp_path / "it.mcap").metadata["aira-recovered"]["seams"] == "100"
    assert os.listdir(tmp_path) == ["it.mcap"]


def test_the_copy_has_its_name_on_the_disk_before_the_original_is_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the deletion is there before anything is recorded: else the copy would be taken for an unfinished one."""
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        recorder.record("/a", b"1", RAW)
    (tmp_path / "it.mcap").rename(tmp_path / "it.mcap.part")
    order, fsync, unlink = list[str](), os.fsync, Path.unlink

    def noted_fsync(descriptor: int) -> None:
        fsync(descriptor)
        order.append("sync " + Path(os.readlink(f"/proc/self/fd/{descriptor}")).name)

    def noted_unlink(path: Path, *, missing_ok: bool = False) -> None:
        unlink(path, missing_ok=missing_ok)
        order.append("delete " + path.name)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(Path, "unlink", noted_unlink)
    with Recorder(tmp_path / "it.mcap", ABOUT):
        assert order == ["sync it.mcap.part", folder := f"sync {tmp_path.name}", "delete it.mcap.cut", folder]


def test_every_seam_of_a_continued_recording_is_in_its_metadata(tmp_path: Path) -> None:
    for number in range(3):
        with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
            recorder.record("/a", b"%d" % number, RAW)
        (tmp_path / "it.mcap").rename(tmp_path / "it.mcap.part")
    Recorder(tmp_path / "it.mcap", ABOUT).close()
    assert open_objective(tmp_path / "it.mcap").metadata["aira-recovered"]["seams"] == "1,2,3"


ZSTD = b"\x28\xb5\x2f\xfd"
TIMES = [T0 + n * 7919 % 500 for n in range(500)]


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}], ids=["chunks", "plain"])
def test_the_readable_beginning_of_a_cut_file_is_recovered(tmp_path: Path, options: dict[str, Any]) -> None:
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


def test_recovered_content_is_unchanged(tmp_path: Path) -> None:
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


def test_recovery_stops_at_a_damaged_chunk(tmp_path: Path) -> None:
    whole = bytearray(with_messages(TIMES, chunk_size=2000))
    second = whole.index(ZSTD, whole.index(ZSTD) + 1)
    whole[second + 30] ^= 1
    (tmp_path / "it.mcap").write_bytes(whole)
    recovered = recover(tmp_path / "it.mcap", tmp_path / "saved.mcap")
    assert 0 < recovered.messages < 500
    assert open_objective(tmp_path / "saved.mcap").count == recovered.messages


def test_a_complete_file_is_recovered_completely(tmp_path: Path) -> None:
    (tmp_path / "it.mcap").write_bytes(with_messages(TIMES))
    recovered = recover(tmp_path / "it.mcap")
    assert (recovered.messages, recovered.why) == (500, "")


def test_recovery_never_overwrites_a_file(tmp_path: Path) -> None:
    (tmp_path / "it.mcap.part").write_bytes(with_messages(TIMES)[:500])
    (tmp_path / "it.mcap").write_bytes(b"precious")
    with raises_with(InputError, code="recording-exists"):
        recover(tmp_path / "it.mcap.part")
    assert (tmp_path / "it.mcap").read_bytes() == b"precious"


@pytest.mark.parametrize("content", [b"", b"no recording at all"])
def test_recovery_refuses_a_file_that_is_not_mcap(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "it.mcap.part").write_bytes(content)
    with pytest.raises(NotARecording):
        recover(tmp_path / "it.mcap.part")
    assert [path.name for path in tmp_path.iterdir()] == ["it.mcap.part"]


def with_attachment(writer: Writer) -> None:
    writer.add_attachment(T0, T0 + 1, "map.png", "image/png", bytes(range(256)) * 1000)
    writer.add_message(writer.register_channel("/a", "json", 0), T0, b"{}", T0)
    writer.flush()  # type: ignore[no-untyped-call]


def test_attachments_are_recovered(tmp_path: Path) -> None:
    (tmp_path / "it.mcap").write_bytes(mcap_file(with_attachment)[:-60])
    recovered = recover(tmp_path / "it.mcap")
    assert recovered.messages == 1
    with recovered.path.open("rb") as file:
        (kept,) = make_reader(file, validate_crcs=True).iter_attachments()
    assert (kept.name, kept.media_type, kept.create_time, kept.log_time) == ("map.png", "image/png", T0, T0 + 1)
    assert kept.data == bytes(range(256)) * 1000
    (attachment,) = open_objective(recovered.path).attachments
    assert (attachment.name, attachment.size) == ("map.png", 256_000)


def test_a_damaged_attachment_is_corrupt(tmp_path: Path) -> None:
    whole = bytearray(mcap_file(with_attachment))
    whole[whole.index(b"image/png") + 1000] ^= 1
    (tmp_path / "it.mcap").write_bytes(whole)
    with pytest.raises(CorruptRecording) as caught:
        open_objective(tmp_path / "it.mcap")
    assert "checksum" in caught.value.why
