"""A serial port, and the line on it: one thread that waits for the port, bytes, time and requests of other threads."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import select
import socket
import termios
import time
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final

from bridges.serial.dialect import LineError
from mesh.base.extras import needs_extra
from mesh.base.log_context import log_event
from mesh.errors import InputError

with needs_extra("serial", "a serial line"):
    import serial

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.serial.dialect import Dialect, LineEvent

log = logging.getLogger(__name__)

USB: Final = re.compile(r"usb:(?P<vendor>[0-9a-fA-F]{4}):(?P<product>[0-9a-fA-F]{4})(?::(?P<serial>.+))?")
READ_SIZE: Final = 4096


class PortName:
    """The name of a port: a path (also one under /dev/serial/by-id), or `usb:VENDOR:PRODUCT[:SERIAL]` in hex.

    A path may change when a board is plugged in again; a by-id path and a USB id do not. Raises `InputError`.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self._usb = USB.fullmatch(text)
        if self._usb is None and "/" not in text:
            raise InputError(
                f"{text!r} is not a serial port", hint="give a path, /dev/ttyACM0, or a USB id, usb:2341:0043"
            )

    def __str__(self) -> str:
        return self.text

    def find(self) -> Path:
        """Where the port is now. Raises `LineError` (port-missing)."""
        if self._usb is None:
            path = Path(self.text)
            if not path.exists():
                raise _missing(self.text, "there is no such file")
            return path
        from serial.tools import list_ports  # reads /sys, which a path does not need

        vendor, product = int(self._usb["vendor"], 16), int(self._usb["product"], 16)
        for port in list_ports.comports():
            same = (port.vid, port.pid) == (vendor, product)
            if same and self._usb["serial"] in (None, port.serial_number):
                return Path(port.device)
        raise _missing(self.text, "no such device is plugged in")


class SerialPort:
    """An open port, locked for this process. Raises `LineError` if it is missing or can't be used."""

    def __init__(self, path: Path, *, baud: int) -> None:
        self.path = path
        self.baud = baud
        try:
            self._serial = serial.Serial(str(path), baud, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # pyserial's errors are OSErrors
            if not path.exists():
                raise _missing(str(path), "it was unplugged") from None
            raise _open_error(path, baud, error) from None

    def fileno(self) -> int:
        return int(self._serial.fileno())

    def read(self) -> bytes:
        """The bytes that have arrived; call it when select reports the port. Raises `LineError` if it was unplugged."""
        try:
            data = os.read(self.fileno(), READ_SIZE)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LineError(f"{self.path} is unplugged: {error.strerror}") from None
        if not data:
            raise LineError(f"{self.path} is unplugged")
        return data

    def write(self, data: bytes) -> int:
        """Write without blocking; returns the number of bytes written. Raises `LineError`."""
        try:
            return os.write(self.fileno(), data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LineError(f"{self.path} is unplugged: {error.strerror}") from None

    def set_baud(self, baud: int) -> None:
        """Change the speed. At one that the port does not have, nobody will answer."""
        self.baud = baud
        with contextlib.suppress(OSError, ValueError, termios.error):
            self._serial.baudrate = baud

    def close(self) -> None:
        with contextlib.suppress(OSError):  # a port that was unplugged can't be closed properly
            self._serial.close()


class SerialLine:
    """The line to one board. `run` serves it on the calling thread until `stop`; `on_event` receives its events.

    `on_event` and everything passed to `call_soon` run on that thread, one after the other. `run` raises only what they
    raise: it waits for a port that is missing or was unplugged.
    """

    def __init__(self, name: PortName, dialect: Dialect, *, on_event: Callable[[LineEvent], None]) -> None:
        self.name = name
        self.dialect = dialect
        self._on_event = on_event
        self._tasks: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._woken, self._waker = socket.socketpair()
        self._waker.setblocking(False)
        self._stopping = False
        self._port: SerialPort | None = None
        self._unsent = bytearray()
        self._next_attempt = 0.0
        self._last_error = ""
        self._silence_ends = float("inf")
        self._bytes_received = 0
        self.openings = 0
        """How often the port was opened."""

    @property
    def is_open(self) -> bool:
        return self._port is not None

    def call_soon(self, task: Callable[[], object]) -> None:
        """Run something on the line's thread soon; from any thread."""
        self._tasks.put(task)
        self._wake()

    def stop(self) -> None:
        """End `run`; from any thread, and from a signal handler."""
        self._stopping = True
        self._wake()

    def run(self) -> None:
        """Serve until `stop`; once."""
        try:
            while not self._stopping:
                try:
                    self._serve_once()
                except LineError as error:
                    self._close_port(error)
                for event in self.dialect.events():
                    self._on_event(event)
        finally:
            if self._port is not None:
                self._port.close()
            self._woken.close()
            self._waker.close()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):  # the buffer is full, so it wakes anyway; or `run` has ended
            self._waker.send(b"!")

    def _serve_once(self) -> None:
        now = time.monotonic()
        if self._port is None and self._next_attempt <= now:
            self._open_port(now)
        if self._port is not None and self._port.baud != self.dialect.baud:
            self._unsent.clear()
            self._port.set_baud(self.dialect.baud)
        self._unsent += self.dialect.outgoing()
        if self._port is not None and self._unsent:
            del self._unsent[: self._port.write(bytes(self._unsent))]
        if self._wait():
            assert self._port is not None
            data = self._port.read()
            self._bytes_received += len(data)
            self.dialect.receive(data, time.monotonic())
        while not self._tasks.empty():
            self._tasks.get_nowait()()
        now = time.monotonic()
        if self.dialect.next_tick <= now:
            self.dialect.tick(now)
        if self._silence_ends <= now:
            self._warn_of_silence()

    def _wait(self) -> bool:
        """Wait for bytes, a task or the next tick; returns whether bytes have arrived."""
        due = min(self.dialect.next_tick, self._silence_ends if self._port is not None else self._next_attempt)
        timeout = None if due == float("inf") else max(0.0, due - time.monotonic())
        if not self._tasks.empty():
            timeout = 0.0
        readable: list[Any] = [self._woken] if self._port is None else [self._woken, self._port]
        writable = [self._port] if self._port is not None and self._unsent else []
        ready, _, _ = select.select(readable, writable, [], timeout)
        if self._woken in ready:
            self._woken.recv(READ_SIZE)
        return self._port is not None and self._port in ready

    def _warn_of_silence(self) -> None:
        """Warn once if the port is open but no board has answered, with the likely reasons."""
        self._silence_ends = float("inf")
        if self.dialect.info is None:
            seen = f"{self._bytes_received} bytes arrived that can't be decoded" if self._bytes_received else "no bytes"
            log.warning(
                "no board answers on %s (%s) %s",
                self.name,
                seen,
                self.dialect.attempt,
                extra=log_event("board-silent", port=self.name, baud=self.dialect.baud, bytes=self._bytes_received),
            )

    def _open_port(self, now: float) -> None:
        self._next_attempt = now + 0.25
        try:
            self._port = SerialPort(self.name.find(), baud=self.dialect.baud)
        except LineError as error:
            if str(error) != self._last_error:
                self._last_error = str(error)
                level = logging.INFO if error.code == "port-missing" else logging.WARNING
                log.log(
                    level, "%s; waiting", error, extra=log_event("port-unavailable", port=self.name, code=error.code)
                )
            return
        self._last_error = ""
        self.openings += 1
        self._unsent.clear()
        opened = log_event("port-opened", port=self.name, baud=self.dialect.baud)
        log.info("%s is open at %d baud", self.name, self.dialect.baud, extra=opened)
        self._silence_ends, self._bytes_received = time.monotonic() + self.dialect.silence, 0
        self.dialect.opened(time.monotonic())

    def _close_port(self, error: LineError) -> None:
        log.warning("%s", error, extra=log_event("port-lost", port=self.name, code=error.code))
        if self._port is not None:
            self._port.close()
            self._port = None
        self._unsent.clear()
        self._next_attempt = 0.0
        self.dialect.closed(time.monotonic())


def _missing(port: str, why: str) -> LineError:
    return LineError(f"no serial port {port}: {why}", hint="is the board plugged in?", code="port-missing")


def _open_error(path: Path, baud: int, error: OSError | ValueError) -> LineError:
    below = error.__context__
    number = below.args[0] if isinstance(below, termios.error) else getattr(error, "errno", None)
    failed = f"can't open {path} at {baud} baud:"
    match number:
        case errno.EACCES | errno.EPERM:
            hint = "on Debian, join the group dialout"
            return LineError(f"{failed} no permission", hint=hint, code="port-forbidden")
        case errno.EAGAIN | errno.EBUSY:
            return LineError(f"{failed} another process uses it", code="port-busy")
        case errno.ENOTTY | errno.EISDIR | errno.ENODEV:
            return LineError(f"{failed} it is not a serial port", code="invalid-port")
    return LineError(f"{failed} {os.strerror(number) if number else error}")
