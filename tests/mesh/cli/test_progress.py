"""Bars of long work: on a terminal, on its standard error, and nowhere else; what is left after Ctrl-C."""

from __future__ import annotations

import io
import os
import pty
import re
import select
import sys
from base64 import b64encode
from random import Random
from typing import TYPE_CHECKING

import pytest

from mesh.cli import main
from mesh.role.running import INTERRUPTED
from tests.support.bags import Bag, BagMessage, string
from tests.support.commands import AIRA, SECONDS, environment
from tests.support.objectives import objective
from tests.support.ports import free_port

if TYPE_CHECKING:
    from pathlib import Path

CURSOR_HIDDEN, CURSOR_SHOWN = "\x1b[?25l", "\x1b[?25h"
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


class Terminal:
    """`aira` with these arguments in a terminal of its own."""

    def __init__(self, *words: str | Path) -> None:
        self.shown = ""
        self.pid, self._side = pty.fork()
        if self.pid == 0:
            os.execvpe(AIRA[0], [*AIRA, *map(str, words)], environment({"TERM": "xterm", "COLUMNS": "100"}))

    def read(self) -> bool:
        """Read what it writes next; False at its end."""
        assert select.select([self._side], [], [], SECONDS)[0], self.shown
        try:
            written = os.read(self._side, 1 << 16)
        except OSError:  # Linux: the other side is closed
            return False
        self.shown += written.decode()
        return bool(written)

    def press_ctrl_c(self) -> None:
        os.write(self._side, b"\x03")

    def end(self) -> int:
        """Read to the end; the exit code."""
        while self.read():
            pass
        os.close(self._side)
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


@pytest.fixture
def large(tmp_path: Path) -> Path:
    """A bag of few large messages, which can't be compressed much, so that converting them takes longer than the bar
    stands still."""
    path, texts = tmp_path / "large.bag", [b64encode(Random(n).randbytes(768 << 10)).decode() for n in range(10)]
    path.write_bytes(
        Bag([BagMessage("/go", string(texts[time % 10]), time) for time in range(1, 200)], per_chunk=10).encode()
    )
    return path


@pytest.mark.full
def test_a_bar_of_few_large_messages_shows_what_is_between(large: Path) -> None:
    terminal = Terminal("objective", "convert", large)
    assert terminal.end() == 0
    converting = terminal.shown[terminal.shown.index("converting") :]
    shown = {int(share) for share in re.findall(r"(\d+)%", converting)}
    assert shown - {0, 100}


def test_ctrl_c_restores_the_cursor_and_leaves_no_file(large: Path) -> None:
    terminal = Terminal("objective", "convert", large)
    while "converting" not in terminal.shown:
        assert terminal.read()
    terminal.press_ctrl_c()
    assert terminal.end() == INTERRUPTED
    assert terminal.shown.rindex(CURSOR_SHOWN) > terminal.shown.rindex(CURSOR_HIDDEN)
    assert os.listdir(large.parent) == [large.name]


def test_what_follows_a_ctrl_c_has_a_line_of_its_own() -> None:
    terminal = Terminal("router", "--listen", f"tcp/127.0.0.1:{free_port()}")
    while "other machines can't connect" not in terminal.shown:
        assert terminal.read()
    terminal.press_ctrl_c()
    assert terminal.end() == 0
    assert "^C\r\n" in terminal.shown


class InterruptedTerminal(io.StringIO):
    """A terminal at which Ctrl-C is pressed when the cursor has just been hidden."""

    def isatty(self) -> bool:
        return True

    def flush(self) -> None:
        if self.getvalue().count(CURSOR_HIDDEN) == 1 and CURSOR_SHOWN not in self.getvalue():
            raise KeyboardInterrupt


def test_ctrl_c_while_a_bar_is_drawn_first_restores_the_cursor(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", terminal := InterruptedTerminal())
    with pytest.raises(SystemExit) as ended:
        main(["objective", "check", str(folder / "it.mcap")])
    assert ended.value.code == INTERRUPTED
    assert terminal.getvalue().endswith(CURSOR_SHOWN)
