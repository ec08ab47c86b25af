"""The command line as a whole: help, versions, typing errors, and an early Ctrl-C."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

import mesh
from mesh.cli import COMMANDS, main
from mesh.cli.lazy import LazyGroup
from tests.support.commands import run

if TYPE_CHECKING:
    import click

GROUPS = {
    "account": ("new", "import", "show"),
    "chain": ("up", "deploy", "status"),
    "liability": ("show", "list", "watch", "cancel"),
    "lighthouse": ("create", "list", "info", "join", "leave"),
    "xrt": ("balance", "allowance", "approve", "transfer"),
}


def test_help_lists_every_command_without_importing_any() -> None:
    program = (
        "import sys; from mesh.cli import COMMANDS, main\n"
        "main(['--help'], standalone_mode=False)\n"
        "print([module for module, _ in COMMANDS.values() if module in sys.modules])"
    )
    lines = run(sys.executable, "-c", program).stdout.splitlines()
    width = max(map(len, COMMANDS))
    for name, (_, meaning) in COMMANDS.items():
        assert f"  {name:<{width}}  {meaning}" in lines
    assert lines[-1] == "[]"


@pytest.mark.parametrize("name", [*COMMANDS, *(f"{group} {name}" for group, names in GROUPS.items() for name in names)])
def test_every_command_says_what_it_does(name: str) -> None:
    done = CliRunner().invoke(main, [*name.split(), "--help"])
    assert done.exit_code == 0
    assert done.stdout.startswith(f"Usage: main {name} ")


def test_the_version_is_the_packages() -> None:
    assert CliRunner().invoke(main, ["--version"]).stdout == f"aira, version {mesh.__version__}\n"


@pytest.mark.parametrize(("group", "names"), GROUPS.items())
def test_a_group_lists_its_commands_with_a_whole_line_each(group: str, names: tuple[str, ...]) -> None:
    lines = CliRunner().invoke(main, [group, "--help"]).stdout.partition("Commands:\n")[2].splitlines()
    assert [line.split()[0] for line in lines] == sorted(names)
    assert not [line for line in lines if line.endswith("...")]


@pytest.mark.parametrize(("typed", "meant"), [("dmeo", "demo"), ("demnd", "demand"), ("providr", "provider")])
def test_a_typing_error_is_answered_with_the_nearest_command(typed: str, meant: str) -> None:
    done = CliRunner().invoke(main, [typed])
    assert done.exit_code == 2
    assert f"no such command {typed!r}; did you mean {meant!r}?" in done.stderr


def test_what_is_near_to_nothing_is_only_unknown() -> None:
    done = CliRunner().invoke(main, ["xyzzy"])
    assert done.exit_code == 2
    assert done.stderr.rstrip().endswith("no such command 'xyzzy'")


def test_an_interrupt_while_a_command_is_loaded_ends_with_130(monkeypatch: pytest.MonkeyPatch) -> None:
    group = LazyGroup("aira", commands={"slow": ("tests.support.commands", "takes its time")})

    def interrupted(ctx: click.Context, name: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(group, "get_command", interrupted)
    done = CliRunner().invoke(group, ["slow"])
    assert done.exit_code == 130
    assert done.output == ""


def test_the_module_is_the_command_line_too() -> None:
    done = subprocess.run([sys.executable, "-m", "mesh", "--help"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("Usage: aira ")
