"""The statistics of several recorders: added up, and kept when they are closed."""

from __future__ import annotations

import gc
import threading
import weakref
from typing import TYPE_CHECKING

from mesh.recording import Recorders, RecordingAbout
from mesh.recording._recorder import PartialFile
from schemas.payloads import STRING
from tests.support.waiting import SECONDS, wait_until

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

ABOUT = RecordingAbout()


def test_statistics_include_closed_recorders(tmp_path: Path) -> None:
    recorders = Recorders()
    for name, count in (("one", 3), ("two", 4)):
        with recorders.open(tmp_path / f"{name}.mcap", ABOUT) as recorder:
            for _ in range(count):
                recorder.record("/led", b"on", STRING)
    third = recorders.open(tmp_path / "three.mcap", ABOUT)
    third.record("/led", b"on", STRING)
    wait_until(lambda: recorders.statistics().recorded == 8)
    assert recorders.statistics().lost == 0
    assert recorders.statistics().lag == 0
    third.close()
    assert recorders.statistics().recorded == 8
    gone = weakref.ref(third)
    del third, recorder
    gc.collect()
    assert gone() is None, "a closed recorder is not kept"


def test_the_lag_grows_while_the_disk_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held, add = threading.Event(), PartialFile.add

    def slowly(self: PartialFile, messages: list[tuple[object, ...]]) -> object:
        assert held.wait(SECONDS)
        return add(self, messages)  # type: ignore[arg-type]

    monkeypatch.setattr(PartialFile, "add", slowly)
    recorders = Recorders()
    with recorders.open(tmp_path / "one.mcap", ABOUT) as recorder:
        recorder.record("/led", b"on", STRING)
        wait_until(lambda: recorders.statistics().lag > 0.2)
        assert recorders.statistics().recorded == 0
        held.set()
        wait_until(lambda: recorders.statistics().lag == 0)
    assert recorders.statistics().recorded == 1
