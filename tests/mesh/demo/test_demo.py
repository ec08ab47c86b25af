"""`aira demo`: the whole story, as people and as programs read it."""

from __future__ import annotations

import json
import signal
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner

from mesh.cli import main
from mesh.demo.demo import COST, MODEL
from mesh.demo.objective import write_objective
from mesh.recording import open_objective
from schemas import Empty, String, cid_of_file
from tests.support.bags import Bag, BagMessage, string
from tests.support.commands import SOON, Interrupted, aira
from tests.support.objectives import objective

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result

SUM = {
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


def told(done: Result) -> list[dict[str, Any]]:
    assert done.exit_code == 0, done.output
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """A demo that was run: the folder that it kept its files in, and what it told."""
    folder = tmp_path_factory.mktemp("demo") / "deep" / "kept"
    return folder, told(demo("--json", "--out", folder))


def test_the_last_object_sums_up_and_every_line_is_one(kept: tuple[Path, list[dict[str, Any]]]) -> None:
    *events, summed = kept[1]
    assert set(summed) == SUM
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


def test_what_is_kept_is_named_by_its_cid(kept: tuple[Path, list[dict[str, Any]]]) -> None:
    folder, (*_, summed) = kept
    assert {path.name for path in folder.iterdir()} == {f"{summed[name]}.mcap" for name in ("objective", "result")}
    for path in folder.iterdir():
        assert cid_of_file(path) == path.stem
    recording = open_objective(folder / f"{summed['result']}.mcap")
    assert recording.metadata["aira"]["liability"] == summed["liability"]
    said = [String.decode(message.payload).data for message in recording.messages() if message.topic == "/led"]
    assert said == ["on", "off"] * 3


def test_what_was_kept_can_be_played_again_into_the_same_folder(kept: tuple[Path, list[dict[str, Any]]]) -> None:
    folder, (*_, first) = kept
    again = folder / f"{first['objective']}.mcap"
    second = told(demo("--json", "--out", folder, "--objective", again))[-1]
    assert second["objective"] == first["objective"] == cid_of_file(again)
    assert cid_of_file(folder / f"{second['result']}.mcap") == second["result"]


def test_generation_5_is_told_and_works_the_same() -> None:
    *_, summed = told(demo("--json", "--generation", "5"))
    assert (summed["generation"], summed["paid"], set(summed)) == (5, True, SUM)


def test_people_read_a_story() -> None:
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
    *events, summed = told(demo("--json", "--objective", bag, "--out", tmp_path / "kept"))
    assert summed["paid"]
    assert summed["objective"] == cid_of_file(bag)
    assert [event["message"] for event in events if event["event"] == "played"] == ["red"]
    assert {event["colour"] for event in events if event["event"] == "led"} == {"red"}
    assert (tmp_path / "kept" / f"{summed['objective']}.bag").read_bytes() == bag.read_bytes()


def test_a_dense_objective_takes_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lamp needs longer for its messages than they lie apart: no reason to give up."""
    monkeypatch.setattr("mesh.demo.demo.PATIENCE", 6.0)
    path = tmp_path / "dense.mcap"
    path.write_bytes(objective(*(("/blink", Empty()) for _ in range(40)), step_ns=0))
    assert told(demo("--json", "--objective", path))[-1]["paid"]


def refused(*arguments: str | Path) -> str:
    done = demo(*arguments)
    assert done.exit_code == 2
    assert done.stdout == ""
    line, *hint = done.stderr.splitlines()
    assert len(hint) <= 1
    return line


def test_a_text_is_no_objective(tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    readme.write_text("# AIRA mesh\n\nRobots and people trade work without a middleman.\n" * 50)
    assert refused("--objective", readme).startswith("aira: README.md: ")
    done = aira("demo", "--objective", readme)
    assert (done.returncode, done.stdout) == (2, "")
    assert "Traceback" not in done.stderr


def test_a_missing_objective_is_one_clear_line(tmp_path: Path) -> None:
    assert refused("--objective", tmp_path / "missing") == f"aira: there is no file {tmp_path / 'missing'}"


def test_a_cut_objective_is_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    write_objective(path)
    path.write_bytes(path.read_bytes()[:-20])
    assert refused("--objective", path).startswith("aira: cut.mcap: ")


def test_a_place_that_keeps_nothing_is_found_before_anything_is_done(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "kept"
    assert refused("--json", "--out", out) == f"aira: can't keep files in {out}: Not a directory"


def test_its_own_objective_is_the_same_file_each_time(tmp_path: Path) -> None:
    for name in ("one", "other"):
        write_objective(tmp_path / name)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()
    assert open_objective(tmp_path / "one").count == 3


@pytest.mark.parametrize("moment", ["router", "contracts", "objective", "match", "running", "complete"])
def test_ctrl_c_ends_it_at_any_moment(moment: str) -> None:
    interrupted = Interrupted("demo", "--json", at=f'"event":"{moment}"')
    assert interrupted.code == 130
    assert interrupted.errors == ""
    assert interrupted.seconds < SOON


@pytest.mark.parametrize("seconds", [0.2, 0.4, 0.6])
def test_ctrl_c_ends_it_before_it_says_anything(seconds: float) -> None:
    """Python itself needs a moment until it can end quietly; before that the signal ends it."""
    interrupted = Interrupted("demo", "--json", after=seconds)
    assert interrupted.code in (130, -signal.SIGINT)
    assert "Traceback" not in interrupted.errors
    assert interrupted.seconds < SOON


def test_the_model_of_the_demo_is_a_cid() -> None:
    assert MODEL.startswith("Qm")


def test_sigterm_ends_it_too() -> None:
    interrupted = Interrupted("demo", "--json", at='"event":"router"', by=signal.SIGTERM)
    assert (interrupted.code, interrupted.errors) == (130, "")
