"""Run in an environment that has only a wheel: every command, each in a process of its own, with plausible arguments.

Prints a JSON object for each: its words, its exit code (null: it was still running) and what it wrote to stderr.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import time
from typing import TYPE_CHECKING

import click

from mesh.cli import main

if TYPE_CHECKING:
    from collections.abc import Iterator

CID = "QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82"
SECONDS = 3.0
AT_ONCE = 4


def leaves(command: click.Command, words: tuple[str, ...], context: click.Context) -> Iterator[tuple[str, ...]]:
    """The words of each command, with a value for everything that it requires."""
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            try:
                found = command.get_command(context, name)
            except SystemExit:  # it says why; the process that runs it will, too
                found = click.Command(name)
            assert found is not None
            yield from leaves(found, (*words, name), context)
        return
    required = [parameter for parameter in command.params if parameter.required]
    values = [word for one in required for word in (*one.opts[:1] * isinstance(one, click.Option), value_for(one))]
    yield (*words, *values)


def value_for(parameter: click.Parameter) -> str:
    kind = parameter.type
    if isinstance(kind, click.Choice):
        return str(kind.choices[0])
    if isinstance(kind, click.Path):
        return "/dev/null"
    return {"integer": "1", "float": "1", "integer range": "1"}.get(kind.name, CID)


def start(words: tuple[str, ...]) -> tuple[int, int, tuple[str, ...], float]:
    """Run a command in a fork; returns its pid, the file of its stderr, its words, and when it began."""
    errors, name = tempfile.mkstemp()
    os.unlink(name)
    pid = os.fork()
    if pid == 0:
        nothing = os.open(os.devnull, os.O_RDWR)
        for target, file in ((0, nothing), (1, nothing), (2, errors)):
            os.dup2(file, target)
        try:
            main(args=list(words), prog_name="aira")
        finally:
            sys.stderr.flush()
    return pid, errors, words, time.monotonic()


def finish(running: tuple[int, int, tuple[str, ...], float]) -> bool:
    """Whether it has ended, or was ended; then the object is printed."""
    pid, errors, words, began = running
    ended, status = os.waitpid(pid, os.WNOHANG)
    code: int | None = None
    if ended:
        code = os.waitstatus_to_exitcode(status)
    elif time.monotonic() - began < (SECONDS if b"[package-missing]" not in os.pread(errors, 65_536, 0) else 30):
        return False  # one that has said what it lacks is about to end
    else:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    os.lseek(errors, 0, os.SEEK_SET)
    with open(errors, encoding="utf-8") as file:
        print(json.dumps({"words": words, "code": code, "stderr": file.read()}), flush=True)
    return True


def run_all() -> None:
    """Run them, some at a time."""
    running: list[tuple[int, int, tuple[str, ...], float]] = []
    for words in leaves(main, (), click.Context(main)):
        running.append(start(words))
        while len(running) >= AT_ONCE:
            running = [one for one in running if not finish(one)]
            time.sleep(0.01)
    while running:
        running = [one for one in running if not finish(one)]
        time.sleep(0.01)


if __name__ == "__main__":
    run_all()
