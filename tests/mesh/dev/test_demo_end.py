"""How a demo ends; it leaves nothing behind except the files that it keeps on request."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import time
from typing import TYPE_CHECKING, Any

import pytest

from mesh.dev.demo import Demo
from mesh.errors import ConfigurationError, InputError, RemoteError
from mesh.recording import open_objective
from schemas import Empty, String, cid_of_file
from tests.support.commands import AIRA, environment
from tests.support.dev.recorder import Recorder
from tests.support.objectives import objective
from tests.support.raising import raises_with
from tests.support.waiting import at_most

if TYPE_CHECKING:
    from pathlib import Path


def files_in(folder: Path) -> list[Path]:
    return list(folder.iterdir())


def demo(folder: Path, recorder: Recorder, **options: Any) -> Demo:
    return Demo(folder, **({"objective": None, "generation": 3, "out": None, "narrator": recorder} | options))


async def test_two_demos_in_one_process_do_not_disturb_each_other(tmp_path: Path) -> None:
    runs = {3: Recorder(), 5: Recorder()}
    async with asyncio.timeout(180), asyncio.TaskGroup() as demos:
        for generation, recorder in runs.items():
            folder, out = tmp_path / f"files of {generation}", tmp_path / str(generation)
            folder.mkdir()
            demos.create_task(demo(folder, recorder, generation=generation, out=out).run())
    for generation, recorder in runs.items():
        assert (recorder.facts["generation"], recorder.facts["paid"]) == (generation, True)
        result = recorder.facts["result"]
        assert cid_of_file(tmp_path / str(generation) / f"{result}.mcap") == result


async def test_the_recording_holds_the_objective_and_the_device_messages(tmp_path: Path) -> None:
    path, recorder = tmp_path / "job.mcap", Recorder()
    path.write_bytes(objective(("/colour", String("blue")), ("/blink", Empty()), step_ns=0))
    await demo(tmp_path, recorder, objective=path, out=tmp_path).run()
    assert cid_of_file(tmp_path / f"{recorder.facts['objective']}.mcap") == recorder.facts["objective"]
    recording = open_objective(tmp_path / f"{recorder.facts['result']}.mcap")
    payloads: dict[str, list[bytes]] = {}
    for message in recording.messages():
        payloads.setdefault(message.topic, []).append(message.payload)
    assert payloads.pop("/colour") == [String("blue").encode()]
    assert payloads.pop("/blink") == [b""]
    assert payloads.pop("/led") == [String(text).encode() for text in ("blue on", "blue off", "on", "off")]
    assert payloads == {}


async def test_a_demo_that_is_cancelled_leaves_no_task(tmp_path: Path) -> None:
    recorder = Recorder()
    running = asyncio.create_task(demo(tmp_path, recorder).run())
    while "running" not in recorder.events:
        await asyncio.sleep(0.01)
        assert not running.done()
    running.cancel()
    with at_most(2), pytest.raises(asyncio.CancelledError):
        await running
    assert asyncio.all_tasks() == {asyncio.current_task()}


async def test_a_demo_without_progress_fails(tmp_path: Path) -> None:
    with raises_with(RemoteError, code="demo-stalled"):
        await demo(tmp_path, Recorder(), timeout=0.0).run()


async def test_a_file_that_can_not_be_kept_is_an_error(tmp_path: Path) -> None:
    path, out = tmp_path / "job.mcap", tmp_path / "kept"
    path.write_bytes(objective(("/blink", Empty())))
    taken = out / f"{cid_of_file(path)}.mcap"
    taken.mkdir(parents=True)
    with raises_with(ConfigurationError, code="output-not-writable", match=str(taken)):
        await demo(tmp_path, Recorder(), objective=path, out=out).run()


async def test_an_unfit_objective_ends_it_before_anything_is_opened(tmp_path: Path) -> None:
    recorder = Recorder()
    (tmp_path / "notes.txt").write_text("no recording")
    for path in (tmp_path / "notes.txt", tmp_path / "missing", tmp_path):
        with pytest.raises(InputError):
            await demo(tmp_path, recorder, objective=path).run()
    assert recorder.events == []


@pytest.mark.sample("seconds")
@pytest.mark.parametrize("seconds", [0.0, 0.4, 0.8, 1.3, 1.8])
def test_ctrl_c_leaves_no_process_no_folder_and_no_traceback(seconds: float, tmp_path: Path) -> None:
    pipe, variables = subprocess.PIPE, environment({"TMPDIR": str(tmp_path)})
    command = [*AIRA, "demo"]
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, env=variables, start_new_session=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(seconds)
        process.send_signal(signal.SIGINT)
        with at_most(2):
            _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert errors == b""
    assert files_in(tmp_path) == []
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
