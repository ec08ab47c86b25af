"""A line to a simulated board, served by a thread, for tests of firmware without a mesh."""

from __future__ import annotations

import queue
import threading
import time
from typing import TYPE_CHECKING, Self, TypeVar

from bridges.serial.dialect import BoardReady, CallStatus, Command, CommandFinished, CommandRefused
from bridges.serial.line import PortName, SerialLine

if TYPE_CHECKING:
    from bridges.serial.boards import SimulatedBoard
    from bridges.serial.dialect import Dialect, LineEvent

SECONDS = 60.0

H = TypeVar("H")


class LineClient:
    """`with LineClient(board, dialect) as client`: opened, and the board is ready."""

    def __init__(self, board: SimulatedBoard, dialect: Dialect) -> None:
        self.dialect = dialect
        self.events: list[LineEvent] = []
        self._arrived: queue.SimpleQueue[LineEvent] = queue.SimpleQueue()
        self.line = SerialLine(PortName(str(board.port)), dialect, on_event=self._arrived.put)
        self._thread = threading.Thread(target=self.line.run, name="line", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        self.next(BoardReady)
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.line.stop()
        self._thread.join(SECONDS)

    def next(self, kind: type[H], *, seconds: float = SECONDS) -> H:
        """The next event of this type; earlier ones are in `events`."""
        deadline = time.monotonic() + seconds
        while True:
            try:
                event = self._arrived.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"no {kind.__name__} within {seconds:g} s; {self.dialect.counters}") from None
            self.events.append(event)
            if isinstance(event, kind):
                return event

    def submit(self, topic: str, payload: bytes = b"", *, seconds: float = SECONDS) -> Command:
        """Submit a command."""
        command = Command(topic, payload, time.monotonic() + seconds)
        self.line.call_soon(lambda: self._submit(command))
        return command

    def _submit(self, command: Command) -> None:
        try:
            self.dialect.submit(command, time.monotonic())
        except CommandRefused as error:
            self._arrived.put(CommandFinished(command, CallStatus.FAILED, reason=error.reason, detail=str(error)))

    def call(self, topic: str, payload: bytes = b"") -> CommandFinished:
        """Submit a command and wait for its outcome."""
        return self.ended(self.submit(topic, payload))

    def ended(self, command: Command) -> CommandFinished:
        """The outcome of a command, now or already."""
        for event in self.events:
            if isinstance(event, CommandFinished) and event.command is command:
                return event
        while (ended := self.next(CommandFinished)).command is not command:
            pass
        return ended
