"""The host's side of rosserial version 2, for every sketch that speaks it.

A board acknowledges nothing and buffers 64 bytes. But it announces its topics on request, so that request follows each
command, and the next command is sent after the answer: until then the board may still run the last callback. The
answer proves no more: the board skips a damaged command silently.

After a cable was pulled during a command, the board is not asked: if it was not restarted, it speaks within seconds.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from bridges.serial import rosserial
from bridges.serial.dialect import (
    BoardLogged,
    BoardLost,
    BoardReady,
    CallStatus,
    Command,
    CommandFinished,
    Dialect,
    Flow,
    MessageReceived,
)
from bridges.serial.errors import InvalidBoardMessage
from bridges.serial.rosserial import ASK_TOPICS, RosserialDecoder, RosserialMessage
from bridges.serial.rosserial_topics import TopicTable, known_type
from mesh.log_context import log_event
from schemas.errors import InvalidPayload

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from bridges.serial.dialect import BoardTopic
    from bridges.serial.rosserial import TopicInfo

log = logging.getLogger(__name__)

ASK_INTERVAL: Final = 0.5
"""Seconds between two requests for the topics while a board starts."""
SETTLE_TIME: Final = 0.1
"""Seconds without another announcement after which a board has announced all."""
MISSING_TIME: Final = 0.5
"""The same behind a command if answers are missing: their requests were lost, or the board is late."""
ANNOUNCEMENT: Final = 300
"""Bytes for whose time on the line a board may be silent between two announcements, if that takes longer."""
QUIET: Final = 3.0
"""Seconds of silence after which the topics are requested again: a board asks for the time every 2.5."""
LOST: Final = 10.0
"""Seconds of silence, without an active command, after which a board is lost."""
FIRST_DELAY: Final = 0.2
"""Seconds after which the request behind a command is repeated; each further delay is twice as long."""
CUT_OFF: Final = 0.1
"""Seconds after a command was sent in which a pulled cable may have cut it off."""
FORGETS: Final = 11.5
"""Seconds after the last answer to a board's request for the time, after which it does not speak by itself any more."""
MAX_REQUESTS: Final = 5
"""The most requests behind one command: more would fill the board's 64 bytes while a callback blocks."""


@dataclass
class _ActiveCommand:
    """The command that was sent and has not ended."""

    command: Command
    topic: BoardTopic
    sent_at: float
    repeat_at: float
    delay: float = FIRST_DELAY
    requests: int = 1
    answer: bytes | None = None


class RosserialDialect(Dialect):
    """rosserial. `parameters` are what a sketch may request; `clock` gives the time that boards ask for. A command
    waits `settle_time` s if answers to requests behind the last one are missing: longer for a slow board."""

    def __init__(
        self,
        *,
        baud: int,
        parameters: Mapping[str, object] | None = None,
        clock: Callable[[], float] = time.time,
        settle_time: float = MISSING_TIME,
    ) -> None:
        super().__init__(baud=baud, parameters=parameters)
        self._clock = clock
        self._ready_time = max(SETTLE_TIME, ANNOUNCEMENT * 10 / baud)
        self._settle_time = max(settle_time, self._ready_time)
        self._decoder = RosserialDecoder(self.counters)
        self._topics = TopicTable(rosserial.longest_frame(baud))
        self._last_announced: tuple[int, int] | None = None
        self._last_heard = self._last_asked = self._remembers_until = 0.0
        self._settled_at: float | None = None
        self._answers_expected = 0
        self._active: _ActiveCommand | None = None
        self._listens_until: float | None = None

    @property
    def next_tick(self) -> float:
        """When `tick` has to be called at the latest."""
        due = self._next_expiry
        if self._active is not None:
            due = min(due, self._active.repeat_at, self._active.command.deadline)
        if self._listens_until is not None:
            due = min(due, self._listens_until)
        if self._settled_at is not None:
            due = min(due, self._settled_at)
        elif self._is_open and self._active is None:
            quiet = self._last_heard + QUIET if self.info is not None else 0.0
            due = min(due, max(quiet, self._last_asked + ASK_INTERVAL))
        return due

    def opened(self, now: float) -> None:
        """Request the topics, which a board that is starting does not hear; or listen what became of a command."""
        self._is_open, self._last_heard = True, now
        self._decoder.reset()
        if self._listens_until is None:
            self._ask_topics(now)

    def closed(self, now: float) -> None:
        """The active command waits if the board may still remember the host; otherwise it is in doubt."""
        self._is_open, self._settled_at = False, None
        self._out.clear()
        active = self._active
        until = None
        if active is not None and active.topic.flow is Flow.SUBSCRIBES and active.sent_at + CUT_OFF <= now:
            until, active.repeat_at = self._remembers_until, float("inf")
        self._lose_board("the line is closed", until=until)

    def receive(self, data: bytes, now: float) -> None:
        """Decode messages and handle them."""
        for message in self._decoder.feed(data):
            self._last_heard = now
            self._handle(message, now)

    def tick(self, now: float) -> None:
        """Give up what is late, request the topics of a quiet board, end a series of announcements."""
        self._expire_queued(now)
        if self._settled_at is not None and self._settled_at <= now:
            self._settle(now)
        if self._listens_until is not None and self._listens_until <= now:
            self._lose_board("the board was restarted, or was silent for long")
        active = self._active
        if active is not None and active.command.deadline <= now:
            self._finish(CallStatus.FAILED, "doubt", "the board did not read on", now)
        elif active is not None and active.repeat_at <= now:
            self._repeat_request(active, now)
        if not self._is_open or self._settled_at is not None:
            return
        quiet = self.info is None or self._last_heard + QUIET <= now
        if quiet and active is None and self._last_asked + ASK_INTERVAL <= now:
            self._ask_topics(now)
        if self.info is not None and active is None and self._last_heard + LOST <= now:
            self._lose_board("the board is silent")

    def submit(self, command: Command, now: float) -> None:
        """Queue a command. Raises `InvalidBoardMessage` if the board can't accept it."""
        if self.info is not None:
            self._topics.resolve(command)
        self._enqueue(command)
        self._send_next(now)

    def respond(self, topic: BoardTopic, payload: bytes, now: float) -> None:
        """Send the response to a request of the board, if it fits its buffer."""
        response_id = self._topics.response_id(topic)
        if response_id is None or len(payload) > self._topics.max_data(response_id):
            dropped = log_event("response-dropped", topic=topic.name, bytes=len(payload))
            log.warning("the response on %s, %d bytes, is too long", topic.name, len(payload), extra=dropped)
            return
        self._send(RosserialMessage(response_id, payload))

    def _handle(self, message: RosserialMessage, now: float) -> None:
        if self._listens_until is not None and message.id not in (rosserial.LOG, rosserial.PARAMETER):
            self._resume(now, ask=message.id not in rosserial.ANNOUNCEMENTS)
        try:
            if message.id in rosserial.ANNOUNCEMENTS:
                self._handle_announcement(message.id, rosserial.decode_topic_info(message.data), now)
            elif message.id == rosserial.TIME:
                self._remembers_until = now + FORGETS
                self._send(rosserial.encode_time(self._clock()))
            elif message.id == rosserial.LOG:
                self._events.append(BoardLogged(*rosserial.decode_log(message.data)))
            elif message.id == rosserial.PARAMETER:
                self._handle_parameter_request(rosserial.decode_parameter_name(message.data))
            else:
                self._handle_message(message, now)
        except (rosserial.MalformedMessage, InvalidPayload) as error:
            self.counters.refused += 1
            log.info("a message of the board can't be decoded: %s", error, extra=log_event("message-undecodable"))

    def _handle_announcement(self, kind: int, info: TopicInfo, now: float) -> None:
        if self._topics.last is None:
            self._ask_topics(now)  # to learn from the second answer where the first one ends
        if not self._topics.add(kind, info):
            self._lose_board("the board has other topics now")
            self._topics.add(kind, info)
        if self.info is not None and self._active is not None and self._active.topic.flow is Flow.SUBSCRIBES:
            self._settled_at, self._answers_expected = now + self._settle_time, self._active.requests
            self._finish(CallStatus.READ, "", "", now)
        if self.info is None or self._settled_at is not None:
            self._settled_at = now + (self._ready_time if self.info is None else self._settle_time)
            self._answers_expected -= (kind, info.id) == self._last_announced
            if self.info is not None and self._answers_expected <= 0:
                self._settle(now)

    def _settle(self, now: float) -> None:
        """The announcements have ended; if they have not been repeated yet, they are requested again."""
        self._settled_at = None
        if self.info is None and self._topics.is_complete:
            self.info, self._last_announced = self._topics.device_info(), self._topics.last
            self._events.append(BoardReady(self.info))
        self._send_next(now)

    def _handle_message(self, message: RosserialMessage, now: float) -> None:
        active = self._active
        if active is not None and self._topics.response_id(active.topic) == message.id:
            active.answer = message.data
            self._finish(CallStatus.DONE, "", "", now)
            return
        topic = self._topics.sender(message.id)
        if topic is None:
            self.counters.stray += 1
            return
        if topic.flow is Flow.PUBLISHES and (known := known_type(topic.type.schema_name)) is not None:
            known.check(message.data)
        self._events.append(MessageReceived(topic, message.data))

    def _handle_parameter_request(self, name: str) -> None:
        value = self._parameters.get(name, self._parameters.get(name.lstrip("~/")))
        if value is None:
            missing = log_event("parameter-missing", parameter=name)
            log.warning("the board requests the parameter %r, which is not set", name, extra=missing)
        self._send(rosserial.encode_parameter(value))

    def _send_next(self, now: float) -> None:
        free = self.info is not None and self._settled_at is None
        while free and self._active is None and self._queue:
            command = self._queue.pop(0)
            try:
                topic, message = self._topics.resolve(command)
            except InvalidBoardMessage as error:
                self._fail(command, "unfit", str(error))
                continue
            command.begun = True
            self._active = _ActiveCommand(command, topic, now, now + FIRST_DELAY)
            self._send(message)
            if topic.flow is Flow.SUBSCRIBES:
                self._out += ASK_TOPICS

    def _repeat_request(self, active: _ActiveCommand, now: float) -> None:
        """Repeat the request behind a command: it was damaged, or the board is running a callback."""
        active.delay *= 2
        active.repeat_at = now + active.delay
        if active.requests < MAX_REQUESTS and active.topic.flow is Flow.SUBSCRIBES:
            active.requests += 1
            self.counters.repeated += 1
            self._out += ASK_TOPICS

    def _finish(self, status: CallStatus, reason: str, detail: str, now: float) -> None:
        assert self._active is not None
        active, self._active, self._listens_until = self._active, None, None
        kind = active.topic.type if active.answer is not None else None
        self._events.append(CommandFinished(active.command, status, active.answer or b"", kind, reason, detail))
        self._send_next(now)

    def _lose_board(self, why: str, *, until: float | None = None) -> None:
        """The board is no longer ready. The active command waits `until` then, or is in doubt; queued ones stay."""
        self._listens_until = until
        if self._active is not None and until is None:
            active, self._active = self._active, None
            self._fail(active.command, "doubt", f"{why}; it is not known whether the board had read it")
        if self.info is not None:
            self.info = None
            self._events.append(BoardLost(why))
        if until is None:
            self._topics.clear()

    def _resume(self, now: float, *, ask: bool) -> None:
        """The board has not restarted: it is ready as before, and has read the active command or will."""
        assert self._active is not None
        self._listens_until, self.info = None, self._topics.device_info()
        self._events.append(BoardReady(self.info))
        if ask:
            self._active.requests, self._active.delay, self._active.repeat_at = 1, FIRST_DELAY, now + FIRST_DELAY
            self._out += ASK_TOPICS

    def _ask_topics(self, now: float) -> None:
        self._last_asked = now
        self._out += ASK_TOPICS
        self.counters.sent += 1

    def _send(self, message: RosserialMessage) -> None:
        self._out += rosserial.encode_message(message)
        self.counters.sent += 1
