"""Flags: empty values and invalid numbers."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from mesh.cli import main
from mesh.settings import InvalidOption, UnknownOption
from tests.support.commands import refused

if TYPE_CHECKING:
    from click.testing import Result

CID = "QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82"


def aira(*arguments: str, **variables: str) -> Result:
    return CliRunner().invoke(main, list(arguments), env=dict(variables))


def test_an_empty_flag_wins_over_a_variable() -> None:
    done = aira("settings", "--json", "--recording-topics", "", AIRA_RECORDING_TOPICS="/led")
    assert json.loads(done.stdout)["recording_topics"] == ""


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
    refused(done, InvalidOption, option[2:].replace("-", "_"))


def test_an_unknown_flag_suggests_similar_ones() -> None:
    done = aira("settings", "--fetch-timeot", "3")
    assert done.exit_code == 2
    assert "--fetch-timeout" in done.stderr


@pytest.mark.parametrize("command", ["demand", "peers", "provider", "router", "settings", "status", "up", "watch"])
def test_an_invalid_variable_is_one_clear_line_in_every_command_with_settings(command: str) -> None:
    needed = ("--model", CID, "--objective", CID) if command == "demand" else ()
    done = aira(command, *needed, AIRA_KEYFILL="x")
    refused(done, UnknownOption, "'keyfill'", "environment")
