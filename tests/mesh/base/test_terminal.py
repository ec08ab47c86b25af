"""Output of `aira` on terminals of other encodings: no character ends a command."""

from __future__ import annotations

import io
import json
import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from mesh.__main__ import accept_all_characters
from tests.support.commands import AIRA, environment

BLINK = Path(__file__).parents[3] / "examples" / "blink" / "blink.mcap"
ENCODINGS = ("latin-1", "koi8-r", "ascii", "cp1251", "utf-8")
HELP = """
import click
from mesh.cli import main
from mesh.__main__ import accept_all_characters

def show(command, context):
    click.echo(command.get_help(context))
    for name in command.list_commands(context) if isinstance(command, click.Group) else ():
        below = command.get_command(context, name)
        show(below, click.Context(below, info_name=name, parent=context))

accept_all_characters()
show(main, click.Context(main, info_name="aira"))
"""


def printed(encoding: str, *command: str | bytes | Path, code: int = 0) -> tuple[str, str]:
    """What a command prints to stdout and stderr in this encoding; `code` is its exit code."""
    done = subprocess.run(command, env=environment({"PYTHONIOENCODING": encoding}), capture_output=True)
    assert done.returncode == code, done.stderr
    assert b"Traceback" not in done.stderr
    return done.stdout.decode(encoding), done.stderr.decode(encoding)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_help_of_every_command_is_printed(encoding: str) -> None:
    text, _ = printed(encoding, sys.executable, "-c", HELP)
    assert text.count("Usage: aira") > 50
    assert ("NAME=VALUE … |" if encoding in ("utf-8", "cp1251") else "NAME=VALUE ... |") in text


@pytest.mark.parametrize(("encoding", "bar"), [("latin-1", "#"), ("koi8-r", "█"), ("ascii", "#"), ("utf-8", "█")])
def test_a_table_with_bars_is_printed(encoding: str, bar: str) -> None:
    text, _ = printed(encoding, *AIRA, "objective", "show", BLINK)
    assert text.splitlines()[-1].endswith(f" {bar}")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_an_error_may_name_anything(encoding: str) -> None:
    _, said = printed(encoding, *AIRA, "objective", "show", "Ж…█●\U0001f600", code=2)
    assert said.startswith("aira: ")
    assert "[not-a-file-or-cid]" in said


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_file_name_that_is_no_text_is_printed(encoding: str, tmp_path: Path) -> None:
    file = os.fsencode(tmp_path) + b"/caf\xe9"
    Path(os.fsdecode(file)).touch()
    text, _ = printed(encoding, *AIRA, "cid", file, BLINK)
    assert text.splitlines()[0].endswith("/caf?")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_json_keeps_every_character(encoding: str, tmp_path: Path) -> None:
    source = tmp_path / "model.json"
    source.write_text(json.dumps({"format": "aira-model/1", "title": "Лампа №1 \U0001f600"}), encoding="utf-8")
    printed(encoding, *AIRA, "model", "new", source, "--out", source, "--replace")
    text, _ = printed(encoding, *AIRA, "model", "show", source, "--json")
    assert json.loads(text)["description"]["title"] == "Лампа №1 \U0001f600"


@pytest.mark.parametrize("encoding", ["latin-1", "ascii"])
def test_a_progress_bar_is_shown(encoding: str, tmp_path: Path) -> None:
    lines = tmp_path / "Лампа….jsonl"
    lines.write_text('{"topic": "/blink"}\n' * 5_000)
    ours, theirs = pty.openpty()
    command = [*AIRA, "objective", "pack", str(lines), "--out", str(tmp_path / "out.mcap")]
    process = subprocess.Popen(command, stderr=theirs, env=environment({"PYTHONIOENCODING": encoding}))
    os.close(theirs)
    shown = b""
    try:
        while some := os.read(ours, 65_536):
            shown += some
    except OSError:  # the end of a terminal
        os.close(ours)
    assert process.wait() == 0, shown
    assert b"packing" in shown
    assert b"100%" in shown


def test_an_embedding_programs_stream_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    own = io.StringIO()
    monkeypatch.setattr(sys, "stdout", own)
    monkeypatch.setattr(sys, "stderr", own)
    accept_all_characters()
    print("…")
    assert own.getvalue() == "…\n"
