"""Files with a byte order mark, as Notepad and PowerShell write them, in the hands of every command that reads text."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from bridges.ipfs.daemon import authorization_of
from bridges.web.cli import token_in
from mesh.base.fresh_file import Blocklist
from mesh.chain import Account
from mesh.chain._accounts import KeyfileError
from mesh.errors import ConfigurationError
from mesh.ops.identity.roster import read_roster
from mesh.settings import IpfsSettings
from schemas import cid_of_bytes
from schemas.model import InvalidDescription, ModelDescription, is_description, read_description
from tests.support.commands import AIRA, invoke, refused, run
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path

KEY = "4c0883a69102937d6231471b5dbb6204fe5129617082792ae468d01a3f362318"
ADDRESS = "0x2c7536E3605D9C16a7a3D7b1898e529396a65c23"


def marked(path: Path, text: str, encoding: str = "utf-8-sig") -> Path:
    path.write_bytes(text.replace("\n", "\r\n").encode(encoding))
    return path


def test_a_password_and_a_key_do_not_begin_with_the_mark(tmp_path: Path) -> None:
    password, key = marked(tmp_path / "password", "hello world\n"), marked(tmp_path / "key", f"{KEY}\n")
    keyfile = tmp_path / "account.json"
    made = invoke("account", "import", keyfile, "--private-key-file", key, "--password-file", password)
    assert made.stdout.strip() == ADDRESS, made.stderr
    plain = tmp_path / "plain"
    plain.write_text("hello world")
    for one in (password, plain):
        assert Account.from_keyfile(keyfile, one).address == ADDRESS
    copy = ("--from-keyfile", keyfile, "--from-password-file", password, "--password-file", plain)
    assert invoke("account", "import", tmp_path / "copy.json", *copy).stdout.strip() == ADDRESS
    marked(tmp_path / "marked.json", keyfile.read_text())
    assert invoke("account", "show", tmp_path / "marked.json").stdout.strip() == ADDRESS


def test_utf_16_is_named_in_passwords_and_keyfiles(tmp_path: Path) -> None:
    password = marked(tmp_path / "password", "hello", "utf-16")
    made = invoke("account", "new", tmp_path / "account.json", "--password-file", password)
    assert "UTF-8" in refused(made, "password-file-unusable", "UTF-16")
    assert not (tmp_path / "account.json").exists()
    keyfile = marked(tmp_path / "marked.json", "{}", "utf-16")
    refused(invoke("account", "show", keyfile), KeyfileError, "UTF-16", code="not-a-keyfile")


def test_settings_are_read_without_the_mark(tmp_path: Path) -> None:
    settings = marked(tmp_path / "settings.toml", 'data_dir = "elsewhere"\n')
    assert 'data_dir = "elsewhere"' in invoke("settings", "--config", settings).stdout
    marked(settings, 'data_dir = "elsewhere"\n', "utf-16")
    refused(invoke("settings", "--config", settings), "settings-not-toml", "UTF-16")


def test_lines_of_an_objective_are_read_without_the_mark(tmp_path: Path) -> None:
    line = json.dumps({"topic": "/blink", "value": "blue"}) + "\n"
    lines = marked(tmp_path / "lines.jsonl", line)
    lines.write_bytes(lines.read_bytes() * 2)  # as `cat` joins two of them
    packed = invoke("objective", "pack", lines, "--out", tmp_path / "marked.mcap", "--json")
    assert json.loads(packed.stdout)["messages"] == 2
    marked(lines, line, "utf-16")
    refused(invoke("objective", "pack", lines, "--out", tmp_path / "other.mcap"), "invalid-line", "UTF-16")


def test_a_password_that_is_piped_does_not_begin_with_the_mark(tmp_path: Path) -> None:
    password = tmp_path / "password"
    script = 'printf \'\\357\\273\\277%s\\r\\n\' "$1" | { shift; exec "$@"; }'
    words = ("account", "import", tmp_path / "account.json", "--password-file", password)
    done = run("sh", "-c", script, "sh", KEY, *AIRA, *words)
    assert done.stdout.strip() == ADDRESS, done.stderr


def test_lists_of_addresses_and_rosters_are_read_without_the_mark(tmp_path: Path) -> None:
    listed = marked(tmp_path / "blocked", f"{ADDRESS}\n# a comment\n")
    assert ADDRESS in Blocklist(listed)
    marked(listed, ADDRESS, "utf-16")
    with pytest.raises(ConfigurationError, match="UTF-16"):
        Blocklist(listed)
    roster = marked(tmp_path / "roster.toml", 'lighthouses = ["airalab.lighthouse.3.robonomics.eth"]\n')
    assert read_roster(roster).lighthouses == ("airalab.lighthouse.3.robonomics.eth",)
    marked(roster, "lighthouses = []\n", "utf-16")
    with raises_with(ConfigurationError, code="roster-unusable", match="UTF-16"):
        read_roster(roster)


def test_a_marked_description_is_a_description_and_not_a_model_that_allows_everything(tmp_path: Path) -> None:
    description = ModelDescription(title="A lamp")
    source = marked(tmp_path / "lamp.json", description.encode().decode())
    assert is_description(source.read_bytes())
    with pytest.raises(InvalidDescription, match="byte order mark"):
        read_description(source.read_bytes())
    made = invoke("model", "new", source, "--out", tmp_path / "model.json", "--json")
    assert json.loads(made.stdout)["cid"] == cid_of_bytes(description.encode())
    marked(source, description.encode().decode(), "utf-16")
    refused(invoke("model", "new", source, "--out", tmp_path / "other.json"), InvalidDescription, "UTF-16")


def test_tokens_of_the_page_and_credentials_of_a_daemon_do_not_begin_with_the_mark(tmp_path: Path) -> None:
    file = marked(tmp_path / "token", "Bearer 0123456789abcdef\n")
    assert token_in(file) == "Bearer 0123456789abcdef"
    assert authorization_of(IpfsSettings(ipfs_authorization_file=str(file))) == "Bearer 0123456789abcdef"


def test_a_model_that_is_a_text_is_shown_without_the_mark(tmp_path: Path) -> None:
    text = marked(tmp_path / "model.md", "# A lamp\n")
    assert invoke("model", "show", text).stdout == "# A lamp\n"
