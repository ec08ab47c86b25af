from __future__ import annotations

import fcntl
import os
import resource
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from mesh.errors import ClosedError, InputError
from mesh.recording import (
    Recorder,
    RecorderSettings,
    RecordingAbout,
    RecordingFailed,
    Unrecordable,
    open_objective,
)
from schemas.payloads import EMPTY, JSON, RAW, STRING, PayloadType, String
from tests.support.raising import raises_with
from tests.support.recording.files import T0

ROOT = Path(__file__).parents[3]
SELDOM = RecorderSettings(sync_seconds=3600)
ABOUT = RecordingAbout(liability="0x1", agent="0x2", lighthouse="a.eth", objective="Qm", software="aira 1")


def read_by_the_package(path: Path) -> list[tuple[Any, Any, Any]]:
    """What another program reads, with checksums verified."""
    with path.open("rb") as file:
        return list(make_reader(file, validate_crcs=True).iter_messages())


def test_a_recording_has_its_messages_and_its_job(tmp_path: Path) -> None:
    path = tmp_path / "new" / "it.mcap"
    with Recorder(path, ABOUT) as recorder:
        recorder.record("/blink", String("blue").encode(), STRING, role="objective", log_time_ns=T0)
        recorder.record("/led", b"", EMPTY, log_time_ns=T0 + 1, publish_time_ns=T0 - 5)
        recorder.record("/led", b"", EMPTY, log_time_ns=T0 + 2)
        summary = recorder.close()
    assert (summary.path, summary.messages, summary.lost, summary.recovered) == (path, 3, 0, 0)
    assert summary.size == path.stat().st_size
    assert os.listdir(path.parent) == ["it.mcap"]
    objective = open_objective(path)
    assert objective.metadata["aira"] == {
        "liability": "0x1",
        "agent": "0x2",
        "lighthouse": "a.eth",
        "objective": "Qm",
        "software": "aira 1",
        "topics": "",
    }
    assert objective.metadata["aira-closed"] == {"messages": "3", "lost": "0"}
    played = list(objective.messages())
    assert [(one.topic, one.payload, one.type) for one in played] == [
        ("/blink", String("blue").encode(), STRING),
        ("/led", b"", EMPTY),
        ("/led", b"", EMPTY),
    ]
    assert [(one.log_time_ns, one.publish_time_ns, one.sequence) for one in played] == [
        (T0, T0, 0),
        (T0 + 1, T0 - 5, 0),
        (T0 + 2, T0 + 2, 1),
    ]


def test_every_channel_has_schema_times_and_role(tmp_path: Path) -> None:
    path = tmp_path / "it.mcap"
    with Recorder(path, ABOUT) as recorder:
        for kind in (EMPTY, STRING, JSON, RAW, PayloadType("ros1", "my/Type", "ros1msg"), PayloadType("json", "Led")):
            recorder.record("/a", b"{}", kind, role="objective")
            recorder.record("/a", b"{}", kind)
    found = read_by_the_package(path)
    described = [
        (channel.message_encoding, *((schema.name, schema.encoding, schema.data) if schema else ("", "", b"")))
        for schema, channel, _ in found
    ]
    assert described[1::2] == [  # what a device says is described by what it says
        ("json", name or "a", "jsonschema", b'{"properties":{},"type":"object"}') if encoding == "json" else kind
        for kind in described[::2]
        for encoding, name, *_ in [kind]
    ]
    assert described[::2] == [
        ("ros1", "std_msgs/Empty", "ros1msg", b""),
        ("ros1", "std_msgs/String", "ros1msg", b"string data\n"),
        ("json", "", "jsonschema", JSON.schema_data),
        ("application/octet-stream", "", "", b""),
        ("ros1", "my/Type", "", b""),
        ("json", "Led", "jsonschema", JSON.schema_data),
    ]
    assert [channel.metadata["role"] for _, channel, _ in found] == ["objective", "device"] * 6
    assert all(message.log_time == message.publish_time > T0 for _, _, message in found)
    assert len({channel.id for _, channel, _ in found}) == 12


@pytest.mark.parametrize(
    "bad",
    [
        {"payload": "text"},
        {"payload": bytearray(b"x")},
        {"log_time_ns": -1},
        {"log_time_ns": 1 << 64},
        {"log_time_ns": 1.5},
        {"publish_time_ns": -1},
        {"topic": ""},
        {"topic": "/\udcff"},
    ],
)
def test_unrecordable_messages_are_refused(tmp_path: Path, bad: dict[str, Any]) -> None:
    good: dict[str, Any] = {"topic": "/a", "payload": b"x", "type": RAW, "log_time_ns": T0}
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        recorder.record(**good)
        with pytest.raises(Unrecordable):
            recorder.record(**(good | bad))
        recorder.record(**good)
        assert recorder.close().messages == 2
    assert len(read_by_the_package(tmp_path / "it.mcap")) == 2


def test_messages_of_an_unrecordable_type_are_dropped_and_counted(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        recorder.record("/a", b"1", RAW)
        recorder.record("/a", b"2", PayloadType("\udcff"))
        recorder.record("/a", b"3", RAW)
        summary = recorder.close()
    assert (summary.messages, summary.lost) == (2, 1)
    assert open_objective(summary.path).metadata["aira-closed"]["lost"] == "1"


def test_messages_beyond_the_queue_are_dropped_and_counted(tmp_path: Path) -> None:
    settings = RecorderSettings(queue_bytes=10_000)
    with Recorder(tmp_path / "it.mcap", ABOUT, settings=settings) as recorder:
        recorder.record("/a", bytes(20_000), RAW)
        assert recorder.lost == 1
        for _ in range(5000):
            recorder.record("/a", bytes(1000), RAW)
        summary = recorder.close()
    assert summary.messages + summary.lost == 5001
    assert summary.messages > 0
    assert summary.lost == recorder.lost


def test_the_queue_accepts_more_once_some_is_written(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT, settings=RecorderSettings(queue_bytes=20_000)) as recorder:
        taken, end = 0, time.monotonic() + 30
        while taken < 20 and time.monotonic() < end:
            before = recorder.lost
            recorder.record("/a", bytes(10_000), RAW)
            taken += recorder.lost == before
        assert recorder.close().messages == taken == 20


def test_many_threads_record_at_once(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:

        def talk(topic: str) -> None:
            for number in range(2000):
                recorder.record(topic, b"%d" % number, RAW)

        threads = [threading.Thread(target=talk, args=(f"/{n}",)) for n in range(5)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    objective = open_objective(tmp_path / "it.mcap")
    assert objective.count == 10_000
    for n in range(5):
        said = [(one.payload, one.sequence) for one in objective.messages() if one.topic == f"/{n}"]
        assert said == [(b"%d" % number, number) for number in range(2000)]


def test_nothing_is_recorded_after_close(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "it.mcap", ABOUT)
    first = recorder.close()
    assert recorder.close() == first
    with pytest.raises(ClosedError):
        recorder.record("/a", b"", RAW)


def test_a_finished_recording_is_never_overwritten(tmp_path: Path) -> None:
    Recorder(tmp_path / "it.mcap", ABOUT).close()
    before = (tmp_path / "it.mcap").read_bytes()
    with raises_with(InputError, code="recording-exists"):
        Recorder(tmp_path / "it.mcap", ABOUT)
    assert (tmp_path / "it.mcap").read_bytes() == before


def test_a_recording_in_progress_elsewhere_is_refused(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        recorder.record("/a", b"mine", RAW)
        with raises_with(InputError, code="recording-exists"):
            Recorder(tmp_path / "it.mcap", ABOUT)
    assert open_objective(tmp_path / "it.mcap").count == 1


def test_a_file_that_can_not_be_created_fails_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RecordingFailed):
        Recorder(tmp_path / "file" / "it.mcap", ABOUT)


def test_a_full_disk_fails_the_recording_and_keeps_what_was_written(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    recorder = Recorder(tmp_path / "it.mcap", ABOUT)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, hard))
    try:
        with pytest.raises(RecordingFailed):
            record_for_ever(recorder)
        with pytest.raises(RecordingFailed) as caught:
            recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert caught.value.hint
    assert not recorder.path.exists()
    with Recorder(tmp_path / "it.mcap", ABOUT) as again:
        assert again.close().recovered > 50


def record_for_ever(recorder: Recorder) -> None:
    while True:
        recorder.record("/a", os.urandom(10_000), RAW)


def test_closing_a_recording_releases_its_lock(tmp_path: Path) -> None:
    Recorder(tmp_path / "it.mcap", ABOUT).close()
    with (tmp_path / "it.mcap").open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_recording_does_not_block_the_caller(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        took = []
        for _ in range(2000):
            begin = time.perf_counter()
            recorder.record("/a", bytes(100), RAW)
            took.append(time.perf_counter() - begin)
    assert sorted(took)[1000] < 0.0005
