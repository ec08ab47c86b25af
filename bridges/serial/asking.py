"""A question that is put again until it is answered: one is under way at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from bridges.serial.frames import Frame, Kind, encode

if TYPE_CHECKING:
    from bridges.serial.dialect import Command, Counters

ANSWER: Final = 0.03
"""Seconds that a board has for an answer, beside the time on the line, before it is asked again."""
SLOWEST: Final = 1.0
"""Seconds between two repetitions at most."""
SLOWER: Final = 1.5
"""How many times longer each pause is than the one before."""
WORKING: Final = 0.25
"""Seconds between two repetitions once the board has said that it is at it."""
ANSWER_BYTES: Final = 24
"""Bytes of an answer that are allowed for in the time on the line."""
ANSWERS: Final = {
    Kind.ASK: (Kind.BOARD, Kind.TOPIC),
    Kind.OPEN: (Kind.OPENED,),
    Kind.CALL: (Kind.DONE, Kind.FAILED, Kind.TAKEN),
}


@dataclass
class Question:
    """What is asked until it is answered; `command` is the call that it is, if it is one."""

    frame: Frame
    again: float
    pause: float
    command: Command | None = None

    def is_answered_by(self, frame: Frame) -> bool:
        """Whether this is an answer to it, and not to one before."""
        same = (frame.sequence, frame.id) == (self.frame.sequence, self.frame.id)
        return same and frame.kind in ANSWERS[self.frame.kind]

    def is_being_done(self, now: float) -> None:
        """The board is at it: there is no hurry."""
        self.pause, self.again = WORKING, now + WORKING


class Asker:
    """Puts questions on a line of `baud` bits per second."""

    def __init__(self, counters: Counters, *, baud: int) -> None:
        self._counters = counters
        self._baud = baud
        self._out = bytearray()
        self.question: Question | None = None
        """The one that is under way."""

    def begin(self, frame: Frame, now: float, command: Command | None = None) -> Question:
        """Ask this now, instead of what was asked before."""
        data = encode(frame)
        pause = (len(data) + ANSWER_BYTES) * 10 / self._baud + ANSWER
        self.question = Question(frame, now + pause, pause, command)
        self._out += data
        self._counters.sent += 1
        return self.question

    def repeat(self, question: Question, now: float) -> None:
        """Ask this once more, after a byte that ends what noise has begun; the next time after a longer pause."""
        question.pause = min(question.pause * SLOWER, SLOWEST)
        question.again = now + question.pause
        self.question = question
        self._out += b"\0" + encode(question.frame)
        self._counters.sent += 1
        self._counters.repeated += 1

    def outgoing(self) -> bytes:
        """What to send now, once."""
        out = bytes(self._out)
        self._out.clear()
        return out

    def forget(self) -> None:
        """The line is closed: nothing is asked, nothing to be sent."""
        self.question = None
        self._out.clear()

    def rouse(self) -> None:
        """End what noise on the line has begun."""
        self._out += b"\0"
