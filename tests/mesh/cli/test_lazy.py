"""The command line as a whole: help, versions, typing errors, and an early Ctrl-C."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

import mesh
from mesh.cli import COMMANDS, LazyGroup, main
from tests.support.commands import run

if TYPE_CHECKING:
    from pathlib import Path

    import click

GROUPS = {
    "account": ("new", "import", "show", "rotate"),
    "chain": ("up", "deploy", "status", "cost"),
    "liability": ("show", "list", "watch", "cancel", "claim", "stop", "hand-back"),
    "lighthouse": ("create", "list", "info", "join", "leave"),
    "xrt": ("balance", "allowance", "approve", "transfer"),
}


INSTALLED = ("board", "edge", "bridge ipfs", "web")


def test_help_lists_every_command_without_importing_those_of_the_core() -> None:
    program = (
        "import sys; from mesh.cli import COMMANDS, main\n"
        "main(['--help'], standalone_mode=False)\n"
        "print([target for target, _ in COMMANDS.values() if target.split(':')[0] in sys.modules])"
    )
    lines = run(sys.executable, "-c", program).stdout.splitlines()
    width = max(map(len, COMMANDS))
    for name, (_, meaning) in COMMANDS.items():
        assert f"  {name:<{width}}  {meaning}" in lines
    assert lines[-1] == "[]"


@pytest.mark.parametrize(
    "name", [*COMMANDS, *INSTALLED, *(f"{group} {name}" for group, names in GROUPS.items() for name in names)]
)
def test_every_command_says_what_it_does(name: str) -> None:
    done = CliRunner().invoke(main, [*name.split(), "--help"])
    assert done.exit_code == 0
    assert done.stdout.startswith(f"Usage: main {name} ")


def test_the_version_is_that_of_the_package() -> None:
    assert CliRunner().invoke(main, ["--version"]).stdout == f"aira, version {mesh.__version__}\n"


@pytest.mark.parametrize(("group", "names"), GROUPS.items())
def test_a_group_lists_its_commands_with_a_whole_line_each(group: str, names: tuple[str, ...]) -> None:
    lines = CliRunner().invoke(main, [group, "--help"]).stdout.partition("Commands:\n")[2].splitlines()
    assert [line.split()[0] for line in lines] == sorted(names)
    assert not [line for line in lines if line.endswith("...")]


def test_an_interrupt_while_a_command_is_loaded_ends_with_130(monkeypatch: pytest.MonkeyPatch) -> None:
    group = LazyGroup("aira", lazy={"slow": ("tests.support.commands:aira", "takes its time")})

    def interrupted(ctx: click.Context, name: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(group, "get_command", interrupted)
    done = CliRunner().invoke(group, ["slow"])
    assert done.exit_code == 130
    assert done.output == ""


def test_the_module_runs_the_command_line() -> None:
    done = subprocess.run([sys.executable, "-m", "mesh", "--help"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("Usage: aira ")


PLUGIN = """
import click

@click.command(short_help="say hello")
def command():
    click.echo("hello")
"""


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package with four entry points: two commands that work, two that can't be imported."""
    (tmp_path / "plugin_of_a_test.py").write_text(PLUGIN)
    about = tmp_path / "plugins-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: plugins\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "[aira.commands]\n"
        "hello = plugin_of_a_test:command\n"
        "bridge moon = plugin_of_a_test:command\n"
        "absent = module_that_is_absent:command\n"
        "odd = plugin_of_a_test:PLUGIN\n"
        "cid = plugin_of_a_test:command\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.fixture
def root() -> click.Group:
    """The command line, which has not read the entry points yet."""
    return LazyGroup(
        "aira", lazy=COMMANDS | {"bridge": ("tests.mesh.cli.test_lazy:fresh_bridge", "bridges")}, installed=""
    )


fresh_bridge = LazyGroup("bridge", installed="bridge ")


@pytest.mark.usefixtures("plugins")
def test_an_installed_package_adds_commands(root: click.Group) -> None:
    for words in (["hello"], ["bridge", "moon"]):
        assert CliRunner().invoke(root, words).stdout == "hello\n"
    assert "say hello" in CliRunner().invoke(root, ["--help"]).stdout


@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize("name", ["absent", "odd"])
def test_an_installed_command_that_can_not_be_imported_is_one_clear_line(root: click.Group, name: str) -> None:
    done = CliRunner().invoke(root, [name])
    assert (done.exit_code, done.stdout) == (2, "")
    line, hint = done.stderr.splitlines()
    assert line.startswith("aira: ")
    assert line.endswith("[command-broken]")
    assert repr(name) in line
    assert "plugins" in hint


@pytest.mark.usefixtures("plugins")
def test_a_broken_command_does_not_break_others(root: click.Group) -> None:
    assert CliRunner().invoke(root, ["hello"]).exit_code == 0
    done = CliRunner().invoke(root, ["--help"])
    assert (done.exit_code, "module_that_is_absent" in done.stdout) == (0, True)


@pytest.mark.usefixtures("plugins")
def test_a_command_of_the_core_can_not_be_replaced(root: click.Group) -> None:
    assert CliRunner().invoke(root, ["cid", "--help"]).stdout.startswith("Usage: aira cid [OPTIONS] FILES...")


def test_small_commands_read_no_entry_points(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    program = (
        "import mesh.base.extras as extras; from mesh.cli import main\n"
        "extras.entry_points = None\n"
        f"main(['cid', {str(tmp_path / 'file')!r}], standalone_mode=False)"
    )
    assert run(sys.executable, "-c", program).returncode == 0
