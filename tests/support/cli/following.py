"""Reading logs with `aira logs`: a process that follows, and a service that answers with the events of a test."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import zenoh

from schemas import RpcKey
from schemas.status import LogEvent, LogsRead
from tests.support.commands import AIRA, SECONDS, environment
from tests.support.orders import ROBOT
from tests.support.routers import client_config, wait_until_declared

if TYPE_CHECKING:
    from collections.abc import Iterator


class Follower:
    """`aira logs … --follow` in a process."""

    def __init__(self, *arguments: str, endpoint: str) -> None:
        self._process = subprocess.Popen(
            [*AIRA, "logs", *arguments, "--follow"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment({"AIRA_CONNECT": endpoint, "PYTHONUNBUFFERED": "1"}),
        )
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self.said = ""

    def until(self, words: str, *, once_more: bool = False) -> str:
        """All its output, once a line has all of these words; with `once_more` only lines printed from now on count."""
        start = len(self.said) if once_more else 0
        deadline = time.monotonic() + SECONDS
        while not any(all(word in line for word in words.split("|")) for line in self.said[start:].splitlines()):
            assert time.monotonic() < deadline, f"no {words!r} in:\n{self.said}"
            assert self._process.poll() is None, self.said
            assert self._process.stdout is not None
            self.said += (self._process.stdout.read() or b"").decode()
            time.sleep(0.02)
        return self.said

    def interrupt(self) -> int:
        self._process.send_signal(signal.SIGINT)
        return self._process.wait(SECONDS)

    def __enter__(self) -> Follower:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._process.kill()
        self._process.wait(SECONDS)
        if self._process.stdout is not None:
            self._process.stdout.close()


def event(message: str, **fields: Any) -> LogEvent:
    return LogEvent(**({"time": "2026-01-01T00:00:00.000Z", "level": "info", "logger": "x"} | fields), message=message)


@contextmanager
def pretender(endpoint: str, *events: LogEvent, missed: int = 0) -> Iterator[None]:
    """A service that answers each query for the robot's log with these events."""
    key = str(RpcKey(ROBOT.address, "logs"))
    reply = LogsRead(instance="\x1b[2J", began="\x1b[2J", entries=events, last=1, missed=missed).encode()
    with zenoh.open(client_config(endpoint)) as session:
        queryable: Any = session.declare_queryable(key, lambda query: answer(query, key, reply))
        wait_until_declared(endpoint, key, answers=True)
        yield
        queryable.undeclare()


def answer(query: zenoh.Query, key: str, reply: bytes) -> None:
    with query:
        query.reply(key, reply)
