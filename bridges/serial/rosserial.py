"""The host's side of rosserial version 2, for every sketch that speaks it.

A board acknowledges nothing and keeps 64 bytes. What it does do is to announce its topics when it is asked, in its
turn; so each command is followed by that question, and the next one is sent when the answer has come: until then the
board may still be within the callback of the last. All else is unknown: a damaged command is skipped silently.
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Final

from bridges.serial import roswire
from bridges.serial.announcements import Announcements
from bridges.serial.dialect import (
    Command,
    Ended,
    Ending,
    Flow,
    Gone,
    Host,
    Logged,
    Ready,
    Said,
)
from bridges.serial.errors import UnfitMessage
from bridges.serial.rostypes import known_type
from bridges.serial.roswire import ASK_TOPICS, Deframer, Message
from schemas.errors import InvalidPayload

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from bridges.serial.dialect import About, BoardTopic
    from bridges.serial.roswire import TopicInfo

log = logging.getLogger(__name__)

ASKED_EVERY: Final = 0.5
"""Seconds between two questions for the topics while a board starts."""
SETTLED: Final = 0.1
"""Seconds without another announcement after which a board has announced all."""
QUIET: Final = 3.0
"""Seconds without a word after which the topics are asked for again: a board asks the time every 2.5."""
LOST: Final = 10.0
"""Seconds without a word, and without a command under way, after which a board is taken for gone."""
FIRST_PAUSE: Final = 0.2
"""Seconds after which a lost question behind a command is put again; then twice as many each time."""
QUESTIONS: Final = 5
"""Questions behind one command at most: more would fill the board's 64 bytes while a callback blocks."""


class _Under:
    """The command that is under way."""

    def __init__(self, command: Command, topic: BoardTopic, now: float) -> None:
        self.command = command
        self.topic = topic
        self.pause = FIRST_PAUSE
        self.again = now + FIRST_PAUSE
        self.questions = 1
        self.answer: bytes | None = None


class RosserialDialect(Host):
    """rosserial on a line of `baud` bits per second. `parameters` are what a sketch may ask for, by name."""

    def __init__(
        self, *, baud: int, parameters: Mapping[str, object] | None = None, clock: Callable[[], float] = time.time
    ) -> None:
        super().__init__()
        self._announced = Announcements(roswire.longest_frame(baud))
        self._last: tuple[int, int] | None = None
        self._parameters = dict(parameters or {})
        self._clock = clock
        self._deframer = Deframer(self.counters)
        self._about: About | None = None
        self._open = False
        self._heard = self._asked = 0.0
        self._settled: float | None = None
        self._answering = 0
        self._under: _Under | None = None
        self._out = bytearray()

    @property
    def about(self) -> About | None:
        """The board's topics; None while it is not ready."""
        return self._about

    @property
    def due(self) -> float:
        """When `pass_time` has to be called at the latest."""
        due = self._waiting.due
        if self._under is not None:
            due = min(due, self._under.again, self._under.command.deadline)
        if self._settled is not None:
            due = min(due, self._settled)
        if self._open:
            quiet = self._heard + QUIET if self._about is not None else 0.0
            due = min(due, max(quiet, self._asked + ASKED_EVERY))
        return due

    def opened(self, now: float) -> None:
        """The line is open: ask for the topics, which a board that is starting does not hear yet."""
        self._open, self._heard = True, now
        self._deframer.reset()
        self._ask_topics(now)

    def closed(self, now: float) -> None:
        """The line is closed. What was under way may or may not have been read."""
        self._open, self._settled = False, None
        self._out.clear()
        self._leave("the line is closed")

    def receive(self, data: bytes, now: float) -> None:
        """These bytes have come."""
        for message in self._deframer.feed(data):
            self._heard = now
            self._take(message, now)

    def pass_time(self, now: float) -> None:
        """Give up what is late, ask a quiet board for its topics, end an introduction."""
        self._expire(now)
        if self._settled is not None and self._settled <= now:
            self._settle(now)
        under = self._under
        if under is not None and under.command.deadline <= now:
            self._end(Ending.FAILED, "doubt", "the board did not read on", now)
        elif under is not None and under.again <= now:
            self._ask_behind(under, now)
        if not self._open:
            return
        quiet = self._about is None or self._heard + QUIET <= now
        if quiet and under is None and self._asked + ASKED_EVERY <= now:
            self._ask_topics(now)
        if self._about is not None and under is None and self._heard + LOST <= now:
            self._leave("the board is silent")

    def submit(self, command: Command, now: float) -> None:
        """Send it to the board, in its turn. Raises `UnfitMessage` for what the board can't take."""
        if self._about is not None:
            self._announced.fitting(command)
        self._waiting.add(command)
        self._next(now)

    def answer(self, topic: BoardTopic, payload: bytes, now: float) -> None:
        """Answer what the board asked, within what it can take."""
        answering = self._announced.answers(topic)
        if answering is None or len(payload) > self._announced.room(answering):
            log.warning("the answer to %s does not reach the board: %d bytes", topic.name, len(payload))
            return
        self._send(Message(answering, payload))

    def outgoing(self) -> bytes:
        """What to send now, once."""
        out = bytes(self._out)
        self._out.clear()
        return out

    def _take(self, message: Message, now: float) -> None:
        try:
            if message.id in roswire.ANNOUNCEMENTS:
                self._introduced(message.id, roswire.read_topic_info(message.data), now)
            elif message.id == roswire.TIME:
                self._send(roswire.time_answer(self._clock()))
            elif message.id == roswire.LOG:
                self._happened.append(Logged(*roswire.read_log(message.data)))
            elif message.id == roswire.PARAMETER:
                self._asked_parameter(roswire.read_parameter_name(message.data))
            else:
                self._said(message, now)
        except (roswire.Malformed, InvalidPayload) as error:
            self.counters.refused += 1
            log.info("a frame of the board can't be used: %s", error)

    def _introduced(self, kind: int, info: TopicInfo, now: float) -> None:
        if not self._announced.add(kind, info):
            self._leave("the board has other topics now")
            self._announced.add(kind, info)
        if self._about is not None and self._under is not None and self._under.topic.flow is Flow.HEARS:
            self._settled, self._answering = now + SETTLED, self._under.questions
            self._end(Ending.READ, "", "", now)
        if self._about is None or self._settled is not None:
            self._settled = now + SETTLED
            self._answering -= (kind, info.id) == self._last
            if self._about is not None and self._answering <= 0:
                self._settle(now)

    def _settle(self, now: float) -> None:
        """No more announcements come."""
        self._settled = None
        if self._about is None:
            self._about, self._last = self._announced.about(), self._announced.last
            self._happened.append(Ready(self._about))
        self._next(now)

    def _said(self, message: Message, now: float) -> None:
        under = self._under
        if under is not None and self._announced.answers(under.topic) == message.id:
            under.answer = message.data
            self._end(Ending.DONE, "", "", now)
            return
        topic = self._announced.speaking(message.id)
        if topic is None:
            self.counters.stray += 1
            return
        if topic.flow is Flow.SAYS and (known := known_type(topic.type.schema_name)) is not None:
            known.check(message.data)
        self._happened.append(Said(topic, message.data))

    def _asked_parameter(self, name: str) -> None:
        value = self._parameters.get(name, self._parameters.get(name.lstrip("~/")))
        if value is None:
            log.warning("the board asks for the parameter %r, which is not set", name)
        self._send(roswire.parameter_answer(value))

    def _next(self, now: float) -> None:
        free = self._about is not None and self._settled is None
        while free and self._under is None and (command := self._waiting.take()) is not None:
            try:
                topic, message = self._announced.fitting(command)
            except UnfitMessage as error:
                self._fail(command, "unfit", str(error))
                continue
            command.begun = True
            self._under = _Under(command, topic, now)
            self._send(message)
            if topic.flow is Flow.HEARS:
                self._out += ASK_TOPICS

    def _ask_behind(self, under: _Under, now: float) -> None:
        """Nothing has come of the question behind a command: it was damaged, or the board is within a callback."""
        under.pause *= 2
        under.again = now + under.pause
        if self._open and under.questions < QUESTIONS and under.topic.flow is Flow.HEARS:
            under.questions += 1
            self.counters.repeated += 1
            self._out += ASK_TOPICS

    def _end(self, ending: Ending, reason: str, detail: str, now: float) -> None:
        assert self._under is not None
        under, self._under = self._under, None
        kind = under.topic.type if under.answer is not None else None
        self._happened.append(Ended(under.command, ending, under.answer or b"", kind, reason, detail))
        self._next(now)

    def _leave(self, why: str) -> None:
        """The board is not ready any more. What was under way is in doubt, what waits goes on waiting."""
        if self._under is not None:
            under, self._under = self._under, None
            self._fail(under.command, "doubt", f"{why}, and nobody knows whether the board had read it")
        if self._about is not None:
            self._about = None
            self._happened.append(Gone(why))
        self._announced.clear()

    def _ask_topics(self, now: float) -> None:
        self._asked = now
        self._out += ASK_TOPICS
        self.counters.sent += 1

    def _send(self, message: Message) -> None:
        self._out += roswire.encode(message)
        self.counters.sent += 1
