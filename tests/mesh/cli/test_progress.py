"""Bars of long work: on a terminal, on its standard error, and nowhere else."""

from __future__ import annotations

import os
import pty
import subprocess
from typing import TYPE_CHECKING

import pytest

from tests.support.bags import Bag, BagMessage, string
from tests.support.commands import AIRA
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


def done(folder: Path, words: str, *, stderr: int) -> str:
    """What a command says on its standard output, its standard error being `stderr`."""
    named = {"FILE": str(folder / "it.mcap"), "BAG": str(folder / "it.bag")}
    command = [*map(str, AIRA), *(named.get(word, word) for word in words.split())]
    if "convert" in words:
        command.append(str(folder / f"{os.urandom(4).hex()}.mcap"))
    environment = {**os.environ, "AIRA_DATA_DIR": str(folder / "data"), "TERM": "xterm", "COLUMNS": "100"}
    return subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=stderr,
        stdin=subprocess.DEVNULL,
        env=environment,
        timeout=120,
        check=False,
    ).stdout.decode()


@pytest.mark.parametrize("words", COMMANDS)
def test_long_work_shows_a_bar_on_a_terminal_only(folder: Path, words: str) -> None:
    terminal, inside = pty.openpty()
    printed = done(folder, words, stderr=inside)
    os.close(inside)
    shown = os.read(terminal, 1 << 16).decode()
    os.close(terminal)
    assert COMMANDS[words] in shown
    assert "100%" in shown
    assert "%]" not in printed
    assert COMMANDS[words] not in printed


@pytest.mark.parametrize("words", COMMANDS)
def test_where_nobody_watches_there_is_no_bar(folder: Path, words: str) -> None:
    silent = folder / "stderr"
    with silent.open("wb") as stream:
        printed = done(folder, words, stderr=stream.fileno())
    assert COMMANDS[words] not in silent.read_text() + printed
