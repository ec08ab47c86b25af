"""The host's side of our own frames: what board is there, calls that are done once, events.

One question is under way at a time and is asked again until it is answered, so nothing piles up in the board's 64
bytes. The board tells a repeated call from a new one by its sequence number and answers it from memory; after a restart
it takes no call before the host has opened a session anew, so the host always learns of the restart first.
"""

from __future__ import annotations

import logging
from typing import Final

import msgspec

from bridges.serial.asking import Asker, Question
from bridges.serial.dialect import (
    About,
    BoardTopic,
    Command,
    Ended,
    Ending,
    Flow,
    Gone,
    Host,
    Ready,
    Said,
)
from bridges.serial.errors import UnfitMessage
from bridges.serial.frames import BOARD_ID, SEQUENCES, Deframer, Frame, Kind
from bridges.serial.introduction import BoardWord, read_board, read_topic
from bridges.serial.values import from_board, to_board
from schemas.errors import InvalidPayload
from schemas.payloads import JSON, RAW

log = logging.getLogger(__name__)

QUIET: Final = 2.0
"""Seconds without a word after which a board is asked whether it is still there."""
MOST_SESSION: Final = 0xFFFF
LOST: Final = 5.0
"""Seconds without a word after which it is taken for gone."""


class CallingDialect(Host):
    """Own frames on a line of `baud` bits per second; `session` is a number from 1 to 65535 of this host's own."""

    def __init__(self, *, baud: int, session: int) -> None:
        super().__init__()
        self._asker = Asker(self.counters, baud=baud)
        self._session = session
        self._deframer = Deframer(self.counters)
        self._about: About | None = None
        self._open = False
        self._ready = False
        self._board: BoardWord | None = None
        self._listed: list[BoardTopic] = []
        self._call: Question | None = None
        self._asked = 0
        self._called = 0
        self._event_sequence: int | None = None
        self._heard = 0.0

    @property
    def about(self) -> About | None:
        """What the board has said of itself; None while it is not ready."""
        return self._about if self._ready else None

    @property
    def due(self) -> float:
        """When `pass_time` has to be called at the latest."""
        due = self._waiting.due
        if self._call is not None and self._call.command is not None:
            due = min(due, self._call.command.deadline)
        if self._open:
            question = self._asker.question
            due = min(due, question.again if question is not None else self._heard + QUIET)
        return due

    def opened(self, now: float) -> None:
        """The line is open: who is there?"""
        self._open, self._heard = True, now
        self._deframer.reset()
        self._asker.rouse()
        self._ask(BOARD_ID, now)

    def closed(self, now: float) -> None:
        """The line is closed. A call that is under way goes on if the same board, still running, is found again."""
        self._open = False
        self._asker.forget()
        self._leave("the line is closed")

    def receive(self, data: bytes, now: float) -> None:
        """These bytes have come."""
        for frame in self._deframer.feed(data):
            self._heard = now
            self._take(frame, now)

    def pass_time(self, now: float) -> None:
        """Give up what is late, repeat what is not answered, look after a quiet board."""
        self._expire(now)
        call = self._call
        if call is not None and call.command is not None and call.command.deadline <= now:
            self._give_up(call.command, now)
        if not self._open:
            return
        question = self._asker.question
        if self._heard + LOST <= now and (question is None or question.command is None):
            self._leave("the board does not answer")
        if question is None and self._heard + QUIET <= now:
            self._ask(BOARD_ID, now)
        elif question is not None and question.again <= now:
            self._asker.repeat(question, now)

    def submit(self, command: Command, now: float) -> None:
        """Have the board called, in its turn."""
        if self._about is not None and self._about.find(command.topic, Flow.HEARS) is None:
            raise UnfitMessage(command.topic, "the board has no such topic to be called")
        self._waiting.add(command)
        self._next(now)

    def answer(self, topic: BoardTopic, payload: bytes, now: float) -> None:
        """These boards ask nothing."""

    def outgoing(self) -> bytes:
        """What to send now, once."""
        return self._asker.outgoing()

    def _take(self, frame: Frame, now: float) -> None:
        if frame.kind is Kind.EVENT:
            self._event(frame)
            return
        if frame.kind is Kind.BOARD and self._take_board(frame, now):
            return
        question = self._asker.question
        if question is None or not question.is_answered_by(frame):
            self.counters.stray += 1
            return
        if frame.kind is Kind.TAKEN:
            question.is_being_done(now)
        elif question.command is not None:
            self._end_call(self._ended(question.command, frame), now)
        else:
            self._asker.question = None
            self._introduced(frame, now)

    def _take_board(self, frame: Frame, now: float) -> bool:
        """Whether this is a board that has not opened our session: it has just started, or is another one."""
        board = read_board(frame)
        if board is None:
            self.counters.refused += 1
            return True
        if board.session == self._session and self._about is not None:
            return False
        if self._call is not None and self._call.command is not None:
            why = "the board was restarted before it answered"
            command, self._call = self._call.command, None
            self._happened.append(Ended(command, Ending.FAILED, reason="doubt", detail=why))
        self._leave("the board was restarted")
        self._board, self._about, self._listed, self._event_sequence = board, None, [], None
        self._introduce(now)
        return True

    def _introduced(self, frame: Frame, now: float) -> None:
        """An answer to one of the questions by which we get to know a board."""
        if frame.kind is Kind.TOPIC:
            self._list(frame)
            self._introduce(now)
        elif frame.kind is Kind.OPENED and self._board is not None:
            self._about = About(self._board.name, self._board.version, tuple(self._listed))
            self._enter(now)
        elif not self._ready:
            self._enter(now)  # the same board, still running
        else:
            self._next(now)

    def _introduce(self, now: float) -> None:
        """Ask for the next topic, or open the session when all are known."""
        assert self._board is not None
        if len(self._listed) < self._board.topics:
            self._ask(len(self._listed), now)
        else:
            session = self._session.to_bytes(2, "little")
            self._asker.begin(Frame(Kind.OPEN, self._next_asked(), BOARD_ID, session), now)

    def _list(self, frame: Frame) -> None:
        topic = read_topic(frame)
        self.counters.refused += topic is None
        self._listed.append(topic or BoardTopic(f"/unusable/{frame.id}", Flow.SAYS, RAW, frame.id))

    def _enter(self, now: float) -> None:
        assert self._about is not None
        self._ready = True
        self._happened.append(Ready(self._about))
        if self._call is not None:
            self._asker.repeat(self._call, now)
        else:
            self._next(now)

    def _leave(self, why: str) -> None:
        if self._ready:
            self._ready = False
            self._happened.append(Gone(why))

    def _next(self, now: float) -> None:
        """Make the next call, if the board is free."""
        while self._ready and self._asker.question is None and (command := self._waiting.take()) is not None:
            assert self._about is not None
            topic = self._about.find(command.topic, Flow.HEARS)
            if topic is None:
                self._fail(command, "unfit", "the board has no such topic to be called")
                continue
            try:
                payload = to_board(topic.name, topic.type, command.payload)
            except UnfitMessage as error:
                self._fail(command, "unfit", str(error))
                continue
            self._called = (self._called + 1) % SEQUENCES
            command.begun = True
            self._call = self._asker.begin(Frame(Kind.CALL, self._called, topic.id, payload), now, command)

    def _ended(self, command: Command, frame: Frame) -> Ended:
        try:
            payload = from_board(JSON, frame.payload)
        except InvalidPayload as error:
            self.counters.refused += 1
            payload = b"null"
            log.warning("the board's answer to a call of %s can't be read: %s", command.topic, error)
        if frame.kind is Kind.DONE:
            return Ended(command, Ending.DONE, payload, JSON)
        why = msgspec.json.decode(payload)
        return Ended(command, Ending.FAILED, reason="refused", detail=str(why or "the board has not done it"))

    def _give_up(self, command: Command, now: float) -> None:
        """Nobody waits any longer for the call under way; in a new session its number is not taken for a later one."""
        self._leave("the board did not answer a call")
        self._session = self._session % MOST_SESSION + 1
        self._end_call(Ended(command, Ending.FAILED, reason="doubt", detail="the board did not answer"), now)
        if self._open:
            self._ask(BOARD_ID, now)

    def _end_call(self, ended: Ended, now: float) -> None:
        if self._asker.question is self._call:
            self._asker.question = None
        self._call = None
        self._happened.append(ended)
        self._next(now)

    def _event(self, frame: Frame) -> None:
        if self._event_sequence is not None:
            self.counters.missed += (frame.sequence - self._event_sequence - 1) % SEQUENCES
        self._event_sequence = frame.sequence
        topics = self._about.topics if self._about is not None else ()
        topic = next((topic for topic in topics if topic.id == frame.id and topic.flow is Flow.SAYS), None)
        if topic is None:
            self.counters.stray += 1
            return
        try:
            self._happened.append(Said(topic, from_board(topic.type, frame.payload)))
        except InvalidPayload as error:
            self.counters.refused += 1
            log.info("a message of the board on %s can't be read: %s", topic.name, error)

    def _ask(self, what: int, now: float) -> None:
        self._asker.begin(Frame(Kind.ASK, self._next_asked(), what), now)

    def _next_asked(self) -> int:
        self._asked = (self._asked + 1) % SEQUENCES
        return self._asked
