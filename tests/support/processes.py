"""A server process for tests: started with a state folder and a log of its own, stopped by its pid, never hanging."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import tempfile
import time
import weakref
from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Sequence

START_SECONDS = 180.0
STOP_SECONDS = 30.0
KILL_SECONDS = 60.0
"""In which a killed process ends on a busy machine."""
POLL_SECONDS = 0.02
LOG_LINES = 40


def is_alive(pid: int) -> bool:
    """Whether there is a process with that id."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


class ServerFailed(Exception):
    """A server did not start; the text ends with the last lines of its log."""

    def __init__(self, name: str, reason: str, log: str) -> None:
        super().__init__(f"{name} {reason}; its log ends with:\n{log or '(nothing)'}")
        self.name = name
        self.reason = reason
        self.log = log


class Server(ABC):
    """One process with its state folder. Use it in `with` or `async with`, which also removes the folder at the end.

    `start` and `stop` may be called again and again in between: the state folder and the ports stay, as for a machine
    that is switched off and on. A subclass defines the command and when it is ready.
    """

    name: str

    def __init__(self, *, start_seconds: float = START_SECONDS, stop_seconds: float = STOP_SECONDS) -> None:
        self.start_seconds = start_seconds
        self.stop_seconds = stop_seconds
        self.folder = Path(tempfile.mkdtemp(prefix=f"aira-{self.name}-"))
        # A caller that uses `stop` instead of `close` leaves no folder either.
        self._remove_folder = weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)
        self._log = self.folder / "server.log"
        self._process: subprocess.Popen[bytes] | None = None

    @abstractmethod
    def command(self) -> Sequence[str | Path]:
        """The program and its arguments; called at every start, so it may write configuration files first."""

    @abstractmethod
    def is_ready(self) -> bool:
        """Whether the running process serves; polled until it says so."""

    @property
    def pid(self) -> int:
        """The process id of the running server."""
        return self._running().pid

    @property
    def is_running(self) -> bool:
        """Whether the process was started and has not ended."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Start the process and return when it is ready; raise `ServerFailed` if it ends or is not ready in time."""
        if self._process is not None:
            raise RuntimeError(f"{self.name} runs already")
        command = [str(word) for word in self.command()]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, cwd=self.folder
            )
        try:
            self._wait_until_ready(self._process)
        except BaseException:
            self.kill()
            raise

    def stop(self) -> None:
        """Ask the process to end, and kill it if it does not within `stop_seconds`; nothing happens if none runs."""
        self._end(signal.SIGTERM)

    def kill(self) -> None:
        """End the process as a power cut would (SIGKILL)."""
        self._end(signal.SIGKILL)

    def pause(self) -> None:
        """Freeze the process: it keeps its connections but does not answer until `resume`."""
        process = self._running()
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)  # the signal takes a moment

    def resume(self) -> None:
        """Let a paused process go on."""
        self._running().send_signal(signal.SIGCONT)

    def close(self) -> None:
        """Stop the process and remove its state folder; the object is of no use afterwards."""
        self.stop()
        self._remove_folder()

    def log(self) -> str:
        """The output of the process since its last start."""
        return self._log.read_text(errors="replace") if self._log.exists() else ""

    def __enter__(self) -> Self:
        try:
            self.start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    async def __aenter__(self) -> Self:
        return await asyncio.to_thread(self.__enter__)

    async def __aexit__(self, *exc_info: object) -> None:
        await asyncio.to_thread(self.close)

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            raise RuntimeError(f"{self.name} is not running")
        return self._process

    def _end(self, how: signal.Signals) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        process.send_signal(how)
        # A paused process takes no signal but SIGKILL until it goes on.
        process.send_signal(signal.SIGCONT)
        try:
            process.wait(self.stop_seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(KILL_SECONDS)

    def _wait_until_ready(self, process: subprocess.Popen[bytes]) -> None:
        deadline = time.monotonic() + self.start_seconds
        while not self.is_ready():
            if process.poll() is not None:
                raise ServerFailed(self.name, f"ended with {process.returncode}", self._log_tail())
            if time.monotonic() > deadline:
                raise ServerFailed(self.name, f"was not ready within {self.start_seconds:g} s", self._log_tail())
            time.sleep(POLL_SECONDS)

    def _log_tail(self) -> str:
        return "\n".join(self.log().splitlines()[-LOG_LINES:])
