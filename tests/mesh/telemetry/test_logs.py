"""The log of whole processes: every line of a process that logs in JSON is a JSON object."""

from __future__ import annotations

import json
import sys
from typing import Any

import pytest

from tests.support.commands import run

START = """
import asyncio, logging, threading, warnings
from mesh.errors import RemoteError
from mesh.role.running import run_until_stopped
from mesh.settings import load
log = logging.getLogger("my.robot")

async def main():
    {body}

run_until_stopped(main, settings=load(), role="robot")
"""


def said(body: str, *, code: int = 0, **variables: str) -> list[str]:
    """The lines that a program with this body prints, on stdout and stderr together."""
    done = run(sys.executable, "-c", START.format(body="\n    ".join(body.strip().splitlines())), **variables)
    assert done.returncode == code, done.stderr
    return [*done.stdout.splitlines(), *done.stderr.splitlines()]


def logged(body: str, *, code: int = 0, **variables: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in said(body, code=code, AIRA_LOG_FORMAT="json", **variables)]


def test_messages_of_the_users_program_are_events() -> None:
    (event,) = logged('log.info("the lamp %s", "is on")')
    assert (event["level"], event["logger"], event["message"]) == ("info", "my.robot", "the lamp is on")
    assert event["role"] == "robot"


def test_the_human_format_is_time_level_message() -> None:
    (line,) = said('log.warning("the lamp is dim")')
    assert line[8:] == " WARNING the lamp is dim"


@pytest.mark.parametrize(
    ("level", "words"),
    [("debug", "dbiwe"), ("info", "biwe"), ("warning", "we"), ("error", "e")],
)
def test_the_level_decides_what_is_logged(level: str, words: str) -> None:
    body = 'log.debug("d"); log.info("b"); log.info("i"); log.warning("w"); log.error("e")'
    events = logged(body, AIRA_LOG_LEVEL=level)
    assert "".join(event["message"] for event in events if event["logger"] == "my.robot") == words


def test_libraries_log_only_warnings_unless_the_level_is_debug() -> None:
    body = 'web3 = logging.getLogger("web3.providers"); web3.info("chatter"); web3.warning("trouble")'
    assert [event["message"] for event in logged(body)] == ["trouble"]
    assert "chatter" in [event["message"] for event in logged(body, AIRA_LOG_LEVEL="debug")]


def test_an_error_that_ends_a_server_is_an_event_with_its_hint() -> None:
    (event,) = logged('raise RemoteError("the node is gone", hint="start it")', code=1)
    assert (event["level"], event["message"], event["hint"]) == ("error", "the node is gone", "start it")
    assert (event["event"], event["code"]) == ("program-failed", "remote-error")
    assert said('raise RemoteError("the node is gone", hint="start it")', code=1) == [
        "aira: the node is gone [remote-error]",
        "      start it",
    ]


def test_an_unexpected_error_that_ends_a_server_is_one_line_with_its_traceback() -> None:
    event = logged('raise ZeroDivisionError("so\\nwhat")', code=1)[-1]
    assert (event["event"], event["level"]) == ("program-failed", "critical")
    assert event["error"] == "ZeroDivisionError: so\nwhat"
    assert "in main\n" in event["trace"]


def test_a_thread_that_fails_is_one_line() -> None:
    body = 'thread = threading.Thread(target=lambda: 1 / 0, name="pump"); thread.start(); thread.join()'
    (event,) = logged(body)
    assert (event["event"], event["thread"], event["error"]) == (
        "thread-failed",
        "pump",
        "ZeroDivisionError: division by zero",
    )


def test_a_failed_task_that_nobody_awaits_is_one_line() -> None:
    body = """
async def fail(): raise ZeroDivisionError
task = asyncio.create_task(fail())
await asyncio.sleep(0)
await asyncio.sleep(0)
del task
"""
    (event,) = logged(body)
    assert (event["logger"], event["level"]) == ("asyncio", "error")
    assert "ZeroDivisionError" in event["error"]


def test_an_error_in_a_finalizer_is_one_line() -> None:
    body = """
class Fragile:
    def __del__(self):
        raise ZeroDivisionError("in the end")
Fragile()
"""
    (event,) = logged(body)
    assert (event["event"], event["level"]) == ("finalizer-failed", "error")
    assert event["error"] == "ZeroDivisionError: in the end"
    assert "Fragile" in event["message"]


def test_a_warning_is_one_line() -> None:
    (event,) = logged('warnings.warn("old fashioned", DeprecationWarning, stacklevel=1)', PYTHONWARNINGS="always")
    assert event["logger"] == "py.warnings"
    assert "old fashioned" in event["message"]


def test_an_invalid_log_call_is_logged_and_does_not_raise() -> None:
    first, second = logged('log.info("%d messages", "many"); log.info("it goes on")')
    assert (first["event"], first["level"], "'%d messages'" in first["message"]) == ("record-malformed", "error", True)
    assert first["error"].startswith("TypeError")
    assert second["message"] == "it goes on"


def test_a_program_that_logs_in_its_own_way_keeps_doing_so() -> None:
    body = 'logging.basicConfig(format="mine %(message)s", force=True); log.warning("hello")'
    assert said(body, AIRA_LOG_FORMAT="json") == ["mine hello"]
    own = "import logging; logging.basicConfig(format='mine %(message)s', level=20)\n" + START
    done = run(sys.executable, "-c", own.format(body='log.info("hello")'), AIRA_LOG_FORMAT="json")
    assert done.stderr == "mine hello\n"
