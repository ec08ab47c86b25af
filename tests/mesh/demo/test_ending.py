"""How a demo ends, and what it leaves behind: nothing but what it was told to keep."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import time
from typing import TYPE_CHECKING, Any

import pytest

from mesh.demo.demo import Demo
from mesh.demo.story import JsonStory
from mesh.errors import ConfigurationError, InputError, RemoteError
from mesh.recording import open_objective
from schemas import Empty, String, cid_of_file
from tests.support.commands import AIRA, environment
from tests.support.objectives import objective
from tests.support.waiting import at_most

if TYPE_CHECKING:
    from pathlib import Path


class Heard(JsonStory):
    """A story kept in memory."""

    def __init__(self) -> None:
        self.events: list[str] = []
        self.summed: dict[str, Any] = {}

    def tell(self, who: str, event: str, words: str, **facts: Any) -> None:
        self.events.append(event)

    def end(self, **facts: Any) -> None:
        self.summed = facts


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which demos of this process put their temporary ones."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def files_in(folder: Path) -> list[Path]:
    return list(folder.iterdir())


def demo(story: Heard, *, objective: Path | None = None, generation: int = 3, out: Path | None = None) -> Demo:
    return Demo(objective=objective, generation=generation, out=out, story=story)


async def test_two_demos_in_one_process_do_not_disturb_each_other(scene: Path, tmp_path: Path) -> None:
    stories = {3: Heard(), 5: Heard()}
    async with asyncio.timeout(60), asyncio.TaskGroup() as demos:
        for generation, story in stories.items():
            demos.create_task(demo(story, generation=generation, out=tmp_path / str(generation)).run())
    for generation, story in stories.items():
        assert (story.summed["generation"], story.summed["paid"]) == (generation, True)
        result = story.summed["result"]
        assert cid_of_file(tmp_path / str(generation) / f"{result}.mcap") == result
    assert files_in(scene) == []


async def test_the_recording_holds_the_objective_and_what_the_device_said(scene: Path, tmp_path: Path) -> None:
    path, story = tmp_path / "job.mcap", Heard()
    path.write_bytes(objective(("/colour", String("blue")), ("/blink", Empty()), step_ns=0))
    await demo(story, objective=path, out=tmp_path).run()
    assert cid_of_file(tmp_path / f"{story.summed['objective']}.mcap") == story.summed["objective"]
    recording = open_objective(tmp_path / f"{story.summed['result']}.mcap")
    heard: dict[str, list[bytes]] = {}
    for message in recording.messages():
        heard.setdefault(message.topic, []).append(message.payload)
    assert heard.pop("/colour") == [String("blue").encode()]
    assert heard.pop("/blink") == [b""]
    assert heard.pop("/led") == [String(text).encode() for text in ("blue on", "blue off", "on", "off")]
    assert heard == {}


async def test_a_demo_that_is_cancelled_leaves_nothing(scene: Path) -> None:
    story = Heard()
    running = asyncio.create_task(demo(story).run())
    while "running" not in story.events:
        await asyncio.sleep(0.01)
        assert not running.done()
    running.cancel()
    with at_most(2), pytest.raises(asyncio.CancelledError):
        await running
    assert files_in(scene) == []
    assert asyncio.all_tasks() == {asyncio.current_task()}


async def test_a_demo_that_stands_still_says_so(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mesh.demo.demo.PATIENCE", 0.0)
    with pytest.raises(RemoteError, match=r"^the demo stands still$") as error:
        await demo(Heard()).run()
    assert "try again" in error.value.hint
    assert files_in(scene) == []


async def test_what_can_not_be_kept_at_the_end_is_one_clear_line(scene: Path, tmp_path: Path) -> None:
    path, out = tmp_path / "job.mcap", tmp_path / "kept"
    path.write_bytes(objective(("/blink", Empty())))
    taken = out / f"{cid_of_file(path)}.mcap"
    taken.mkdir(parents=True)
    with pytest.raises(ConfigurationError, match=f"^can't keep {taken}: Is a directory$"):
        await demo(Heard(), objective=path, out=out).run()


async def test_an_unfit_objective_ends_it_before_anything_is_opened(scene: Path, tmp_path: Path) -> None:
    story = Heard()
    (tmp_path / "notes.txt").write_text("no recording")
    for path in (tmp_path / "notes.txt", tmp_path / "missing", tmp_path):
        with pytest.raises(InputError):
            await demo(story, objective=path).run()
    assert (story.events, files_in(scene)) == ([], [])


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
