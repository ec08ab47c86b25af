"""`aira new`: each project is type-checked and tested as its author does it."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path
from string import Template

import pytest
from click.testing import CliRunner

from mesh.cli import main
from mesh.cli.new import KINDS
from tests.support.commands import AIRA, Serving, aira, environment, refused
from tests.support.ports import free_port

ROOT = Path(__file__).parents[3]


def new(*arguments: str | Path) -> None:
    done = CliRunner().invoke(main, ["new", *map(str, arguments)])
    assert done.exit_code == 0, done.output


@pytest.fixture(scope="module")
def projects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("projects")
    for kind in KINDS:
        new(kind, f"my-{kind}", "--dir", folder / kind)
    return folder


def run(folder: Path, module: str, *arguments: str | Path) -> None:
    """Run a module of Python with this tree, and with the programs of all projects; it must succeed."""
    command = [sys.executable, "-m", module, *map(str, arguments)]
    places = ":".join(map(str, (ROOT, *folder.iterdir())))
    variables = {"PYTHONPATH": places, "MYPYPATH": places, "ROS2_CONNECT": f"tcp/127.0.0.1:{free_port()}"}
    done = subprocess.run(
        command, cwd=ROOT, env=environment(variables), capture_output=True, text=True, timeout=150, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_projects_are_typed(projects: Path) -> None:
    run(projects, "mypy", *projects.glob("*/*.py"))  # strict, and with the cache of `make lint`


def test_the_tests_of_the_projects_pass(projects: Path) -> None:
    plugin = () if entry_points(group="pytest11", name="aira") else ("-p", "mesh.testing._plugin")
    run(projects, "pytest", "-q", *plugin, "-c", projects / "robot" / "pyproject.toml", *projects.glob("*/test_*.py"))


def test_the_tests_are_as_short_as_promised(projects: Path) -> None:
    for test in projects.glob("*/test_*.py"):
        for body in test.read_text().split("async def ")[1:]:
            assert len(body.strip().splitlines()) <= 12, test


def test_every_file_is_complete(projects: Path) -> None:
    for kind in KINDS:
        found = tomllib.loads((projects / kind / "pyproject.toml").read_text())["project"]
        assert found["name"] == f"my-{kind}"
    for file in (
        file for file in projects.rglob("*") if file.is_file() and file.suffix in (".md", ".service", ".toml")
    ):
        assert "$" not in file.read_text(), file


def test_a_name_that_python_has_is_refused(tmp_path: Path) -> None:
    for name in ("json", "mesh", "A b"):
        done = CliRunner().invoke(main, ["new", "robot", name, "--dir", str(tmp_path / "it")])
        refused(done, "invalid-project-name")
    assert not list(tmp_path.iterdir())


def test_a_folder_with_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").touch()
    refused(CliRunner().invoke(main, ["new", "robot", "lamp", "--dir", str(tmp_path)]), "folder-not-empty")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_the_market_runs_the_robot_and_starts_it_again_when_it_changes(tmp_path: Path) -> None:
    new("robot", "lamp", "--dir", tmp_path)
    program = tmp_path / "lamp.py"
    options = (
        "--engine",
        "embedded",
        "--port",
        "0",
        "--listen",
        "tcp/127.0.0.1:0",
        "--no-web",
        "--data-dir",
        tmp_path / "d",
    )
    with Serving(*AIRA, "up", *options, "--data-dir", tmp_path / "data", "--run", program, says="lamp | ") as up:
        variables = dict(
            line.removeprefix("export ").split("=", 1) for line in up.log().splitlines() if line.startswith("export ")
        )
        words = ("--cost", "1 XRT", "--model", tmp_path / "model.json", "--objective", _objective(tmp_path))
        done = aira("demand", *words, "--data-dir", tmp_path / "person", **variables)
        assert "paid" in done.stdout, done.stdout + done.stderr + up.log()
        up.wait_until_said("lamp | the light is on")
        program.write_text(Template("raise SystemExit('$word')\n").substitute(word="changed"))
        up.wait_until_said("lamp | a file has changed, so it starts again")
        up.wait_until_said("lamp | ended with exit code 1; starts again when you change a file")


def _objective(folder: Path) -> Path:
    (folder / "words").write_text('{"topic": "/blink", "value": {"times": 1}}\n')
    done = aira("objective", "pack", folder / "words", "--out", folder / "objective.mcap")
    assert done.returncode == 0, done.stderr
    return folder / "objective.mcap"
