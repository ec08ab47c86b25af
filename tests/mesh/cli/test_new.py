"""`aira new`: each project is type-checked and tested as its author does it."""

from __future__ import annotations

import runpy
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from mesh.cli import main
from mesh.cli.new import KINDS
from mesh.testing import assert_paid, assert_refunded
from tests.support.commands import AIRA, Serving, aira, environment, refused
from tests.support.ports import free_port
from tests.support.ros1.peers import Ros, RosMasterServer

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from mesh.testing import Market

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


def run(folders: Iterable[Path], module: str, *arguments: str | Path) -> None:
    """Run a module of Python with this tree, and with the programs of some projects; it must succeed."""
    command = [sys.executable, "-m", module, *map(str, arguments)]
    places = ":".join(map(str, (ROOT, *folders)))
    variables = {
        "PYTHONPATH": places,
        "MYPYPATH": places,
        "ROS2_CONNECT": f"tcp/127.0.0.1:{free_port()}",
        "ROS_MASTER_URI": f"http://127.0.0.1:{free_port()}",
    }
    done = subprocess.run(
        command, cwd=ROOT, env=environment(variables), capture_output=True, text=True, timeout=150, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def batches(projects: Path) -> Iterator[list[Path]]:
    """The projects in groups, each without two modules of one name: ROS 1 and ROS 2 both have a `twin`."""
    yield [projects / kind for kind in KINDS if kind != "ros1"]
    yield [projects / "ros1"]


def test_the_projects_are_typed(projects: Path) -> None:
    for folders in batches(projects):
        # strict, and with the cache of `make lint`
        run(folders, "mypy", *(file for folder in folders for file in folder.glob("*.py")))


def test_the_tests_of_the_projects_pass(projects: Path) -> None:
    plugin = () if entry_points(group="pytest11", name="aira") else ("-p", "mesh.testing._plugin")
    for folders in batches(projects):
        tests = (file for folder in folders for file in folder.glob("test_*.py"))
        run(folders, "pytest", "-q", *plugin, "-c", folders[0] / "pyproject.toml", *tests)


async def test_the_agent_of_ros_1_turns_the_light_of_a_real_robot_on(
    projects: Path, tmp_path: Path, market: Market, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a master of ROS, with a service of rospy."""
    with RosMasterServer() as master:
        monkeypatch.setenv("ROS_MASTER_URI", master.uri)
        agent = runpy.run_path(str(projects / "ros1" / "my_ros1.py"))["agent"]
        async with Ros(master.uri, tmp_path).node("light") as node, market.robot(agent):
            assert await node.hear() == "ready"
            assert_paid(await market.order(agent, [("/light", True)], cost="1 XRT"))
            assert await node.hear() == {"light": True}
            assert_refunded(await market.order(agent, [("/light", False)], cost="1 XRT"), code="job-failed")


def test_what_the_environment_names_is_in_the_unit_and_in_the_compose_file(projects: Path) -> None:
    for kind, name in (("ros1", "ROS_MASTER_URI"), ("ros2", "ROS2_CONNECT")):
        deploy = projects / kind / "deploy"
        assert f"\nEnvironment={name}=" in (deploy / f"my_{kind}.service").read_text()
        assert f"\n      {name}: ${{{name}:?" in (deploy / "compose.yaml").read_text()
        assert f'environ.get("{name}"' in (projects / kind / f"my_{kind}.py").read_text()


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
