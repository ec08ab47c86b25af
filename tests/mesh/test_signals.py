"""The ends of a program in this process: what signals, errors and groups of errors come to."""

from __future__ import annotations

import asyncio
import signal
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

import pytest

from mesh.errors import ConfigurationError, NetworkUnavailable, RemoteError
from mesh.running import run_to_end, run_until_stopped
from tests.support.commands import run

if TYPE_CHECKING:
    from collections.abc import Callable

BOTH = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])


class Work:
    """Something to do that gets a signal while it is done."""

    def __init__(self, number: signal.Signals) -> None:
        self._number = number
        self.tidied = False

    async def run(self) -> None:
        try:
            signal.raise_signal(self._number)
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)
            self.tidied = True


class Stubborn(Work):
    """Work that comes to its end although it was told to stop."""

    async def run(self) -> None:
        with suppress(asyncio.CancelledError):
            await super().run()


async def fail_together(*errors: Exception) -> None:
    async def fail(error: Exception) -> None:
        raise error

    async with asyncio.TaskGroup() as outer, asyncio.TaskGroup() as inner:
        outer.create_task(asyncio.sleep(60 if errors else 0))
        for error in errors:
            inner.create_task(fail(error))


def code_of(program: Callable[[], None]) -> object:
    with pytest.raises(SystemExit) as ended:
        program()
    return ended.value.code


@BOTH
@pytest.mark.parametrize("kind", [Work, Stubborn])
def test_what_has_an_end_and_was_stopped_exits_with_130(number: signal.Signals, kind: type[Work]) -> None:
    work = kind(number)
    assert code_of(lambda: run_to_end(work.run)) == 130
    assert work.tidied


@BOTH
def test_a_server_that_was_stopped_ends_normally(number: signal.Signals) -> None:
    work = Work(number)
    run_until_stopped(work.run)
    assert work.tidied


@BOTH
@pytest.mark.parametrize("stopped", [True, False])
def test_afterwards_signals_mean_what_they_did_before(number: signal.Signals, stopped: bool) -> None:
    heard: list[int] = []
    before = signal.signal(number, lambda number, frame: heard.append(number))
    try:
        run_until_stopped(Work(number).run if stopped else fail_together)
        signal.raise_signal(number)
    finally:
        signal.signal(number, before)
    assert heard == [number]


def test_of_a_group_the_first_error_is_told_with_its_hint(capsys: pytest.CaptureFixture[str]) -> None:
    error = NetworkUnavailable(("tcp/127.0.0.1:1",), "no answer")
    assert code_of(lambda: run_to_end(lambda: fail_together(error, ConfigurationError("other")))) == 1
    assert capsys.readouterr().err == f"aira: {error}\n      {error.hint}\n"


@pytest.mark.parametrize(("error", "code"), [(ConfigurationError("so"), 2), (RemoteError("so"), 1)])
def test_whose_fault_it_is_tells_the_exit_code(error: Exception, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(lambda: run_until_stopped(lambda: fail_together(error))) == code
    assert capsys.readouterr() == ("", "aira: so\n")


def test_an_error_that_nobody_foresaw_is_never_hidden_in_a_group() -> None:
    with pytest.raises(ExceptionGroup) as group:
        run_to_end(lambda: fail_together(RemoteError("so"), ZeroDivisionError()))
    assert group.value.subgroup(ZeroDivisionError) is not None


def test_an_error_while_tidying_up_is_told() -> None:
    async def main() -> None:
        try:
            await Work(signal.SIGINT).run()
        finally:
            raise RemoteError("the ledger was not closed")

    assert code_of(lambda: run_to_end(main)) == 1


LOADING = """
import signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            signal.raise_signal(signal.SIGINT)

from mesh.__main__ import main
sys.meta_path.insert(0, Interrupting())
sys.argv = ["aira", "demo"]
main()
"""


@pytest.mark.parametrize(
    "module", ["mesh.cli", "click", "schemas.errors", "mesh.cli.demo", "web3", "zenoh", "mesh.demo.narration"]
)
def test_an_interrupt_while_a_program_is_being_loaded_ends_it_quietly(module: str) -> None:
    done = run(sys.executable, "-c", LOADING.format(module=module))
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
