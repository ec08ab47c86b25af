"""How a demo ends; it leaves nothing behind except the files that it keeps on request."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import time
from typing import TYPE_CHECKING, Any

import pytest

from mesh.demo.demo import Demo, DemoStalled, OutputNotWritable
from mesh.errors import InputError
from mesh.recording import open_objective
from schemas import Empty, String, cid_of_file
from tests.mesh.demo.recorder import Recorder
from tests.support.commands import AIRA, environment
from tests.support.objectives import objective
from tests.support.waiting import at_most

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which demos of this process make their temporary folders."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def files_in(folder: Path) -> list[Path]:
    return list(folder.iterdir())


def demo(recorder: Recorder, **options: Any) -> Demo:
    return Demo(**({"objective": None, "generation": 3, "out": None, "narrator": recorder} | options))


async def test_two_demos_in_one_process_do_not_disturb_each_other(temporary: Path, tmp_path: Path) -> None:
    runs = {3: Recorder(), 5: Recorder()}
    async with asyncio.timeout(60), asyncio.TaskGroup() as demos:
        for generation, recorder in runs.items():
            demos.create_task(demo(recorder, generation=generation, out=tmp_path / str(generation)).run())
    for generation, recorder in runs.items():
        assert (recorder.facts["generation"], recorder.facts["paid"]) == (generation, True)
        result = recorder.facts["result"]
        assert cid_of_file(tmp_path / str(generation) / f"{result}.mcap") == result
    assert files_in(temporary) == []


async def test_the_recording_holds_the_objective_and_the_device_messages(temporary: Path, tmp_path: Path) -> None:
    path, recorder = tmp_path / "job.mcap", Recorder()
    path.write_bytes(objective(("/colour", String("blue")), ("/blink", Empty()), step_ns=0))
    await demo(recorder, objective=path, out=tmp_path).run()
    assert cid_of_file(tmp_path / f"{recorder.facts['objective']}.mcap") == recorder.facts["objective"]
    recording = open_objective(tmp_path / f"{recorder.facts['result']}.mcap")
    payloads: dict[str, list[bytes]] = {}
    for message in recording.messages():
        payloads.setdefault(message.topic, []).append(message.payload)
    assert payloads.pop("/colour") == [String("blue").encode()]
    assert payloads.pop("/blink") == [b""]
    assert payloads.pop("/led") == [String(text).encode() for text in ("blue on", "blue off", "on", "off")]
    assert payloads == {}


async def test_a_demo_that_is_cancelled_leaves_nothing(temporary: Path) -> None:
    recorder = Recorder()
    running = asyncio.create_task(demo(recorder).run())
    while "running" not in recorder.events:
        await asyncio.sleep(0.01)
        assert not running.done()
    running.cancel()
    with at_most(2), pytest.raises(asyncio.CancelledError):
        await running
    assert files_in(temporary) == []
    assert asyncio.all_tasks() == {asyncio.current_task()}


async def test_a_demo_without_progress_fails(temporary: Path) -> None:
    with pytest.raises(DemoStalled) as caught:
        await demo(Recorder(), timeout=0.0).run()
    assert caught.value.hint
    assert files_in(temporary) == []


async def test_a_file_that_can_not_be_kept_is_an_error(temporary: Path, tmp_path: Path) -> None:
    path, out = tmp_path / "job.mcap", tmp_path / "kept"
    path.write_bytes(objective(("/blink", Empty())))
    taken = out / f"{cid_of_file(path)}.mcap"
    taken.mkdir(parents=True)
    with pytest.raises(OutputNotWritable) as caught:
        await demo(Recorder(), objective=path, out=out).run()
    assert caught.value.code == "output-not-writable"
    assert str(taken) in str(caught.value)


async def test_an_unfit_objective_ends_it_before_anything_is_opened(temporary: Path, tmp_path: Path) -> None:
    recorder = Recorder()
    (tmp_path / "notes.txt").write_text("no recording")
    for path in (tmp_path / "notes.txt", tmp_path / "missing", tmp_path):
        with pytest.raises(InputError):
            await demo(recorder, objective=path).run()
    assert (recorder.events, files_in(temporary)) == ([], [])


@pytest.mark.parametrize("seconds", [0.2, 0.6, 1.0, 1.5, 2.0])
def test_ctrl_c_leaves_no_process_no_folder_and_no_traceback(seconds: float, tmp_path: Path) -> None:
    pipe, variables = subprocess.PIPE, environment({"TMPDIR": str(tmp_path)})
    command = [*AIRA, "demo"]
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, env=variables, start_new_session=True) as process:
        time.sleep(seconds)
        process.send_signal(signal.SIGINT)
        with at_most(2):
            _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert errors == b""
    assert files_in(tmp_path) == []
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
