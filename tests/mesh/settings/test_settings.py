"""Settings: their sources, the order of precedence, and the errors of invalid ones."""

from __future__ import annotations

import errno
import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mesh.errors import ConfigurationError
from mesh.settings import MEANING, NOT_OPTIONS, OPTIONS, ChainSettings, Settings, load, options_of
from mesh.settings.chains import ANY, CHAINS
from tests.support.log_events import logged_facts
from tests.support.raising import raises_with

NOTHING: dict[str, str] = {}


def written(path: Path, text: str) -> Path:
    file = path / "aira.toml"
    file.write_text(text)
    return file


def test_the_defaults_are_those_of_the_legacy_network() -> None:
    settings = load(environ=NOTHING)

    assert settings == Settings()
    assert settings.web3_http_provider == "http://127.0.0.1:8545"
    assert settings.web3_ws_provider == "ws://127.0.0.1:8546"
    assert settings.ipfs_http_provider == "http://127.0.0.1:5001"
    assert settings.factory_contract == "factory.3.robonomics.eth"
    assert settings.lighthouse_contract == "airalab.lighthouse.3.robonomics.eth"
    assert settings.erc20_token == "xrt.3.robonomics.eth"
    assert settings.enable_executor is True
    assert settings.recording_topics == settings.ens_contract == ""


def test_the_names_of_the_contracts_are_those_of_the_generation() -> None:
    settings = load(environ={"AIRA_GENERATION": "5"})

    assert settings.factory_contract == "factory.5.robonomics.eth"
    assert settings.lighthouse_contract == "airalab.lighthouse.5.robonomics.eth"
    assert settings.xrt_contract == settings.erc20_token == "xrt.5.robonomics.eth"


def test_configured_names_are_kept_in_every_generation() -> None:
    given = {"factory_contract": "0xFactory", "lighthouse_contract": "mine.lighthouse.3.robonomics.eth"}

    settings = load(environ=NOTHING, flags=given | {"generation": 5, "erc20_token": "dai.test"})

    assert (settings.factory_contract, settings.lighthouse_contract) == tuple(given.values())
    assert (settings.erc20_token, settings.xrt_contract) == ("dai.test", "xrt.5.robonomics.eth")


def test_a_named_chain_sets_what_is_not_given() -> None:
    known = CHAINS["base"]

    settings = load(environ={"AIRA_CHAIN": "base", "AIRA_REORG_DEPTH": "77"}, flags={"confirmations": 9})

    assert settings.profile is known
    assert (settings.confirmations, settings.reorg_depth) == (9, 77), "what is given is kept"
    assert (settings.poll_interval, settings.deadline_limit) == (known.poll_interval, 432_000)
    assert load(environ={"AIRA_CHAIN": "base"}).confirmations == known.confirmations


def test_another_chain_brings_its_own_values_and_keeps_given_ones() -> None:
    settings = replace(load(environ={"AIRA_CHAIN": "base", "AIRA_REORG_DEPTH": "77"}), chain="gnosis")

    assert (settings.confirmations, settings.deadline_limit) == (CHAINS["gnosis"].confirmations, 17_280)
    assert settings.reorg_depth == 77, "what is given is kept"
    assert replace(settings, name="Lift 1").confirmations == settings.confirmations


def test_without_a_chain_everything_is_as_on_any() -> None:
    settings = load(environ=NOTHING)

    assert settings.profile is ANY
    assert (settings.confirmations, settings.reorg_depth, settings.poll_interval) == (1, 12, 1.0)
    assert (settings.deadline_limit, settings.finality) == (7200, "latest")


def test_each_known_chain_can_be_set_and_no_other() -> None:
    for name in CHAINS:
        assert load(environ={"AIRA_CHAIN": name}).profile.name == name
    with raises_with(ConfigurationError, code="invalid-option") as error:
        load(environ={"AIRA_CHAIN": "bas"})
    assert all(name in error.value.hint for name in CHAINS)


def test_an_empty_name_means_the_default() -> None:
    assert load(environ={"AIRA_FACTORY_CONTRACT": "", "AIRA_GENERATION": "5"}) == Settings(generation=5)


def test_the_websocket_is_used_without_an_http_address() -> None:
    assert Settings().node == "http://127.0.0.1:8545"
    assert load(environ={"AIRA_WEB3_HTTP_PROVIDER": " "}).node == "ws://127.0.0.1:8546"
    assert Settings(web3_http_provider="http://a:1, ws://b:2").node == "http://a:1, ws://b:2"
    with raises_with(ConfigurationError, code="node-not-set"):
        Settings(web3_http_provider="", web3_ws_provider="").node  # noqa: B018


def test_variables_override_the_file_and_flags_override_both(tmp_path: Path) -> None:
    file = written(tmp_path, 'recording_topics = "file"\nens_contract = "file"\ndata_dir = "file"\n')

    settings = load(path=file, environ={"AIRA_ENS_CONTRACT": "env", "AIRA_DATA_DIR": "env"}, flags={"data_dir": "flag"})

    assert (settings.recording_topics, settings.ens_contract, settings.data_dir) == ("file", "env", "flag")


def test_a_flag_that_was_not_given_overrides_nothing() -> None:
    assert load(environ={"AIRA_DATA_DIR": "env"}, flags={"data_dir": None}).data_dir == "env"


def test_the_process_environment_is_read_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AIRA_ERC20_TOKEN", "other.3.robonomics.eth")

    assert load().erc20_token == "other.3.robonomics.eth"


def test_variables_are_converted_to_the_type_of_the_option() -> None:
    settings = load(
        environ={
            "AIRA_GENERATION": "5",
            "AIRA_ENABLE_EXECUTOR": "false",
            "AIRA_POLL_INTERVAL": "0.5",
            "AIRA_OPEN_ORDERS_LIMIT": "7",
            "AIRA_CONNECT": "tcp/a:1, tcp/b:2,",
        }
    )

    assert settings.generation == 5
    assert settings.enable_executor is False
    assert settings.poll_interval == 0.5
    assert settings.open_orders_limit == 7
    assert settings.connect == ("tcp/a:1", "tcp/b:2")


def test_a_file_has_typed_values(tmp_path: Path) -> None:
    file = written(tmp_path, 'connect = ["tcp/a:1"]\ngeneration = 5\nenable_executor = false\nfetch_timeout = 3\n')

    settings = load(path=file, environ=NOTHING)

    assert (settings.connect, settings.generation, settings.enable_executor) == (("tcp/a:1",), 5, False)
    assert settings.fetch_timeout == 3.0


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("web3_http_providers", "web3_http_provider"),
        ("keyfile_pasword_file", "keyfile_password_file"),
    ],
)
def test_an_unknown_option_in_the_file_suggests_the_nearest(tmp_path: Path, wrong: str, right: str) -> None:
    file = written(tmp_path, f'{wrong} = "x"\n')

    with raises_with(ConfigurationError, code="unknown-option") as error:
        load(path=file, environ=NOTHING)

    assert str(error.value) == f"unknown option {wrong!r} in {file}"
    assert error.value.hint == f"did you mean {right!r}?"


def test_an_option_near_no_other_suggests_none(tmp_path: Path) -> None:
    with raises_with(ConfigurationError, code="unknown-option") as error:
        load(path=written(tmp_path, 'zebra = "x"\n'), environ=NOTHING)

    assert "did you mean" not in error.value.hint


def test_an_unknown_variable_suggests_the_nearest_option() -> None:
    with raises_with(ConfigurationError, code="unknown-option") as error:
        load(environ={"AIRA_KEYFIL": "x"})

    assert str(error.value) == "unknown option 'keyfil' in the environment"
    assert "'keyfile'" in error.value.hint


def test_an_unknown_flag_suggests_the_nearest_option() -> None:
    with raises_with(ConfigurationError, code="unknown-option") as error:
        load(environ=NOTHING, flags={"datadir": "x"})

    assert str(error.value) == "unknown option 'datadir' in the flags"
    assert "'data_dir'" in error.value.hint


def test_variables_of_other_programs_and_of_the_tests_are_no_options() -> None:
    others = dict.fromkeys(NOT_OPTIONS - {"AIRA_CONFIG"}, "x") | {"PATH": "/bin", "XAIRA_FOO": "x"}

    assert load(environ=others) == Settings()


@pytest.mark.parametrize("where", ["file", "environment"])
def test_a_retired_option_is_reported_and_ignored(tmp_path: Path, caplog: pytest.LogCaptureFixture, where: str) -> None:
    file = written(tmp_path, "master_check_interval = 1\n") if where == "file" else None
    environ = {"AIRA_MASTER_CHECK_INTERVAL": "1"} if where == "environment" else {}

    with caplog.at_level(logging.WARNING):
        assert load(path=file, environ=environ) == Settings()

    assert logged_facts(caplog, "option-retired") == [{"option": "master_check_interval"}]


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("generation", 4),
        ("contracts", "others"),
        ("max_fee_gwei", 0),
        ("max_fee_gwei", float("nan")),
        ("confirmations", 0),
        ("reorg_depth", 0),
        ("generation", "three"),
        ("enable_executor", "perhaps"),
        ("poll_interval", 0),
        ("poll_interval", float("nan")),
        ("connect_timeout", -2),
        ("connect_timeout", float("nan")),
        ("open_orders_limit", 0),
        ("objective_size_limit", -1),
        ("playback", "backwards"),
        ("fetch_timeout", -1),
        ("connect", "tcp/a:1"),
        ("connect", [1]),
    ],
)
def test_an_invalid_value_is_reported_with_its_option_and_meaning(option: str, value: Any) -> None:
    with raises_with(ConfigurationError, code="invalid-option") as error:
        load(environ=NOTHING, flags={option: value})

    assert f"the setting {option} is invalid" in str(error.value)
    assert "\n" not in str(error.value)
    assert error.value.hint == f"{option}: {MEANING[option]}"


def test_a_missing_file_is_one_clear_line(tmp_path: Path) -> None:
    with raises_with(ConfigurationError, code="settings-unreadable") as error:
        load(path=tmp_path / "none.toml", environ=NOTHING)

    assert str(tmp_path / "none.toml") in str(error.value)
    assert str(error.value).endswith(os.strerror(errno.ENOENT))


@pytest.mark.parametrize("content", [b"connect = [", b"\xff\xfe", b"a = 1\na = 2\n"])
def test_a_file_that_is_not_toml_is_one_clear_line(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "aira.toml"
    file.write_bytes(content)

    with raises_with(ConfigurationError, code="settings-not-toml") as error:
        load(path=file, environ=NOTHING)

    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_role_that_signs_needs_keyfile_and_password_file() -> None:
    for settings in (Settings(), Settings(keyfile="k"), Settings(keyfile_password_file="p")):
        with raises_with(ConfigurationError, code="account-not-set") as error:
            settings.keyfile_and_password()
        assert "aira account new" in error.value.hint


def test_keyfile_and_data_folder_may_be_in_the_home_folder() -> None:
    settings = Settings(keyfile="~/key", keyfile_password_file="~/password", data_dir="~/aira")

    assert settings.keyfile_and_password() == (Path.home() / "key", Path.home() / "password")
    assert settings.state_directory == Path.home() / "aira"


def test_the_default_data_folder_is_in_the_users_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", "/somewhere")
    assert Settings().state_directory == Path("/somewhere/aira")

    monkeypatch.delenv("XDG_DATA_HOME")
    assert Settings().state_directory == Path.home() / ".local/share/aira"


def test_every_option_has_a_description() -> None:
    assert set(MEANING) == set(OPTIONS)


def test_the_names_that_decide_about_the_chain_are_options() -> None:
    assert set(OPTIONS) >= set(options_of(ChainSettings))


def test_the_file_named_by_aira_config_is_read(tmp_path: Path) -> None:
    path = tmp_path / "aira.toml"
    path.write_text('lighthouse_contract = "named.lighthouse.3.robonomics.eth"\n')

    assert load(environ={"AIRA_CONFIG": str(path)}).lighthouse_contract == "named.lighthouse.3.robonomics.eth"
