"""How programs end: by themselves, by a signal, by an error that a person can mend, by one that nobody foresaw."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from typing import Final

import pytest

from tests.support.commands import environment, run

PROGRAM: Final = """
import asyncio, signal, sys, threading, time
from mesh.errors import ConfigurationError, InputError, NetworkUnavailable, RemoteError
from mesh.running import run_to_end, run_until_stopped

async def done():
    print("done")

async def wait():
    try:
        print("waiting", flush=True)
        await asyncio.Event().wait()
    finally:
        print("tidied up", flush=True)

async def tidy_for_long():
    try:
        print("waiting", flush=True)
        await asyncio.Event().wait()
    finally:
        print("tidying", flush=True)
        await asyncio.sleep(60)

async def tidy_while_another_thread_gets_the_signals():
    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    await tidy_for_long()

async def fail(error):
    raise error

async def fail_together(*errors):
    async with asyncio.TaskGroup() as tasks:
        for error in errors:
            tasks.create_task(fail(error))

def interrupted():
    raise KeyboardInterrupt

{call}
print("after", flush=True)
"""


def program(call: str) -> tuple[str, str, str]:
    return sys.executable, "-c", PROGRAM.format(call=call)


def ended(call: str) -> subprocess.CompletedProcess[str]:
    return run(*program(call))


def signalled(call: str, *signals: signal.Signals) -> tuple[int, str, str]:
    """Exit code, output and errors of a program that gets signals, each after it has said something."""
    pipe = subprocess.PIPE
    with subprocess.Popen(program(call), stdout=pipe, stderr=pipe, text=True, env=environment({})) as process:
        assert process.stdout is not None
        said = ""
        for number in signals:
            said += process.stdout.readline()
            process.send_signal(number)
        sent = time.monotonic()
        output, errors = process.communicate(timeout=30)
        assert time.monotonic() - sent < 5
        return process.returncode, said + output, errors


@pytest.mark.parametrize("how", ["run_to_end", "run_until_stopped"])
def test_what_comes_to_its_end_goes_on(how: str) -> None:
    done = ended(f"{how}(done)")
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\nafter\n", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_breaks_off_what_has_an_end(number: signal.Signals) -> None:
    assert signalled("run_to_end(wait)", number) == (130, "waiting\ntidied up\n", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_the_normal_end_of_a_server(number: signal.Signals) -> None:
    assert signalled("run_until_stopped(wait)", number) == (0, "waiting\ntidied up\nafter\n", "")


@pytest.mark.parametrize("main", ["tidy_for_long", "tidy_while_another_thread_gets_the_signals"])
def test_a_second_ctrl_c_does_not_wait_for_the_tidying(main: str) -> None:
    code, output, errors = signalled(f"run_to_end({main})", signal.SIGINT, signal.SIGINT)
    assert (code, output, errors) == (130, "waiting\ntidying\n", "")


def test_an_interrupt_before_the_loop_listens_is_one_too() -> None:
    done = ended("run_to_end(interrupted)")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize(
    ("error", "code"),
    [("InputError", 2), ("ConfigurationError", 2), ("RemoteError", 1)],
)
def test_an_error_that_can_be_mended_is_two_lines_and_a_code(error: str, code: int) -> None:
    done = ended(f"run_to_end(lambda: fail({error}('the lamp is broken', hint='buy another')))")
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr == "aira: the lamp is broken\n      buy another\n"


def test_an_error_without_hint_is_one_line() -> None:
    assert ended("run_until_stopped(lambda: fail(RemoteError('gone')))").stderr == "aira: gone\n"


def test_an_error_does_not_show_what_opens_doors() -> None:
    said = ended("run_to_end(lambda: fail(RemoteError('none at http://me:hunter2@node/v3/0123456789abcdef')))").stderr
    assert said == "aira: none at http://node/v3/…\n"


def test_tasks_that_fail_together_for_one_reason_are_one_line() -> None:
    done = ended("run_to_end(lambda: fail_together(InputError('one'), InputError('other')))")
    assert (done.returncode, done.stderr) == (2, "aira: one\n")


def test_what_nobody_foresaw_is_shown_whole() -> None:
    done = ended("run_to_end(lambda: fail(ZeroDivisionError()))")
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert "ZeroDivisionError" in done.stderr


def test_what_nobody_foresaw_is_not_hidden_behind_what_was() -> None:
    done = ended("run_to_end(lambda: fail_together(InputError('one'), ZeroDivisionError()))")
    assert done.returncode == 1
    assert "ZeroDivisionError" in done.stderr


def test_a_cancellation_that_no_signal_asked_for_is_no_quiet_end() -> None:
    done = ended("run_to_end(lambda: fail(asyncio.CancelledError()))")
    assert done.returncode == 1
    assert "CancelledError" in done.stderr
