"""`aira account`."""

from __future__ import annotations

import json
import stat
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from mesh.chain import Account, WrongPassword
from mesh.cli import main

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result


def account(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["account", *map(str, arguments)])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Result]:
    """A keyfile and a password file that were made, and what was printed."""
    folder = tmp_path_factory.mktemp("accounts") / "new" / "folder"
    keyfile, password = folder / "robot.json", folder / "password"
    return keyfile, password, account("new", keyfile, "--password-file", password)


def test_a_new_account_is_printed_and_can_be_used(made: tuple[Path, Path, Result]) -> None:
    keyfile, password, done = made
    assert done.exit_code == 0
    assert done.stdout == f"{Account.from_keyfile(keyfile, password).address}\n"


def test_key_and_password_are_for_their_owner_only(made: tuple[Path, Path, Result]) -> None:
    for path in made[:2]:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_neither_key_nor_password_is_printed(made: tuple[Path, Path, Result]) -> None:
    keyfile, password, done = made
    assert password.read_text().strip() not in done.output
    assert json.loads(keyfile.read_text())["crypto"]["ciphertext"] not in done.output
    assert done.stderr == ""


def test_show_prints_the_address_without_a_password(made: tuple[Path, Path, Result]) -> None:
    keyfile, _, done = made
    assert account("show", keyfile).stdout == done.stdout


def test_a_keyfile_is_never_overwritten(made: tuple[Path, Path, Result], tmp_path: Path) -> None:
    keyfile, _, _ = made
    before = keyfile.read_bytes()
    done = account("new", keyfile, "--password-file", tmp_path / "password")
    assert done.exit_code == 2
    assert done.stderr.startswith(f"aira: {keyfile} exists already\n")
    assert keyfile.read_bytes() == before
    assert not (tmp_path / "password").exists(), "no password without an account"


def test_a_password_that_is_there_is_used_its_first_line(tmp_path: Path) -> None:
    password = tmp_path / "password"
    password.write_text("open sesame\nand other notes\n")
    done = account("new", tmp_path / "key.json", "--password-file", password)
    assert done.exit_code == 0
    assert Account.from_keyfile(tmp_path / "key.json", password).address == done.stdout.strip()
    (tmp_path / "bare").write_text("open sesame")
    assert Account.from_keyfile(tmp_path / "key.json", tmp_path / "bare").address == done.stdout.strip()
    (tmp_path / "wrong").write_text("open barley")
    with pytest.raises(WrongPassword):
        Account.from_keyfile(tmp_path / "key.json", tmp_path / "wrong")


@pytest.mark.parametrize("content", [b"", b"\n", b"\nsecond line"])
def test_an_empty_password_is_refused(tmp_path: Path, content: bytes) -> None:
    password = tmp_path / "password"
    password.write_bytes(content)
    done = account("new", tmp_path / "key.json", "--password-file", password)
    assert done.exit_code == 2
    assert done.stderr.startswith(f"aira: the password file {password} is empty\n")
    assert not (tmp_path / "key.json").exists()


def test_a_password_file_that_can_not_be_read_is_one_clear_line(tmp_path: Path) -> None:
    password = tmp_path / "password"
    password.write_bytes(b"\xff\xfe")
    done = account("new", tmp_path / "key.json", "--password-file", password)
    assert done.exit_code == 2
    assert done.stderr.startswith(f"aira: can't use the password file {password}: ")
    assert len(done.stderr.splitlines()) == 1


def test_a_folder_that_can_not_be_made_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = account("new", tmp_path / "file" / "key.json", "--password-file", tmp_path / "password")
    assert done.exit_code == 2
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "can't read the keyfile"),
        ("not json", "is not a keyfile"),
        ("[]", "is not a keyfile"),
        ("{}", "does not say its address"),
    ],
)
def test_what_is_no_keyfile_is_one_clear_line(tmp_path: Path, content: str | None, words: str) -> None:
    keyfile = tmp_path / "key.json"
    if content is not None:
        keyfile.write_text(content)
    done = account("show", keyfile)
    assert done.exit_code == 2
    assert words in done.stderr.splitlines()[0]
    assert done.stdout == ""
