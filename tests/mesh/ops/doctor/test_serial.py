"""The serial line: ports that are missing, not permitted or in use, and boards that answer or do not."""

from __future__ import annotations

import grp
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from bridges.serial import check
from bridges.serial.line import SerialPort
from mesh.ops.doctor import DoctorContext
from mesh.ops.doctor.checks import SerialSettings
from mesh.settings import Settings
from tests.support.boards import COUNTER, ROSSERIAL_ECHO, board
from tests.support.commands import run
from tests.support.doctor.examining import examined

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.support.routers import EmbeddedRouter

PATIENCE = 60.0
"""Seconds in which a board that is there answers, on a busy machine."""
IMPORTS = """
import os, sys
from bridges.serial.check import check_port
from mesh.ops.doctor.checks import SerialSettings
"""
LOOK = f"{IMPORTS}print(*check_port(SerialSettings(port=sys.argv[1])), sep=os.linesep)"
AS_NOBODY = LOOK.replace("print", "if os.geteuid() == 0: os.setgroups([]), os.setgid(65534), os.setuid(65534)\nprint")


@pytest.fixture
def silent() -> Iterator[str]:
    """A port without an answering board."""
    master, slave = os.openpty()
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


def test_a_port_that_opens_passes(silent: str) -> None:
    result = check.check_port(SerialSettings(port=silent))
    assert result.code == "ok"
    assert silent in result.message


async def test_a_missing_port_is_named(router: EmbeddedRouter) -> None:
    context = DoctorContext(
        settings=Settings(connect=(router.endpoint,)), serial=SerialSettings(port="/dev/ttyNOTHING")
    )

    found = await examined(context)

    assert context.role == "edge"
    cause = found.cause("serial port")
    assert cause.code == "port-missing"
    assert "/dev/ttyNOTHING" in cause.message
    assert "serial board" not in found


def test_a_port_without_permission_is_reported_with_its_group_and_a_hint(silent: str) -> None:
    os.chmod(silent, 0)
    if os.geteuid() == 0:
        os.chown(silent, -1, grp.getgrnam("dialout").gr_gid)
    done = run(sys.executable, "-c", AS_NOBODY, silent)

    status, code, found, do = done.stdout.splitlines()
    assert (status, code) == ("CheckStatus.FAIL", "port-forbidden"), done.stderr
    assert silent in found
    assert do.startswith("sudo usermod -aG ")
    assert "log in again" in do


def test_a_port_in_use_is_reported(silent: str) -> None:
    port = SerialPort(Path(silent), baud=57_600)
    try:
        done = run(sys.executable, "-c", LOOK, silent)
    finally:
        port.close()

    status, code, _, do = done.stdout.splitlines()
    assert (status, code) == ("CheckStatus.FAIL", "port-busy"), done.stderr
    assert "fuser" in do


def test_a_file_that_is_no_port_fails() -> None:
    result = check.check_port(SerialSettings(port="/dev/null"))

    assert (result.ok, result.code) == (False, "invalid-port")


def test_a_port_without_an_answering_board_fails(silent: str) -> None:
    result = check.check_board(SerialSettings(port=silent), timeout=0.5)

    assert (result.ok, result.code) == (False, "board-silent")
    assert "--protocol" in result.hint


def test_an_answering_board_is_reported_with_its_protocol() -> None:
    with board(COUNTER) as there:
        result = check.check_board(SerialSettings(port=str(there.port)), timeout=PATIENCE)

    assert result.ok, result
    assert "answered in frames at 57600 baud" in result.message


def test_a_rosserial_board_answers_in_rosserial_only() -> None:
    with board(ROSSERIAL_ECHO) as there:
        as_rosserial = check.check_board(SerialSettings(port=str(there.port), protocol="rosserial"), timeout=PATIENCE)
        as_frames = check.check_board(SerialSettings(port=str(there.port), protocol="frames", baud=57_600))
        as_found = check.check_board(SerialSettings(port=str(there.port)), timeout=PATIENCE)

    assert as_rosserial.ok, as_rosserial
    assert "answered in rosserial" in as_rosserial.message
    assert "answered in rosserial at 57600 baud" in as_found.message
    assert not as_frames.ok
