"""When the recorder syncs a recording to the disk."""

from __future__ import annotations

import errno
import os
import threading
from typing import TYPE_CHECKING

import pytest
from mcap.reader import NonSeekingReader

from mesh.recording import Recorder, RecorderSettings, RecordingAbout, RecordingFailed
from schemas.payloads import RAW
from tests.support.waiting import SECONDS, wait_until

if TYPE_CHECKING:
    from pathlib import Path

SELDOM = RecorderSettings(sync_seconds=3600)
ABOUT = RecordingAbout(liability="0x1", agent="0x2", lighthouse="a.eth", objective="Qm", software="aira 1")


class CountedSyncs:
    """Counts the syncs of this process, and lets them pass once `released`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count = 0
        self.released = threading.Event()
        self.released.set()
        self._fsync = os.fsync
        monkeypatch.setattr(os, "fsync", self._sync)

    def _sync(self, descriptor: int) -> None:
        assert self.released.wait(SECONDS)
        self._fsync(descriptor)
        self.count += 1


@pytest.fixture
def syncs(monkeypatch: pytest.MonkeyPatch) -> CountedSyncs:
    return CountedSyncs(monkeypatch)


def test_messages_are_synced_in_time_without_further_messages(tmp_path: Path, syncs: CountedSyncs) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT, settings=RecorderSettings(sync_seconds=0.05)) as recorder:
        before = syncs.count
        recorder.record("/a", b"soon", RAW)
        wait_until(lambda: syncs.count > before)
        assert messages_in_the_prefix(tmp_path / "it.mcap.part") == 1


def test_a_sync_has_all_messages_that_were_recorded_before(tmp_path: Path, syncs: CountedSyncs) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT, settings=SELDOM) as recorder:
        for number in range(1, 4):
            recorder.record("/a", b"x", RAW)
            before = syncs.count
            assert recorder.sync().result(SECONDS) == number
            assert messages_in_the_prefix(tmp_path / "it.mcap.part") == number
            assert syncs.count == before + (2 if number == 1 else 1), "the first time also its name"


def test_many_who_ask_meanwhile_cost_one_sync(tmp_path: Path, syncs: CountedSyncs) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT, settings=SELDOM) as recorder:
        before = syncs.count
        syncs.released.clear()
        asked = []
        for _ in range(200):
            recorder.record("/a", b"x", RAW)
            asked.append(recorder.sync())
        syncs.released.set()
        assert [one.result(SECONDS) for one in asked[-1:]] == [200]
        assert all(1 <= one.result(SECONDS) <= 200 for one in asked)
        assert syncs.count - before <= 3


def test_a_cancelled_sync_does_not_disturb_the_others(tmp_path: Path, syncs: CountedSyncs) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT, settings=SELDOM) as recorder:
        recorder.record("/a", b"x", RAW)
        syncs.released.clear()
        first, second = recorder.sync(), recorder.sync()
        first.cancel()
        syncs.released.set()
        assert second.result(SECONDS) == 1


def test_a_finished_recording_is_synced(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        recorder.record("/a", b"x", RAW)
    assert recorder.sync().result(SECONDS) == 1


def test_a_disk_that_fails_fails_the_sync(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(descriptor: int) -> None:
        raise OSError(errno.EIO, "broken")

    recorder = Recorder(tmp_path / "it.mcap", ABOUT, settings=SELDOM)
    recorder.record("/a", b"x", RAW)
    monkeypatch.setattr(os, "fsync", fail)
    for _ in ("while it fails", "afterwards"):
        with pytest.raises(RecordingFailed):
            recorder.sync().result(SECONDS)
    with pytest.raises(RecordingFailed):
        recorder.close()


def messages_in_the_prefix(path: Path) -> int:
    count = 0
    with path.open("rb") as file:
        try:
            for _ in NonSeekingReader(file).iter_messages(log_time_order=False):
                count += 1
        except Exception:
            return count
    return count
