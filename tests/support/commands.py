"""The command line: run to its end in this process or its own, interrupted, or serving."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from click.testing import CliRunner

from mesh.errors import ConfigurationError, InputError
from tests.support.processes import Server
from tests.support.waiting import wait_until

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence

    import click
    from click.testing import Result

    from mesh.errors import AiraError

CODES = Path(__file__).parents[2] / "docs" / "reference" / "codes.md"
AIRA = (sys.executable, "-m", "mesh")
SECONDS = 200.0
SOON = 40
"""Seconds in which a signal ends a command on a busy machine; on an idle one it takes less than one."""


def aira(*arguments: str | Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run `aira` with these arguments and environment variables to its end."""
    return run(*AIRA, *arguments, **variables)


def invoke(*arguments: str | Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """The same in this process, which takes a fraction of the time. Not for tests that run in an event loop."""
    from mesh.cli import main

    words = [str(word) for word in arguments]
    inherited: dict[str, str | None] = {name: None for name in os.environ if name.startswith("AIRA_")}
    done = CliRunner().invoke(main, words, env=inherited | variables, catch_exceptions=False, prog_name="aira")
    return subprocess.CompletedProcess(words, done.exit_code, done.stdout, done.stderr)


def run(*command: str | Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    words = [str(word) for word in command]
    return subprocess.run(words, env=environment(variables), capture_output=True, text=True, timeout=SECONDS)


def coroutine(command: click.Command) -> Callable[..., Coroutine[Any, Any, None]]:
    """The coroutine function of a command that takes settings, for tests that run in an event loop."""
    assert command.callback is not None
    function: Callable[..., Coroutine[Any, Any, None]] = command.callback.__wrapped__  # type: ignore[attr-defined]
    return function


def refused(
    done: subprocess.CompletedProcess[str] | Result,
    error: type[AiraError] | str,
    *values: object,
    exit_code: int | None = None,
    code: str = "",
) -> str:
    """Assert that a command failed with this error (a code, or a class, then with `code` or any of it) in one line with
    its code and these values.

    Returns the hint. The exit code must be the error's as documented, unless another is given.
    """
    ended = done.returncode if isinstance(done, subprocess.CompletedProcess) else done.exit_code
    if isinstance(error, str):
        codes, own = {error}, documented()[error][1]
    else:
        names = {one.__name__ for one in _with_subclasses(error)}
        codes = {code} if code else {one for one, (name, _) in documented().items() if name in names}
        own = 2 if issubclass(error, InputError | ConfigurationError) else 1
    lines = done.stderr.splitlines()
    said = (number for number, line in enumerate(lines) if line.startswith("aira: ") and line.endswith("]"))
    place = next(said, len(lines))  # after what it waits for, on a busy machine
    assert ended == (own if exit_code is None else exit_code), (done.stdout, done.stderr)
    assert done.stdout == ""
    assert len(lines) - place in (1, 2), done.stderr
    assert lines[place].rpartition(" ")[2] in {f"[{one}]" for one in codes}, lines[place]
    for value in values:
        assert str(value) in lines[place], lines[place]
    return lines[place + 1].strip() if lines[place + 1 :] else ""


@cache
def documented() -> Mapping[str, tuple[str, int]]:
    """The class and the exit code of each error, by its code, as docs/reference/codes.md says."""
    rows = re.findall(r"^\| `([\w-]+)` \| `(\w+)` \| (\d) \|", CODES.read_text(), re.MULTILINE)
    return {code: (name, int(number)) for code, name, number in rows}


def _with_subclasses(error: type[AiraError]) -> Iterator[type[AiraError]]:
    yield error
    for subclass in error.__subclasses__():
        yield from _with_subclasses(subclass)


class Interrupted:
    """`aira` with these arguments, which gets a signal `after` seconds after it printed `at`.

    With `loads` it gets it when it has loaded that module.
    """

    def __init__(
        self,
        *arguments: str | Path,
        at: str = "",
        loads: str = "",
        after: float = 0.0,
        by: signal.Signals = signal.SIGINT,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        with subprocess.Popen(
            [*AIRA, *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment({"PYTHONPROFILEIMPORTTIME": "1" if loads else "", **(variables or {})}),
        ) as process:
            assert process.stdout is not None
            assert process.stderr is not None
            said = ""
            while loads and said.rpartition("|")[2].strip() != loads:
                said = process.stderr.readline()
                assert said, f"it ended without loading {loads}"
            while at not in said:
                said = process.stdout.readline()
                assert said, f"it ended without saying {at!r}: {process.stderr.read()}"
            time.sleep(after)
            process.send_signal(by)
            sent = time.monotonic()
            self.output, self.errors = process.communicate(timeout=SECONDS)
            self.seconds = time.monotonic() - sent
            self.code = process.returncode


class Serving(Server):
    """A command that serves until it is stopped; ready when it has printed `says`."""

    name = "command"

    def __init__(self, *command: str | Path, says: str, variables: Mapping[str, str] | None = None) -> None:
        super().__init__()
        self._command = command
        self._says = says
        self._variables = dict(variables or {})

    def command(self) -> Sequence[str | Path]:
        """The command, with the variables set by `env`."""
        settings = [f"{name}={value}" for name, value in self._variables.items()]
        return ["env", "-u", "AIRA_CONFIG", "PYTHONUNBUFFERED=1", *settings, *self._command]

    def is_ready(self) -> bool:
        """Whether it has printed that."""
        return self._says in self.log()

    def wait_until_said(self, words: str) -> None:
        """Return when its output has these words, now or already."""
        try:
            wait_until(lambda: words in self.log(), what=repr(words), seconds=SECONDS)
        except AssertionError as late:
            raise AssertionError(f"{late}:\n{self.log()}") from None

    def wait(self) -> int:
        """Wait until the command ends by itself; its exit code."""
        process, self._process = self._running(), None
        return process.wait(SECONDS)

    def end(self, how: signal.Signals) -> tuple[int, float]:
        """Send a signal and wait for the end; its exit code, and the seconds that it took."""
        process, self._process = self._running(), None
        process.send_signal(how)
        sent = time.monotonic()
        return process.wait(SECONDS), time.monotonic() - sent


def environment(variables: Mapping[str, str]) -> dict[str, str]:
    """The variables of a process that has no settings of this one's."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("AIRA_")}
    return inherited | dict(variables)
