from __future__ import annotations

import socket
import sys
from typing import TYPE_CHECKING

from tests.support import ports
from tests.support.commands import run
from tests.support.ports import answers, free_port

if TYPE_CHECKING:
    import pytest

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
