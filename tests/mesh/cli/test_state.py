"""`aira state`: what its commands print, write and refuse."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from click.testing import CliRunner

from mesh.agent.ledger import Ledger
from mesh.cli import main
from tests.mesh.ops.state.conftest import ADDRESS, CHAIN, JOB, Folder, folder
from tests.support.commands import aira, refused

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result

__all__ = ["folder"]


def call(*words: str | Path) -> Result:
    return CliRunner().invoke(main, ["state", *map(str, words)])


def test_show_lists_the_state_of_agents(folder: Folder) -> None:
    done = call("show", "--data-dir", folder.path)
    assert done.exit_code == 0, done.output
    head, row, content, transactions = done.stdout.splitlines()
    assert head.split("  ")[0] == "ACCOUNT"
    assert row.split() == [ADDRESS, CHAIN, "99", "1", "running", "none", "1", "1", "-"]
    assert content == f"{ADDRESS}  2 files, 27 bytes (10 bytes pinned)"
    assert transactions == "pending transactions  1"


def test_show_prints_json(folder: Folder) -> None:
    found = json.loads(call("show", "--json", "--data-dir", folder.path).stdout)
    assert found["folder"] == str(folder.path)
    assert found["accounts"][0]["chains"] == [
        {
            "chain": CHAIN,
            "block": 99,
            "jobs": {"running": 1},
            "waiting": 1,
            "recordings": 1,
            "verdicts": {},
            "provides": [],
        }
    ]


def test_a_backup_is_created_shown_and_restored(folder: Folder, tmp_path: Path) -> None:
    made = call("backup", tmp_path / "it.tar.zst", "--data-dir", folder.path)
    assert made.exit_code == 0, made.output
    assert f"accounts   {ADDRESS}" in made.stdout
    assert "open jobs  1" in made.stdout

    shown = call("show", tmp_path / "it.tar.zst")
    assert shown.stdout.splitlines()[3] == "files      1 content, 1 ledgers, 1 pins, 1 recordings, 1 transactions"
    assert shown.stdout.splitlines()[-1] == "checksums  valid"

    restored = call("restore", tmp_path / "it.tar.zst", "--data-dir", tmp_path / "new")
    assert restored.exit_code == 0, restored.output
    assert f"{JOB.address}  running" in restored.stdout
    row = call("show", "--data-dir", folder.path).stdout.splitlines()[1]
    assert call("show", "--data-dir", tmp_path / "new").stdout.splitlines()[1] == row


def test_backup_and_restore_print_json(folder: Folder, tmp_path: Path) -> None:
    file = tmp_path / "it"
    made = json.loads(call("backup", file, "--json", "--content", "all", "--data-dir", folder.path).stdout)
    assert (made["file"], made["files"], made["jobs"], made["missing"]) == (str(file), 2, 1, [])
    shown = json.loads(call("show", file, "--json").stdout)
    assert shown["files"]["content"] == 2
    restored = json.loads(call("restore", file, "--json", "--data-dir", tmp_path / "new").stdout)
    assert restored["jobs"] == {JOB.address: "running"}
    assert restored["aside"] is None


def test_an_existing_state_is_an_error_with_a_hint(folder: Folder, tmp_path: Path) -> None:
    call("backup", tmp_path / "it", "--data-dir", folder.path)
    done = call("restore", tmp_path / "it", "--data-dir", folder.path)
    assert "--existing set-aside" in refused(done, "state-exists", folder.path)
    again = call("restore", tmp_path / "it", "--data-dir", folder.path, "--existing", "set-aside")
    assert again.exit_code == 0
    assert f"old state    {folder.path}/.replaced-" in again.stdout


async def test_a_state_in_use_is_refused_with_every_option(folder: Folder, tmp_path: Path) -> None:
    backup = ("state", "backup", tmp_path / "it", "--data-dir", folder.path)
    restore = ("state", "restore", tmp_path / "it", "--data-dir", folder.path, "--existing", "set-aside")
    async with Ledger(folder.ledger):
        assert aira(*backup).returncode == 0
        done = aira(*restore)
    refused(done, "state-in-use", folder.ledger)


def test_mistakes_are_one_line_and_a_hint(folder: Folder, tmp_path: Path) -> None:
    (tmp_path / "other").write_text("something else")
    for words in (
        ("show", "--data-dir", tmp_path / "nothing"),
        ("show", tmp_path / "other"),
        ("show", tmp_path / "absent"),
        ("backup", tmp_path / "it", "--data-dir", tmp_path / "nothing"),
        ("backup", tmp_path / "no" / "folder", "--data-dir", folder.path),
        ("restore", tmp_path / "other", "--data-dir", tmp_path / "new"),
    ):
        done = call(*words)
        assert done.exit_code == 2, (words, done.output)
        said, *hint = done.stderr.splitlines()
        assert said.startswith("aira: ")
        assert len(hint) <= 1
