"""Serial ports: finding one by path or by USB id, opening it, reading and writing without waiting."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import termios
from pathlib import Path
from typing import TYPE_CHECKING, Final

import serial

from bridges.serial.errors import LineError, PortMissing
from mesh.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable

USB: Final = re.compile(r"usb:(?P<vendor>[0-9a-fA-F]{4}):(?P<product>[0-9a-fA-F]{4})(?::(?P<serial>.+))?")
READ: Final = 4096


class PortName:
    """What a port is called: a path (also one under /dev/serial/by-id), or `usb:VENDOR:PRODUCT[:SERIAL]` in hex.

    A path may change when a board is plugged in again; a by-id path and a USB id do not. Raises `InputError`.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self._usb = USB.fullmatch(text)
        if self._usb is None and not text.startswith("/"):
            raise InputError(
                f"{text!r} names no serial port", hint="give a path, /dev/ttyACM0, or a USB id, usb:2341:0043"
            )

    def __str__(self) -> str:
        return self.text

    def find(self) -> Path:
        """Where the port is now. Raises `PortMissing`."""
        if self._usb is None:
            path = Path(self.text)
            if not path.exists():
                raise PortMissing(self.text, "there is no such file")
            return path
        vendor, product = int(self._usb["vendor"], 16), int(self._usb["product"], 16)
        for port in _usb_ports():
            same = (port.vid, port.pid) == (vendor, product)
            if same and self._usb["serial"] in (None, port.serial_number):
                return Path(port.device)
        raise PortMissing(self.text, "no such device is plugged in")


class Port:
    """An open port, for this process alone. Raises `PortMissing`, or `LineError` where it can't be used."""

    def __init__(self, path: Path, *, baud: int) -> None:
        self.path = path
        try:
            self._serial = serial.Serial(str(path), baud, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # pyserial's own are among them
            if not path.exists():
                raise PortMissing(str(path), "it has gone") from None
            raise LineError(f"can't open {path} at {baud} baud: {_reason(error)}") from None

    def fileno(self) -> int:
        """The file descriptor, for select."""
        return int(self._serial.fileno())

    def read(self) -> bytes:
        """What has come, once select says that something has. Raises `LineError` when that is the pulled cable."""
        try:
            data = os.read(self.fileno(), READ)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LineError(f"{self.path} is unplugged: {error.strerror}") from None
        if not data:
            raise LineError(f"{self.path} is unplugged")
        return data

    def write(self, data: bytes) -> int:
        """Hand over what the system takes now; returns how many bytes that were. Raises `LineError`."""
        try:
            return os.write(self.fileno(), data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LineError(f"{self.path} is unplugged: {error.strerror}") from None

    def close(self) -> None:
        """Give it back."""
        with contextlib.suppress(OSError):  # a port that was pulled out can't be given back
            self._serial.close()


def _reason(error: OSError | ValueError) -> str:
    """Why a port can't be opened; pyserial says it in longer ways."""
    below = error.__context__
    number = below.args[0] if isinstance(below, termios.error) else getattr(error, "errno", None)
    match number:
        case errno.EACCES | errno.EPERM:
            return "no permission; on Debian, be in the group dialout"
        case errno.EAGAIN | errno.EBUSY:
            return "another process uses it"
        case errno.ENOTTY | errno.EISDIR | errno.ENODEV:
            return "it is no serial port"
    return os.strerror(number) if number else str(error)


def _usb_ports() -> Iterable[serial.tools.list_ports_common.ListPortInfo]:
    from serial.tools import list_ports  # walks through /sys, which a path does not need

    return list_ports.comports()
