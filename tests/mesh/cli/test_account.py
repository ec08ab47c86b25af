"""`aira account`."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import stat
import subprocess
import time
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from mesh.chain import XRT, Account
from mesh.chain._accounts import KeyfileError
from mesh.cli import main
from mesh.errors import AiraError, ConfigurationError, InputError
from tests.support.cli.served_chain import PASSWORD, columns, write_quick_keyfile
from tests.support.commands import AIRA, invoke, refused

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result

    from tests.support.cli.served_chain import ServedChain


def account(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["account", *map(str, arguments)])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Result]:
    """A new keyfile and password file, and the command's output."""
    folder = tmp_path_factory.mktemp("accounts") / "new" / "folder"
    keyfile, password = folder / "robot.json", folder / "password"
    return keyfile, password, account("new", keyfile, "--password-file", password)


def test_a_new_account_is_printed_and_can_be_used(made: tuple[Path, Path, Result]) -> None:
    keyfile, password, done = made
    assert done.exit_code == 0
    assert done.stdout == f"{Account.from_keyfile(keyfile, password).address}\n"


def test_key_and_password_are_readable_by_their_owner_only(made: tuple[Path, Path, Result]) -> None:
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
    refused(done, "file-exists", keyfile)
    assert keyfile.read_bytes() == before
    assert not (tmp_path / "password").exists(), "no password without an account"


def test_the_first_line_of_an_existing_password_file_is_used(tmp_path: Path) -> None:
    password = tmp_path / "password"
    password.write_text("open sesame\nand other notes\n")
    done = account("new", tmp_path / "key.json", "--password-file", password)
    assert done.exit_code == 0
    assert Account.from_keyfile(tmp_path / "key.json", password).address == done.stdout.strip()
    (tmp_path / "bare").write_text("open sesame")
    assert Account.from_keyfile(tmp_path / "key.json", tmp_path / "bare").address == done.stdout.strip()
    (tmp_path / "wrong").write_text("open barley")
    with pytest.raises(KeyfileError, match="password"):
        Account.from_keyfile(tmp_path / "key.json", tmp_path / "wrong")


@pytest.mark.parametrize("content", [b"", b"\n", b"\nsecond line"])
def test_an_empty_password_is_refused(tmp_path: Path, content: bytes) -> None:
    password = tmp_path / "password"
    password.write_bytes(content)
    done = account("new", tmp_path / "key.json", "--password-file", password)
    refused(done, "password-file-unusable", password, "empty")
    assert not (tmp_path / "key.json").exists()


def test_a_password_file_that_can_not_be_read_is_one_clear_line(tmp_path: Path) -> None:
    password = tmp_path / "password"
    password.write_bytes(b"\xff\xfe")
    done = account("new", tmp_path / "key.json", "--password-file", password)
    refused(done, "password-file-unusable", password)


def test_a_folder_that_can_not_be_created_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = account("new", tmp_path / "file" / "key.json", "--password-file", tmp_path / "password")
    refused(done, "file-unwritable")


@pytest.mark.parametrize(
    ("content", "error", "code"),
    [
        (None, KeyfileError, "keyfile-error"),
        ("not json", KeyfileError, "not-a-keyfile"),
        ("[]", KeyfileError, "not-a-keyfile"),
        ("{}", ConfigurationError, "account-missing"),
    ],
)
def test_an_invalid_keyfile_is_one_clear_line(
    tmp_path: Path, content: str | None, error: type[AiraError], code: str
) -> None:
    keyfile = tmp_path / "key.json"
    if content is not None:
        keyfile.write_text(content)
    done = account("show", keyfile)
    refused(done, error, keyfile, code=code)


KEY = "4c0883a69102937d6231471b5dbb6204fe5129617082792ae468d01a3f362318"
ADDRESS = "0x2c7536E3605D9C16a7a3D7b1898e529396a65c23"


def imported(folder: Path, *arguments: str | Path, given: str | None = None) -> Result:
    """`aira account import` to `key.json` in a folder, with the password in `password` there."""
    words = ["account", "import", folder / "key.json", "--password-file", folder / "password", *arguments]
    return CliRunner().invoke(main, [str(word) for word in words], input=given)


def assert_imported(folder: Path, done: Result) -> None:
    """The key is in the keyfile, under the password, and not in the output."""
    assert (done.exit_code, done.stdout, done.stderr) == (0, f"{ADDRESS}\n", "")
    account = Account.from_keyfile(folder / "key.json", folder / "password")
    assert account.address == ADDRESS
    assert KEY not in (folder / "key.json").read_text()
    assert stat.S_IMODE((folder / "key.json").stat().st_mode) == 0o600


def test_new_and_show_print_json(made: tuple[Path, Path, Result], tmp_path: Path) -> None:
    address = made[2].stdout.strip()
    assert json.loads(account("show", made[0], "--json").stdout) == {"address": address, "keyfile": str(made[0])}
    shown = json.loads(account("new", tmp_path / "key.json", "--password-file", made[1], "--json").stdout)
    assert shown == {"address": account("show", shown["keyfile"]).stdout.strip(), "keyfile": str(tmp_path / "key.json")}


def test_show_uses_the_settings_account_unless_a_keyfile_is_given(made: tuple[Path, Path, Result]) -> None:
    assert account("show", "--keyfile", made[0]).stdout == made[2].stdout
    done = account("show")
    refused(done, "account-missing")


def test_show_reads_the_balances_from_the_chain(served: ServedChain) -> None:
    person = served.people["person"]
    said = columns(served.aira("account", "show", "--balance", AIRA_KEYFILE_PASSWORD_FILE="").stdout)
    assert said["address"] == person.address
    assert said["XRT"] == "1,000"
    assert said["ETH"].startswith("999,999.9")
    assert said["order nonce"] == "0"
    shown = served.run_json("account", "show", person.keyfile, "--balance", AIRA_KEYFILE="")
    assert shown == {
        "address": person.address,
        "wei": str(served.ask("person", lambda chain: chain.tokens.eth_balance())),
        "wn": str(1_000 * XRT),
        "nonce": 0,
    }


@pytest.mark.parametrize("given", [KEY, f"0x{KEY}\n", f"  {KEY.upper()} \r\nnotes"])
def test_a_private_key_is_imported_from_the_standard_input(tmp_path: Path, given: str) -> None:
    assert_imported(tmp_path, imported(tmp_path, given=given))


def test_a_private_key_is_imported_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text(f"0x{KEY}\n")
    assert_imported(tmp_path, imported(tmp_path, "--private-key-file", tmp_path / "secret"))


def test_another_keyfile_is_imported_under_a_new_password(tmp_path: Path) -> None:
    old, old_password = write_quick_keyfile(tmp_path / "old.json", bytes.fromhex(KEY)), tmp_path / "old-password"
    old_password.write_text(f"{PASSWORD}\n")
    (tmp_path / "password").write_text("a new one\n")
    assert_imported(tmp_path, imported(tmp_path, "--from-keyfile", old, "--from-password-file", old_password))


def test_the_password_of_the_other_keyfile_may_come_from_the_standard_input(tmp_path: Path) -> None:
    old = write_quick_keyfile(tmp_path / "old.json", bytes.fromhex(KEY))
    done = imported(tmp_path, "--from-keyfile", old, given=f"{PASSWORD}\n")
    assert_imported(tmp_path, done)
    (tmp_path / "key.json").unlink()
    done = imported(tmp_path, "--from-keyfile", old, given="guessed\n")
    refused(done, "wrong-password")
    assert "guessed" not in done.output


@pytest.mark.parametrize("given", ["", "\n", "a key", KEY[:-1], KEY + "00", "0" * 64, "g" + KEY[1:], "0x" + "é" * 64])
def test_an_invalid_private_key_is_refused_without_printing_it(tmp_path: Path, given: str) -> None:
    done = imported(tmp_path, given=given)
    refused(done, InputError, "private key")
    assert not given.strip() or given.strip() not in done.output
    assert not (tmp_path / "key.json").exists()


def test_a_key_is_not_accepted_as_an_argument(tmp_path: Path) -> None:
    for written in (KEY, "0x" + KEY):
        done = account("import", tmp_path / written, "--password-file", tmp_path / "password")
        refused(done, "invalid-private-key")
        assert KEY not in done.output
    assert list(tmp_path.iterdir()) == []


def test_an_import_overwrites_nothing_and_does_not_prompt_first(tmp_path: Path) -> None:
    (tmp_path / "key.json").write_text("mine")
    done = imported(tmp_path)
    refused(done, "file-exists", tmp_path / "key.json")
    assert (tmp_path / "key.json").read_text() == "mine"


def test_a_key_has_one_source(tmp_path: Path) -> None:
    both = imported(tmp_path, "--private-key-file", tmp_path / "a", "--from-keyfile", tmp_path / "b")
    refused(both, "invalid-options", "--private-key-file", "--from-keyfile")
    lone = imported(tmp_path, "--from-password-file", tmp_path / "a", given=KEY)
    refused(lone, "invalid-options", "--from-password-file", "--from-keyfile")


def test_a_missing_source_is_one_clear_line(tmp_path: Path) -> None:
    for option in ("--private-key-file", "--from-keyfile"):
        done = imported(tmp_path, option, tmp_path / "missing", given="x")
        refused(done, ConfigurationError, "No such file")


class Typing:
    """`aira account import` on a terminal of its own."""

    def __init__(self, folder: Path) -> None:
        self._terminal, inside = pty.openpty()
        command = (*AIRA, "account", "import", folder / "key.json", "--password-file", folder / "password")
        self._process = subprocess.Popen(
            [str(word) for word in command], stdin=inside, stdout=inside, stderr=inside, start_new_session=True
        )
        os.close(inside)
        self.shown = ""

    def until(self, words: str) -> None:
        deadline = time.monotonic() + 60
        while words not in self.shown:
            assert time.monotonic() < deadline, self.shown
            if select.select([self._terminal], [], [], 0.1)[0]:
                try:
                    self.shown += os.read(self._terminal, 4096).decode()
                except OSError:
                    return

    def type(self, text: str) -> None:
        os.write(self._terminal, text.encode())

    def interrupt(self) -> None:
        self._process.send_signal(signal.SIGINT)

    def end(self) -> int:
        self.until("the end of the terminal")
        os.close(self._terminal)
        return self._process.wait(60)


def test_a_typed_key_is_not_echoed(tmp_path: Path) -> None:
    typing = Typing(tmp_path)
    typing.until("private key: ")
    typing.type(f"{KEY}\n")
    assert typing.end() == 0
    assert ADDRESS in typing.shown
    assert KEY not in typing.shown


def test_ctrl_c_at_the_prompt_ends_the_command(tmp_path: Path) -> None:
    typing = Typing(tmp_path)
    typing.until("private key: ")
    typing.interrupt()
    assert typing.end() == 130
    assert "Traceback" not in typing.shown
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def misleading(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A keyfile that states another address than that of its key, and the file of its password."""
    folder = tmp_path_factory.mktemp("misleading")
    keyfile, password = folder / "account.json", folder / "password"
    invoke("account", "new", keyfile, "--password-file", password)
    keyfile.write_text(json.dumps(json.loads(keyfile.read_text()) | {"address": "00" * 20}))
    return keyfile, password


def test_show_refuses_an_address_that_is_not_that_of_the_key(misleading: tuple[Path, Path]) -> None:
    keyfile, password = misleading
    refused(
        invoke("account", "show", keyfile, "--password-file", password),
        KeyfileError,
        f"0x{'0' * 40}",
        code="keyfile-address-wrong",
    )
    configured = {"AIRA_KEYFILE": str(keyfile), "AIRA_KEYFILE_PASSWORD_FILE": str(password)}
    refused(invoke("account", "show", **configured), KeyfileError, f"0x{'0' * 40}", code="keyfile-address-wrong")
    refused(
        invoke("account", "show", keyfile, AIRA_KEYFILE_PASSWORD_FILE=str(password)),
        KeyfileError,
        code="keyfile-address-wrong",
    )


def test_show_takes_no_notice_of_the_password_of_another_keyfile(misleading: tuple[Path, Path], tmp_path: Path) -> None:
    keyfile, _ = misleading
    other = tmp_path / "password"
    other.write_text("of another one")
    assert invoke("account", "show", keyfile, AIRA_KEYFILE_PASSWORD_FILE=str(other)).stdout == f"0x{'0' * 40}\n"
    refused(invoke("account", "show", keyfile, "--password-file", other), "wrong-password")


def test_show_says_when_a_keyfile_has_no_address(misleading: tuple[Path, Path], tmp_path: Path) -> None:
    keyfile, _ = misleading
    empty = tmp_path / "empty.json"
    empty.write_text(json.dumps(json.loads(keyfile.read_text()) | {"address": ""}))
    refused(invoke("account", "show", empty), "account-missing", "does not contain its address")
