"""`aira demo`: its output for people and for programs, the files it keeps, and how it ends on a signal."""

from __future__ import annotations

import asyncio
import json
import signal
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner

from mesh.cli import main
from mesh.dev.demo import COST, MODEL, Demo, write_objective
from mesh.recording import open_objective
from schemas import Empty, String, cid_of_file
from tests.support.bags import Bag, BagMessage, string
from tests.support.commands import SOON, Interrupted, aira
from tests.support.dev.recorder import Recorder
from tests.support.objectives import objective

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result

SUMMARY = {
    "liability",
    "demand",
    "offer",
    "objective",
    "result",
    "success",
    "paid",
    "cost",
    "generation",
    "seconds",
}


def demo(*arguments: str | Path) -> Result:
    """The demo in this process."""
    return CliRunner().invoke(main, ["demo", *map(str, arguments)])


def objects(done: Result) -> list[dict[str, Any]]:
    assert done.exit_code == 0, done.output
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """The folder in which a finished demo kept its files, and the objects that it printed."""
    folder = tmp_path_factory.mktemp("demo") / "deep" / "kept"
    return folder, objects(demo("--json", "--out", folder))


def test_each_line_is_an_object_and_the_last_one_is_the_summary(kept: tuple[Path, list[dict[str, Any]]]) -> None:
    *events, summed = kept[1]
    assert set(summed) == SUMMARY
    assert (summed["success"], summed["paid"], summed["cost"], summed["generation"]) == (True, True, COST, 3)
    assert 0 < summed["seconds"] < 60
    names = [event["event"] for event in events]
    phases = ["liability", "ready", "running", "complete", "finalized"]
    assert [name for name in names if name in phases] == phases
    assert names.count("played") == 3
    assert [event["state"] for event in events if event["event"] == "led"] == ["on", "off"] * 3
    balances = {event["who"]: event["after"] - event["before"] for event in events if event["event"] == "balance"}
    assert balances["robot"] == COST
    assert balances["person"] == -COST
    assert balances["provider"] > 0, "the gas is paid back in XRT"


def test_kept_files_are_named_by_their_cid(kept: tuple[Path, list[dict[str, Any]]]) -> None:
    folder, (*_, summed) = kept
    assert {path.name for path in folder.iterdir()} == {f"{summed[name]}.mcap" for name in ("objective", "result")}
    for path in folder.iterdir():
        assert cid_of_file(path) == path.stem
    recording = open_objective(folder / f"{summed['result']}.mcap")
    assert recording.metadata["aira"]["liability"] == summed["liability"]
    said = [String.decode(message.payload).data for message in recording.messages() if message.topic == "/led"]
    assert said == ["on", "off"] * 3


def test_a_kept_objective_can_be_played_again_into_the_same_folder(kept: tuple[Path, list[dict[str, Any]]]) -> None:
    folder, (*_, first) = kept
    again = folder / f"{first['objective']}.mcap"
    second = objects(demo("--json", "--out", folder, "--objective", again))[-1]
    assert second["objective"] == first["objective"] == cid_of_file(again)
    assert cid_of_file(folder / f"{second['result']}.mcap") == second["result"]


def test_generation_5_prints_the_same_summary() -> None:
    *_, summed = objects(demo("--json", "--generation", "5"))
    assert (summed["generation"], summed["paid"], set(summed)) == (5, True, SUMMARY)


def test_people_read_text() -> None:
    done = demo()
    assert done.exit_code == 0
    assert done.stderr == ""
    for words in (
        "A market is founded",
        "will pay 42 XRT for it, and publishes a Demand",
        "● LED on",
        "signs the Result: done, recording",
        "robot     had 1,000 XRT, has 1,042 XRT",
        "the job was paid.",
    ):
        assert words in done.stdout


def test_a_bag_is_played(tmp_path: Path) -> None:
    bag = tmp_path / "lamp.bag"
    bag.write_bytes(
        Bag([BagMessage("/colour", string(colour), 10**18 + n * 10**8) for n, colour in enumerate(["red"])]).encode()
    )
    *events, summed = objects(demo("--json", "--objective", bag, "--out", tmp_path / "kept"))
    assert summed["paid"]
    assert summed["objective"] == cid_of_file(bag)
    assert [event["message"] for event in events if event["event"] == "played"] == ["red"]
    assert {event["colour"] for event in events if event["event"] == "led"} == {"red"}
    assert (tmp_path / "kept" / f"{summed['objective']}.bag").read_bytes() == bag.read_bytes()


def test_a_dense_objective_has_the_time_that_the_lamp_needs(tmp_path: Path) -> None:
    """The lamp takes longer for each message than the time until the next one."""
    path = tmp_path / "dense.mcap"
    path.write_bytes(objective(*(("/blink", Empty()) for _ in range(40)), step_ns=0))
    recorder = Recorder()
    asyncio.run(Demo(tmp_path, objective=path, generation=3, out=None, narrator=recorder, timeout=6.0).run())
    assert recorder.facts["paid"]


def refused(*arguments: str | Path) -> str:
    """The error line of a demo that exits with 2."""
    done = demo(*arguments)
    assert done.exit_code == 2
    assert done.stdout == ""
    line, *hint = done.stderr.splitlines()
    assert len(hint) <= 1
    return line


def test_a_text_file_is_refused(tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    readme.write_text("# AIRA mesh\n\nRobots and people trade work without a middleman.\n" * 50)
    assert "README.md" in refused("--objective", readme)
    done = aira("demo", "--objective", readme)
    assert (done.returncode, done.stdout) == (2, "")
    assert "Traceback" not in done.stderr


def test_a_missing_objective_is_one_line(tmp_path: Path) -> None:
    line = refused("--objective", tmp_path / "missing")
    assert str(tmp_path / "missing") in line
    assert line.endswith("[input-error]")


def test_a_truncated_objective_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    write_objective(path)
    path.write_bytes(path.read_bytes()[:-20])
    assert "cut.mcap" in refused("--objective", path)


def test_an_output_folder_that_can_not_be_made_is_refused_at_the_start(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "kept"
    line = refused("--json", "--out", out)
    assert str(out) in line
    assert line.endswith("[output-not-writable]")


def test_the_default_objective_has_the_same_bytes_each_time(tmp_path: Path) -> None:
    for name in ("one", "other"):
        write_objective(tmp_path / name)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()
    assert open_objective(tmp_path / "one").count == 3


@pytest.mark.sample("moment")
@pytest.mark.parametrize("moment", ["router", "contracts", "objective", "match", "running", "complete"])
def test_ctrl_c_ends_it_at_any_moment(moment: str, tmp_path: Path) -> None:
    variables = {"TMPDIR": str(tmp_path)}
    interrupted = Interrupted("demo", "--json", at=f'"event":"{moment}"', variables=variables)
    assert (interrupted.code, interrupted.errors) == (130, "")
    assert list(tmp_path.iterdir()) == []
    assert interrupted.seconds < SOON


@pytest.mark.parametrize("module", ["click", "asyncio", "msgspec", "aiohttp"])
def test_ctrl_c_ends_it_before_it_prints_anything(module: str) -> None:
    interrupted = Interrupted("demo", "--json", loads=module)
    assert (interrupted.code, interrupted.output) == (130, "")
    assert "Traceback" not in interrupted.errors
    assert interrupted.seconds < SOON


def test_the_model_of_the_demo_is_a_cid() -> None:
    assert MODEL.startswith("Qm")


def test_sigterm_ends_it_too() -> None:
    interrupted = Interrupted("demo", "--json", at='"event":"router"', by=signal.SIGTERM)
    assert (interrupted.code, interrupted.errors) == (130, "")
