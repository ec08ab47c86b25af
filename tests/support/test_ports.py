from __future__ import annotations

import errno
import socket
import sys
from typing import TYPE_CHECKING

import pytest

from tests.support import ports
from tests.support.commands import run
from tests.support.ports import answers, free_port, hold_unreachable_ports

if TYPE_CHECKING:
    from pathlib import Path

OTHER = "from tests.support.ports import free_port, SHARE; print(*(free_port() for _ in range(SHARE)))"


def test_a_port_can_be_listened_on_and_then_answers() -> None:
    port = free_port()
    assert not answers(port)
    with socket.create_server(("127.0.0.1", port)):
        assert answers(port)
    assert not answers(port)


def test_a_port_is_not_reused_soon() -> None:
    assert len({free_port() for _ in range(100)}) == 100


def test_a_taken_port_is_skipped() -> None:
    taken = free_port()
    with socket.create_server(("127.0.0.1", taken)):
        assert taken not in {free_port() for _ in range(ports.SHARE)}


def test_two_processes_never_get_the_same_port(pytestconfig: pytest.Config) -> None:
    mine = {free_port() for _ in range(ports.SHARE)}
    other = run(sys.executable, "-c", OTHER, PYTHONPATH=str(pytestconfig.rootpath))
    assert other.stderr == ""
    assert mine.isdisjoint(map(int, other.stdout.split()))


def test_ports_that_can_be_reached_or_are_taken_are_not_held(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    free, taken = free_port(), free_port()
    looked_at = tmp_path / "range"
    looked_at.write_text(f"{free}\t{taken}\n")
    monkeypatch.setattr(ports, "EPHEMERAL", looked_at)
    with socket.create_server(("127.0.0.1", taken)):
        assert hold_unreachable_ports() == []
    with socket.create_server(("127.0.0.1", free)):
        assert answers(free)


@pytest.mark.parametrize("failure", [errno.EAGAIN, errno.ECONNREFUSED], ids=["lost", "refused"])
def test_a_port_that_can_t_be_reached_is_held(failure: int, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    with monkeypatch.context() as patched:
        patched.setattr(socket.socket, "connect_ex", lambda client, address: failure)
        assert not ports._is_reachable(port)
    assert not ports._is_free(port)
