"""Serial ports."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from bridges.serial.dialect import LineError
from bridges.serial.line import PortName, SerialPort
from mesh.errors import InputError
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path


def test_a_port_is_found_by_its_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "tty"
    with raises_with(LineError, code="port-missing"):
        PortName(str(path)).find()
    path.touch()
    assert PortName(str(path)).find() == path
    monkeypatch.chdir(tmp_path)
    assert PortName("./tty").find().samefile(path)


def test_a_usb_device_that_is_not_plugged_in_is_missing() -> None:
    with raises_with(LineError, code="port-missing") as caught:
        PortName("usb:dead:beef").find()
    assert "usb:dead:beef" in str(caught.value)


@pytest.mark.parametrize("text", ["", "ttyUSB0", "usb:2341", "usb:23410043", "COM3"])
def test_a_text_that_names_no_port_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        PortName(text)


def test_a_file_that_is_not_a_terminal_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.touch()
    for each in (path, tmp_path):
        with raises_with(LineError, code="invalid-port"):
            SerialPort(each, baud=57_600)


def test_a_port_is_locked_and_reports_when_it_is_unplugged(tmp_path: Path) -> None:
    master, slave = os.openpty()
    path = PortName(os.ttyname(slave)).find()
    os.close(slave)
    port = SerialPort(path, baud=57_600)
    with raises_with(LineError, code="port-busy"):
        SerialPort(path, baud=57_600)
    assert port.write(b"abc") == 3
    assert os.read(master, 10) == b"abc"
    os.write(master, b"xyz")
    assert port.read() == b"xyz"
    os.close(master)
    with pytest.raises(LineError):
        port.read()
    port.close()
