from __future__ import annotations

import gc
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tests.support.ports import answers, free_port
from tests.support.processes import Server, ServerFailed, is_alive

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

SERVE = "import http.server, sys; http.server.HTTPServer(('127.0.0.1', int(sys.argv[1])), None).serve_forever()"
STUBBORN = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); {SERVE}"
POLITE = f"import signal; signal.signal(signal.SIGTERM, lambda *_: sys.exit(0)); {SERVE}"
BROKEN = "print('the disk is on fire'); raise SystemExit(3)"


class Scripted(Server):
    """A few lines of Python as a server."""

    name = "scripted"

    def __init__(self, script: str, **limits: float) -> None:
        super().__init__(**limits)
        self.port = free_port()
        self._script = script

    def command(self) -> Sequence[str | Path]:
        return [sys.executable, "-c", self._script, str(self.port)]

    def is_ready(self) -> bool:
        return answers(self.port)


def test_a_server_runs_inside_with_and_its_folder_is_removed_afterwards() -> None:
    with Scripted(SERVE) as server:
        pid, folder = server.pid, server.folder
        assert answers(server.port)
    assert not answers(server.port)
    assert not is_alive(pid)
    assert not folder.exists()


def test_a_server_starts_again_on_the_same_port_and_folder() -> None:
    with Scripted(SERVE) as server:
        (server.folder / "state").write_text("kept")
        server.kill()
        assert not answers(server.port)
        server.start()
        assert answers(server.port)
        assert (server.folder / "state").read_text() == "kept"


def test_a_stopped_server_that_nobody_closes_leaves_no_folder() -> None:
    server = Scripted(SERVE)
    folder = server.folder
    server.start()
    server.stop()
    assert folder.exists()
    del server
    gc.collect()
    assert not folder.exists()


def test_a_failed_start_shows_the_end_of_the_log() -> None:
    server = Scripted(BROKEN)
    with pytest.raises(ServerFailed) as caught, server:
        pass
    assert caught.value.reason == "ended with 3"
    assert "the disk is on fire" in caught.value.log
    assert not server.folder.exists()


def test_starting_a_server_that_is_never_ready_fails() -> None:
    server = Scripted("import time; time.sleep(600)", start_seconds=0.2)
    with pytest.raises(ServerFailed) as caught, server:
        pass
    assert caught.value.reason == "was not ready within 0.2 s"


def test_stopping_never_hangs_on_a_process_that_ignores_it() -> None:
    server = Scripted(STUBBORN, stop_seconds=0.2)
    server.start()
    pid = server.pid
    server.close()
    assert not is_alive(pid)


def test_a_paused_server_stops_without_being_killed() -> None:
    server = Scripted(POLITE)
    server.start()
    server.pause()
    started = time.monotonic()
    server.close()
    assert time.monotonic() - started < server.stop_seconds


def test_starting_twice_is_refused() -> None:
    with Scripted(SERVE) as server, pytest.raises(RuntimeError, match="runs already"):
        server.start()
