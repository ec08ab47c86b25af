"""A dialect on a real port: one thread that waits for the port, the bytes, the time and other threads' wishes."""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import time
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final

from bridges.serial.errors import LineError, PortMissing
from bridges.serial.ports import Port

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.serial.dialect import Dialect, Happening
    from bridges.serial.ports import PortName

log = logging.getLogger(__name__)

STRANGE: Final = 5.0
"""Seconds on an open port without a board that answers, after which that is said."""
LOOKED_FOR: Final = 0.25
"""Seconds between two looks for a port that is not there."""


class Line:
    """The line to one board. `run` serves it on the thread that calls it, until `stop`; `deliver` gets what happens.

    `deliver` and all that is handed to `do` are called on that thread, one after the other. Nothing raises but what
    they raise: a port that is not there, or that goes away, is waited for.
    """

    def __init__(self, name: PortName, dialect: Dialect, *, baud: int, deliver: Callable[[Happening], None]) -> None:
        self.name = name
        self.dialect = dialect
        self._baud = baud
        self._deliver = deliver
        self._wishes: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._woken, self._wake = socket.socketpair()
        self._wake.setblocking(False)
        self._stopping = False
        self._port: Port | None = None
        self._backlog = bytearray()
        self._look = 0.0
        self._complaint = ""
        self._strange = float("inf")
        self._bytes = 0
        self.openings = 0
        """How often the port was opened."""

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    def do(self, wish: Callable[[], object]) -> None:
        """Have something done on the line's thread soon; from any thread."""
        self._wishes.put(wish)
        self._rouse()

    def stop(self) -> None:
        """End `run`; from any thread, and from a signal's handler."""
        self._stopping = True
        self._rouse()

    def run(self) -> None:
        """Serve until `stop`; once."""
        try:
            while not self._stopping:
                try:
                    self._serve()
                except LineError as error:
                    self._lose(error)
                for happening in self.dialect.happenings():
                    self._deliver(happening)
        finally:
            if self._port is not None:
                self._port.close()
            self._woken.close()
            self._wake.close()

    def _rouse(self) -> None:
        with contextlib.suppress(OSError):  # full, and so roused already; or closed, and nobody is there any more
            self._wake.send(b"!")

    def _serve(self) -> None:
        """One turn: wait for something, and see to it."""
        now = time.monotonic()
        if self._port is None and self._look <= now:
            self._open(now)
        self._backlog += self.dialect.outgoing()
        if self._port is not None and self._backlog:
            del self._backlog[: self._port.write(bytes(self._backlog))]
        if self._wait():
            assert self._port is not None
            self._receive(self._port.read())
        while True:
            try:
                wish = self._wishes.get_nowait()
            except Empty:
                break
            wish()
        now = time.monotonic()
        if self.dialect.due <= now:
            self.dialect.pass_time(now)
        if self._strange <= now:
            self._wonder()

    def _receive(self, data: bytes) -> None:
        self._bytes += len(data)
        self.dialect.receive(data, time.monotonic())

    def _wonder(self) -> None:
        """Nobody has answered for a while on an open port: say so once, with what may be wrong."""
        self._strange = float("inf")
        if self.dialect.about is None:
            came = f"{self._bytes} bytes have come, which make no sense" if self._bytes else "nothing has come"
            log.warning(
                "no board answers on %s at %d baud (%s): do --baud and --protocol fit the firmware?",
                self.name,
                self._baud,
                came,
            )

    def _wait(self) -> bool:
        """Wait; whether bytes have come."""
        due = min(self.dialect.due, self._strange if self._port is not None else self._look)
        timeout = None if due == float("inf") else max(0.0, due - time.monotonic())
        if not self._wishes.empty():
            timeout = 0.0
        readable: list[Any] = [self._woken] if self._port is None else [self._woken, self._port]
        writable = [self._port] if self._port is not None and self._backlog else []
        ready, _, _ = select.select(readable, writable, [], timeout)
        if self._woken in ready:
            self._woken.recv(4096)
        return self._port is not None and self._port in ready

    def _open(self, now: float) -> None:
        self._look = now + LOOKED_FOR
        try:
            self._port = Port(self.name.find(), baud=self._baud)
        except LineError as error:
            if str(error) != self._complaint:
                self._complaint = str(error)
                log.log(logging.INFO if isinstance(error, PortMissing) else logging.WARNING, "%s; waiting", error)
            return
        self._complaint = ""
        self.openings += 1
        self._backlog.clear()
        log.info("%s is open at %d baud", self.name, self._baud)
        self._strange, self._bytes = time.monotonic() + STRANGE, 0
        self.dialect.opened(time.monotonic())

    def _lose(self, error: LineError) -> None:
        log.warning("%s", error)
        if self._port is not None:
            self._port.close()
            self._port = None
        self._backlog.clear()
        self._look = 0.0
        self.dialect.closed(time.monotonic())
