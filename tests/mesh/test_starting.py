"""What a server that waits for ever says of the files that it waits for."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from mesh.chain import Account
from mesh.errors import ConfigurationError
from mesh.settings import Settings
from mesh.starting import lacking

if TYPE_CHECKING:
    from pathlib import Path

NOBODY = 65_534


def settings(folder: Path, *, patience: float = -1) -> Settings:
    files = {"keyfile": str(folder / "account.json"), "keyfile_password_file": str(folder / "password")}
    return Settings(connect_timeout=patience, **files)  # type: ignore[arg-type]


def test_files_are_waited_for_until_all_of_them_are_there(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    waiting = lacking(settings(tmp_path))
    assert next(waiting, "over") is None
    (tmp_path / "account.json").write_text("{}")
    assert next(waiting, "over") is None
    (tmp_path / "password").write_text("secret\n")
    assert next(waiting, "over") == "over"
    both = f"{tmp_path / 'account.json'}, {tmp_path / 'password'}"
    assert caplog.messages == [f"waiting: files that are not there yet: {both}", "the files are there"]


def test_with_an_end_to_its_patience_no_file_is_waited_for(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert list(lacking(settings(tmp_path, patience=10))) == []
    assert caplog.messages == []


def test_a_folder_in_a_file_s_place_is_left_to_who_reads_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "account.json").mkdir()
    (tmp_path / "password").write_text("secret\n")
    assert list(lacking(settings(tmp_path))) == []
    assert caplog.messages == []
    with pytest.raises(ConfigurationError, match="Is a directory"):
        Account.from_keyfile(tmp_path / "account.json", tmp_path / "password")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes files that another user may not read")
def test_files_of_another_user_are_one_line_with_what_to_do(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("account.json", "password"):
        (tmp_path / name).touch(mode=0o600)
    waiting = lacking(settings(tmp_path))
    os.seteuid(NOBODY)
    try:
        assert next(waiting, "over") is None
    finally:
        os.seteuid(0)
    assert next(waiting, "over") == "over"
    both = f"{tmp_path / 'account.json'}, {tmp_path / 'password'}"
    hint = f"give them to it: chown -R {NOBODY} FOLDER"
    assert caplog.messages == [f"waiting: files that user {NOBODY} may not read: {both}; {hint}"]
