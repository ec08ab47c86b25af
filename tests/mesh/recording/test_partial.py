from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mesh.recording import Recorder, RecordingAbout, open_objective
from schemas.payloads import RAW

ROOT = Path(__file__).parents[3]
ABOUT = RecordingAbout(liability="0x1")

KILLED = """
import sys, time
from pathlib import Path
from mesh.recording import Recorder, RecordingAbout
from schemas.payloads import RAW
recorder = Recorder(Path(sys.argv[1]), RecordingAbout(liability="0x1"))
for number in range(10_000):
    recorder.record("/a", b"%d" % number, RAW)
    print(number, flush=True)
    time.sleep(0.01)
"""


def test_a_kill_costs_no_more_than_about_a_second_and_the_next_recorder_goes_on(tmp_path: Path) -> None:
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
def test_a_kill_before_anything_was_written_costs_nothing_more(tmp_path: Path, left: bytes) -> None:
    (tmp_path / "it.mcap.part").write_bytes(left)
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        recorder.record("/a", b"x", RAW)
    assert open_objective(tmp_path / "it.mcap").count == 1
    assert os.listdir(tmp_path) == ["it.mcap"]


def test_a_kill_while_an_interrupted_recording_is_copied_loses_nothing(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        for number in range(100):
            recorder.record("/a", b"%d" % number, RAW)
    (tmp_path / "it.mcap").rename(tmp_path / "it.mcap.cut")
    (tmp_path / "it.mcap.part").write_bytes((tmp_path / "it.mcap.cut").read_bytes()[:200])
    with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
        assert recorder.close().recovered == 100
    assert open_objective(tmp_path / "it.mcap").metadata["aira-recovered"]["seams"] == "100"
    assert os.listdir(tmp_path) == ["it.mcap"]


def test_every_place_where_a_recording_was_gone_on_with_is_told(tmp_path: Path) -> None:
    for number in range(3):
        with Recorder(tmp_path / "it.mcap", ABOUT) as recorder:
            recorder.record("/a", b"%d" % number, RAW)
        (tmp_path / "it.mcap").rename(tmp_path / "it.mcap.part")
    Recorder(tmp_path / "it.mcap", ABOUT).close()
    assert open_objective(tmp_path / "it.mcap").metadata["aira-recovered"]["seams"] == "1,2,3"
