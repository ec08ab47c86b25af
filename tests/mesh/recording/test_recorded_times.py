"""The times in a recording, on a machine whose clock is set forth and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mcap.reader import make_reader

from mesh.recording import Recorder, RecordingAbout, open_objective
from schemas.payloads import RAW
from tests.support.clocks import HOUR, NOON, SECOND, SetClock

if TYPE_CHECKING:
    from pathlib import Path

ABOUT: Final = RecordingAbout(liability="0x1")


def times_in(path: Path) -> list[int]:
    """The log times as another program reads them, in file order."""
    with path.open("rb") as file:
        return [message.log_time for _, _, message in make_reader(file).iter_messages(log_time_order=False)]


def test_times_begin_at_the_time_of_day(tmp_path: Path) -> None:
    clock = SetClock()
    with Recorder(tmp_path / "it.mcap", ABOUT, clock=clock) as recorder:
        clock.pass_by(7)
        recorder.record("/a", b"", RAW)
    assert times_in(recorder.path) == [NOON + 7]
    assert open_objective(recorder.path).metadata["aira-clock"] == {"unix_ns": str(NOON), "log_ns": str(NOON)}


def test_a_clock_that_is_set_back_or_forth_moves_no_time(tmp_path: Path) -> None:
    clock = SetClock()
    with Recorder(tmp_path / "it.mcap", ABOUT, clock=clock) as recorder:
        for jump in (0, -HOUR, 24 * HOUR):
            clock.pass_by(SECOND)
            clock.unix_ns += jump
            recorder.record("/a", b"", RAW)
    assert times_in(recorder.path) == [NOON + SECOND, NOON + 2 * SECOND, NOON + 3 * SECOND]


def test_a_clock_that_is_set_back_during_a_crash_moves_no_time_back(tmp_path: Path) -> None:
    path = tmp_path / "it.mcap"
    for start in (NOON, NOON - HOUR, NOON + HOUR):
        clock = SetClock(start)
        with Recorder(path, ABOUT, clock=clock) as recorder:
            clock.pass_by(SECOND)
            recorder.record("/a", b"", RAW)
        path.rename(f"{path}.part")
    Recorder(path, ABOUT, clock=clock).close()
    assert times_in(path) == [NOON + SECOND, NOON + 2 * SECOND, NOON + HOUR + SECOND]
    said = open_objective(path).metadata["aira-clock"]
    assert said["unix_ns"] == f"{NOON},{NOON - HOUR},{NOON + HOUR},{NOON + HOUR + SECOND}"
    assert said["log_ns"] == f"{NOON},{NOON + SECOND},{NOON + HOUR},{NOON + HOUR + SECOND}"
