"""How a program ends: by itself, by a signal, by an expected error, by an unexpected one."""

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
from mesh.role.running import run_to_end, run_until_stopped

async def done():
    print("done")

async def wait():
    try:
        print("waiting", flush=True)
        await asyncio.Event().wait()
    finally:
        print("cleaned up", flush=True)

async def clean_up_slowly():
    try:
        print("waiting", flush=True)
        await asyncio.Event().wait()
    finally:
        print("cleaning up", flush=True)
        await asyncio.sleep(60)

async def clean_up_while_another_thread_gets_the_signals():
    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    await clean_up_slowly()

async def warn(text):
    import logging
    logging.getLogger("mesh.chain.rpc").warning("%s", text)

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
    """Exit code, output and errors of a program that gets signals, each after it printed a line."""
    pipe = subprocess.PIPE
    with subprocess.Popen(program(call), stdout=pipe, stderr=pipe, text=True, env=environment({})) as process:
        assert process.stdout is not None
        printed = ""
        for number in signals:
            printed += process.stdout.readline()
            process.send_signal(number)
        sent = time.monotonic()
        output, errors = process.communicate(timeout=30)
        assert time.monotonic() - sent < 20
        return process.returncode, printed + output, errors


@pytest.mark.parametrize("how", ["run_to_end", "run_until_stopped"])
def test_a_program_continues_after_its_main_function(how: str) -> None:
    done = ended(f"{how}(done)")
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\nafter\n", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_interrupts_a_command(number: signal.Signals) -> None:
    assert signalled("run_to_end(wait)", number) == (130, "waiting\ncleaned up\n", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_the_normal_end_of_a_server(number: signal.Signals) -> None:
    assert signalled("run_until_stopped(wait)", number) == (0, "waiting\ncleaned up\nafter\n", "")


@pytest.mark.parametrize("main", ["clean_up_slowly", "clean_up_while_another_thread_gets_the_signals"])
def test_a_second_ctrl_c_does_not_wait_for_the_cleanup(main: str) -> None:
    code, output, errors = signalled(f"run_to_end({main})", signal.SIGINT, signal.SIGINT)
    assert (code, output, errors) == (130, "waiting\ncleaning up\n", "")


def test_an_interrupt_before_the_loop_handles_signals_ends_the_program_too() -> None:
    done = ended("run_to_end(interrupted)")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize(
    ("error", "code", "exit_code"),
    [
        ("InputError", "input-error", 2),
        ("ConfigurationError", "configuration-error", 2),
        ("RemoteError", "remote-error", 1),
    ],
)
def test_an_expected_error_is_two_lines_and_an_exit_code(error: str, code: str, exit_code: int) -> None:
    done = ended(f"run_to_end(lambda: fail({error}('the lamp is broken', hint='buy another')))")
    assert (done.returncode, done.stdout) == (exit_code, "")
    assert done.stderr == f"aira: the lamp is broken [{code}]\n      buy another\n"


def test_an_error_without_hint_is_one_line() -> None:
    assert ended("run_until_stopped(lambda: fail(RemoteError('gone')))").stderr == "aira: gone [remote-error]\n"


def test_an_error_does_not_show_secrets_of_a_url() -> None:
    errors = ended("run_to_end(lambda: fail(RemoteError('none at http://me:hunter2@node/v3/0123456789abcdef')))").stderr
    assert errors == "aira: none at http://node/v3/… [remote-error]\n"


def test_a_warning_is_one_line_without_secrets_and_controls_no_terminal() -> None:
    url = "https://mainnet.example/v3/9aa3d95b3bc440fa88ea12eaa4456161"
    done = ended(f"run_to_end(lambda: warn('{url} fails: \\x1b[31m\\nand'))")
    assert done.stderr == "https://mainnet.example/v3/… fails: \\x1b[31m\\nand\n"


def test_expected_errors_of_several_tasks_are_one_line() -> None:
    done = ended("run_to_end(lambda: fail_together(InputError('one'), InputError('other')))")
    assert (done.returncode, done.stderr) == (2, "aira: one [input-error]\n")


def test_an_unexpected_error_is_shown_with_its_traceback() -> None:
    done = ended("run_to_end(lambda: fail(ZeroDivisionError()))")
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert "ZeroDivisionError" in done.stderr


def test_an_unexpected_error_is_not_hidden_behind_an_expected_one() -> None:
    done = ended("run_to_end(lambda: fail_together(InputError('one'), ZeroDivisionError()))")
    assert done.returncode == 1
    assert "ZeroDivisionError" in done.stderr


def test_a_cancellation_without_a_signal_is_an_error() -> None:
    done = ended("run_to_end(lambda: fail(asyncio.CancelledError()))")
    assert done.returncode == 1
    assert "CancelledError" in done.stderr
