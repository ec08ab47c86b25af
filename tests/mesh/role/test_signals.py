"""How a program that runs in this process ends: by signals, errors and groups of errors."""

from __future__ import annotations

import asyncio
import signal
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

import pytest

from mesh.errors import AiraError, ConfigurationError, NetworkUnavailable, RemoteError
from mesh.role.running import run_to_end, run_until_stopped
from tests.support.commands import run

if TYPE_CHECKING:
    from collections.abc import Callable

BOTH = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])


class Work:
    """Work that gets a signal while it runs."""

    def __init__(self, number: signal.Signals) -> None:
        self._number = number
        self.cleaned_up = False

    async def run(self) -> None:
        try:
            signal.raise_signal(self._number)
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)
            self.cleaned_up = True


class IgnoresCancellation(Work):
    """Work that ends normally although it was cancelled."""

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
@pytest.mark.parametrize("kind", [Work, IgnoresCancellation])
def test_a_command_that_was_stopped_exits_with_130(number: signal.Signals, kind: type[Work]) -> None:
    work = kind(number)
    assert code_of(lambda: run_to_end(work.run)) == 130
    assert work.cleaned_up


@BOTH
def test_a_server_that_was_stopped_ends_normally(number: signal.Signals) -> None:
    work = Work(number)
    run_until_stopped(work.run)
    assert work.cleaned_up


@BOTH
@pytest.mark.parametrize("stopped", [True, False])
def test_the_previous_signal_handlers_are_restored(number: signal.Signals, stopped: bool) -> None:
    received: list[int] = []
    before = signal.signal(number, lambda number, frame: received.append(number))
    try:
        run_until_stopped(Work(number).run if stopped else fail_together)
        signal.raise_signal(number)
    finally:
        signal.signal(number, before)
    assert received == [number]


def test_the_first_error_of_a_group_is_printed_with_its_hint(capsys: pytest.CaptureFixture[str]) -> None:
    error = NetworkUnavailable(("tcp/127.0.0.1:1",), "no answer")
    assert code_of(lambda: run_to_end(lambda: fail_together(error, ConfigurationError("other")))) == 1
    assert capsys.readouterr().err == f"aira: {error} [{error.code}]\n      {error.hint}\n"


@pytest.mark.parametrize(("error", "code"), [(ConfigurationError("so"), 2), (RemoteError("so"), 1)])
def test_the_kind_of_error_sets_the_exit_code(error: AiraError, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(lambda: run_until_stopped(lambda: fail_together(error))) == code
    assert capsys.readouterr() == ("", f"aira: so [{error.code}]\n")


def test_an_unexpected_error_is_never_hidden_in_a_group() -> None:
    with pytest.raises(ExceptionGroup) as group:
        run_to_end(lambda: fail_together(RemoteError("so"), ZeroDivisionError()))
    assert group.value.subgroup(ZeroDivisionError) is not None


def test_an_error_during_cleanup_is_an_error_of_the_program() -> None:
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
    "module", ["mesh.cli", "click", "schemas.errors", "mesh.cli.up", "aiohttp", "zenoh", "mesh.dev.demo"]
)
def test_an_interrupt_while_modules_are_imported_ends_the_program_quietly(module: str) -> None:
    done = run(sys.executable, "-c", LOADING.format(module=module))
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
