"""Flags: empty values and invalid numbers."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click
import pytest
from click.testing import CliRunner

from mesh.cli import main
from mesh.cli.options import PORT
from mesh.settings import DEFAULTS, OPTIONS
from mesh.settings.chains import CHAINS
from tests.support.commands import refused

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from click.testing import Result

CID = "QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82"


def aira(*arguments: str, **variables: str) -> Result:
    return CliRunner().invoke(main, list(arguments), env=dict(variables))


def test_an_empty_flag_wins_over_a_variable() -> None:
    done = aira("settings", "--json", "--recording-topics", "", AIRA_RECORDING_TOPICS="/led")
    assert json.loads(done.stdout)["recording_topics"] == ""


def test_another_chain_can_be_named_in_a_file_of_settings_that_were_printed(tmp_path: Path) -> None:
    file = tmp_path / "aira.toml"
    file.write_text(aira("settings", "--reorg-depth", "77").stdout)
    assert json.loads(aira("settings", "--json", "--config", str(file)).stdout)["confirmations"] == 1
    found = json.loads(aira("settings", "--json", "--config", str(file), "--chain", "base").stdout)
    base = CHAINS["base"]
    assert found["reorg_depth"] == 77, "what was given is kept"
    assert (found["confirmations"], found["deadline_limit"]) == (base.confirmations, base.deadline_limit)


@pytest.mark.parametrize(
    "arguments",
    [
        ("up", "--port", "65536"),
        ("up", "--port", "-1"),
        ("up", "--block-time", "0"),
        ("up", "--block-time", "-1"),
        ("chain", "up", "--port", "99999"),
        ("chain", "up", "--block-time", "0"),
        ("demand", "--model", CID, "--objective", CID, "--cost", "-1"),
        ("demand", "--model", CID, "--objective", CID, "--cost", "1,5"),
        ("demand", "--model", CID, "--objective", CID, "--validator-fee", "much"),
        ("demand", "--model", CID, "--objective", CID, "--lifetime", "0"),
        ("demo", "--generation", "4"),
        ("robots", "--timeout", "nan"),
        ("replay", CID, "--rate", "1e-300"),
        ("replay", CID, "--from", "1e300"),
        ("status", "--timeout", "inf"),
        ("rpc", CID, "start", "--timeout", "1e300"),
    ],
)
def test_an_error_of_an_invalid_number_names_its_flag(arguments: tuple[str, ...]) -> None:
    done = aira(*arguments)
    assert done.exit_code == 2
    assert arguments[-2] in done.stderr.splitlines()[0]


@pytest.mark.parametrize("option", ["--connect-timeout", "--poll-interval", "--fetch-timeout"])
@pytest.mark.parametrize("value", ["inf", "nan"])
def test_seconds_are_finite(option: str, value: str) -> None:
    done = aira("settings", option, value)
    refused(done, "invalid-option", option[2:].replace("-", "_"))


@pytest.mark.parametrize("command", ["demand", "peers", "provider", "router", "settings", "status", "up", "watch"])
def test_an_invalid_variable_is_one_clear_line_in_every_command_with_settings(command: str) -> None:
    needed = ("--model", CID, "--objective", CID) if command == "demand" else ()
    done = aira(command, *needed, AIRA_KEYFILL="x")
    refused(done, "unknown-option", "'keyfill'", "environment")


def commands(group: click.Command = main, *words: str) -> Iterator[tuple[str, click.Command]]:
    """Every command of `aira`, with its words."""
    if isinstance(group, click.Group):
        context = click.Context(group)
        for name in group.list_commands(context):
            found = group.get_command(context, name)
            assert found is not None
            yield from commands(found, *words, name)
    else:
        yield " ".join(words), group


def options(flag: str) -> dict[str, click.Option]:
    """The option of each command that has it."""
    found = ((words, one) for words, command in commands() for one in command.params if flag in one.opts)
    return {words: one for words, one in found if isinstance(one, click.Option)}


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e999"])
def test_every_number_is_finite(value: str) -> None:
    numbers = [
        one for _, command in commands() for one in command.params if isinstance(one.type, click.types.FloatParamType)
    ]
    assert len(numbers) > 15
    for one in numbers:
        with pytest.raises(click.BadParameter):
            one.type.convert(value, one, None)


def test_a_port_is_the_number_of_a_tcp_port_in_every_command() -> None:
    assert {words: one.type for words, one in options("--port").items()} == {"chain up": PORT, "up": PORT}
    assert options("--tty").keys() == {"board run", "doctor"}  # a serial port


def test_listen_is_an_address_in_every_command() -> None:
    found = options("--listen")
    routers = {words for words, one in found.items() if "endpoints" in (one.help or "")}
    assert routers == {"doctor", "settings", "up"}
    assert {found[words].metavar for words in found.keys() - routers} == {"HOST:PORT"}


SERVERS = frozenset(
    {
        *("board run", "bridge ipfs", "bridge ros1", "bridge ros2", "edge", "provider", "signer", "web", "a2a"),
        *("foxglove agent", "foxglove job", "foxglove market"),
    }
)
"""They serve until they are stopped; programs read their log in JSON (--log-format), or their metrics."""
DOCUMENTS = frozenset({"completion", "foxglove layout", "model schema", "router config"})
"""They print or write a file as it is."""


def test_every_command_that_prints_facts_prints_them_as_json() -> None:
    without = {words for words, command in commands() if not any("--json" in one.opts for one in command.params)}
    assert without == SERVERS | DOCUMENTS


@pytest.mark.parametrize("name", [name for name in OPTIONS if isinstance(getattr(DEFAULTS, name), tuple)])
def test_the_flag_of_a_setting_with_several_values_may_be_repeated(name: str) -> None:
    flag, default = f"--{name.replace('_', '-')}", list(getattr(DEFAULTS, name))
    two = default[:2] if len(default) > 1 else ["one", "two"]
    done = aira("settings", "--json", flag, two[0], flag, two[1])
    assert json.loads(done.stdout)[name] == two
