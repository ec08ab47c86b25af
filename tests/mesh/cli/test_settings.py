"""`aira settings`, and how commands come to their settings."""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING

import msgspec
import pytest
from click.testing import CliRunner

from mesh.cli import main
from mesh.errors import ConfigurationError
from mesh.settings import MEANING, OPTIONS, Settings, load
from tests.support.commands import refused

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result


def settings(*arguments: str | Path, **variables: str) -> Result:
    return CliRunner().invoke(main, ["settings", *map(str, arguments)], env=dict(variables))


def in_force(*arguments: str | Path, **variables: str) -> Settings:
    done = settings("--json", *arguments, **variables)
    assert done.exit_code == 0, done.stderr
    return msgspec.json.decode(done.stdout, type=Settings)


def test_without_anything_it_shows_the_defaults_as_one_object() -> None:
    assert in_force() == Settings()


def test_the_help_of_a_switch_shows_its_two_values_and_the_default() -> None:
    shown = " ".join(settings("--help").output.split())
    assert "--enable-executor true|false run jobs; false only listens [true]" in shown
    assert "--open-services true|false" in shown


def test_the_plain_form_is_a_settings_file(tmp_path: Path) -> None:
    done = settings("--connect", "tcp/robots.example:7447", "--poll-interval", "0.5", "--enable-executor", "false")
    (tmp_path / "aira.toml").write_text(done.stdout)
    loaded = load(path=tmp_path / "aira.toml", environ={})
    assert loaded.connect == ("tcp/robots.example:7447",)
    assert loaded.poll_interval == 0.5
    assert loaded.enable_executor is False
    of_the_chain = {"confirmations", "reorg_depth", "deadline_limit"}  # commented out, as they were not given
    assert set(tomllib.loads(done.stdout)) == set(OPTIONS) - of_the_chain
    assert "\n# confirmations = 1\n" in done.stdout
    assert f"# {MEANING['poll_interval']}\npoll_interval = 0.5\n" in done.stdout


def test_flags_win_over_variables_and_variables_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "aira.toml"
    file.write_text('generation = 5\nplayback = "at-once"\nfetch_timeout = 1.0\n')
    shown = in_force("--config", file, "--fetch-timeout", "3", AIRA_FETCH_TIMEOUT="2", AIRA_PLAYBACK="recorded")
    assert (shown.generation, shown.playback, shown.fetch_timeout) == (5, "recorded", 3.0)


def test_the_file_may_be_named_by_a_variable(tmp_path: Path) -> None:
    file = tmp_path / "aira.toml"
    file.write_text("generation = 5\n")
    assert in_force(AIRA_CONFIG=str(file)).generation == 5


def test_a_list_is_given_by_a_flag_for_each() -> None:
    shown = in_force("--connect", "tcp/one:1", "--connect", "tcp/two:2")
    assert shown.connect == ("tcp/one:1", "tcp/two:2")


@pytest.mark.parametrize(
    ("arguments", "value"),
    [
        (["--generation", "4"], "generation"),
        (["--poll-interval", "soon"], "poll_interval"),
        (["--objective-size-limit", "0"], "objective_size_limit"),
        (["--config", "/nowhere/aira.toml"], "/nowhere/aira.toml"),
    ],
)
def test_an_invalid_setting_is_one_clear_line(arguments: list[str], value: str) -> None:
    done = settings(*arguments)
    refused(done, ConfigurationError, value)


def test_every_option_is_a_flag_with_its_meaning_and_default() -> None:
    text = " ".join(settings("--help").stdout.split())
    for name in OPTIONS:
        assert f"--{name.replace('_', '-')} " in text
    assert "[recorded]" in text
