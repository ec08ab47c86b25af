"""Bars of long work: on a terminal, on its standard error, and nowhere else."""

from __future__ import annotations

import os
import pty
import select
import sys
from typing import TYPE_CHECKING

import pytest

from mesh.cli import main
from tests.support.bags import Bag, BagMessage, string
from tests.support.objectives import objective

if TYPE_CHECKING:
    from pathlib import Path

COMMANDS = {
    "objective show FILE": "reading it.mcap",
    "objective check FILE": "reading it.mcap",
    "objective add FILE": "examining it.mcap",
    "objective convert BAG": "converting it.bag",
    "verify --objective FILE --result FILE": "verifying",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "it.mcap").write_bytes(objective(("/go", "there"), ("/go", "back")))
    (tmp_path / "it.bag").write_bytes(Bag([BagMessage("/go", string("there"), 1)]).encode())
    return tmp_path


def call(folder: Path, words: str, stderr: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a command in this process with this file descriptor as its standard error."""
    named = {"FILE": str(folder / "it.mcap"), "BAG": str(folder / "it.bag")}
    command = [named.get(word, word) for word in words.split()]
    if "convert" in words:
        command.append(str(folder / f"{os.urandom(4).hex()}.mcap"))
    monkeypatch.setenv("AIRA_DATA_DIR", str(folder / "data"))
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    with open(stderr, "w") as stream, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", stream)
        with pytest.raises(SystemExit) as ended:
            main(command)
    assert ended.value.code == (1 if "verify" in words else 0)


@pytest.mark.parametrize("words", COMMANDS)
def test_long_work_shows_a_progress_bar_on_a_terminal(
    folder: Path, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal, inside = pty.openpty()
    call(folder, words, os.dup(inside), monkeypatch)
    shown = ""
    while not (COMMANDS[words] in shown and "100%" in shown):
        assert select.select([terminal], [], [], 30)[0], shown
        shown += os.read(terminal, 1 << 16).decode()
    os.close(inside)
    os.close(terminal)
    printed = capsys.readouterr().out
    assert "%]" not in printed
    assert COMMANDS[words] not in printed


@pytest.mark.parametrize("words", COMMANDS)
def test_without_a_terminal_there_is_no_progress_bar(
    folder: Path, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    silent = folder / "stderr"
    silent.touch()
    call(folder, words, os.open(silent, os.O_WRONLY), monkeypatch)
    assert COMMANDS[words] not in silent.read_text() + capsys.readouterr().out
