"""The host's side of our own frames: the handshake with a board, calls that are done exactly once, and events.

One request is pending at a time and is repeated until it is answered, so nothing piles up in the board's 64 bytes. The
board recognizes a repeated call by its sequence number and answers it from memory; after a restart it accepts no call
until the host has opened a new session, so the host always learns of the restart first.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import msgspec

from bridges.serial import frames
from bridges.serial.dialect import (
    BoardLost,
    BoardReady,
    BoardTopic,
    CallStatus,
    CommandFinished,
    DeviceInfo,
    Dialect,
    Flow,
    MessageReceived,
)
from bridges.serial.errors import InvalidBoardMessage
from bridges.serial.frames import BOARD_ID, SEQUENCES, BoardDescription, Frame, FrameDecoder, FrameKind, encode_frame
from mesh.log_context import log_event
from schemas.errors import InvalidPayload
from schemas.payloads import JSON, RAW

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bridges.serial.dialect import Command

log = logging.getLogger(__name__)

QUIET: Final = 2.0
"""Seconds of silence after which the board is asked whether it is still there."""
LOST: Final = 5.0
"""Seconds of silence after which the board is lost."""
MAX_SESSION: Final = 0xFFFF
ANSWER_TIME: Final = 0.03
"""Seconds that a board has for an answer, besides the time on the line, before the request is repeated."""
ANSWER_BYTES: Final = 24
"""Bytes of an answer that the time on the line allows for."""
REPEAT_FACTOR: Final = 1.5
MAX_REPEAT_DELAY: Final = 1.0
TAKEN_DELAY: Final = 0.25
"""Seconds between two repetitions once the board has said that it is working on the call."""
ANSWERS: Final = {
    FrameKind.ASK: (FrameKind.BOARD, FrameKind.TOPIC),
    FrameKind.OPEN: (FrameKind.OPENED,),
    FrameKind.CALL: (FrameKind.DONE, FrameKind.FAILED, FrameKind.TAKEN),
}


@dataclass
class Request:
    """A frame that is repeated, at `repeat_at` next, until it is answered; `command` if it is a call."""

    frame: Frame
    repeat_at: float
    delay: float
    command: Command | None = None

    def is_answered_by(self, frame: Frame) -> bool:
        """Whether this frame answers this request, and not an earlier one."""
        same = (frame.sequence, frame.id) == (self.frame.sequence, self.frame.id)
        return same and frame.kind in ANSWERS[self.frame.kind]


class FramesDialect(Dialect):
    """Own frames. `session` is the number from 1 to 65535 of the first session; a random one by default."""

    def __init__(
        self, *, baud: int, parameters: Mapping[str, object] | None = None, session: int | None = None
    ) -> None:
        super().__init__(baud=baud, parameters=parameters)
        self._session = session or int.from_bytes(os.urandom(2), "little") or MAX_SESSION
        self._decoder = FrameDecoder(self.counters)
        self._board: BoardDescription | None = None
        self._topics: list[BoardTopic] = []
        self._known: DeviceInfo | None = None
        self._pending: Request | None = None
        self._call: Request | None = None
        self._ask_sequence = self._call_sequence = 0
        self._event_sequence: int | None = None
        self._last_heard = 0.0

    @property
    def next_tick(self) -> float:
        """When `tick` has to be called at the latest."""
        times = [self._next_expiry]
        if self._call is not None and self._call.command is not None:
            times.append(self._call.command.deadline)
        if self._is_open:
            times.append(self._pending.repeat_at if self._pending is not None else self._last_heard + QUIET)
        return min(times)

    def opened(self, now: float) -> None:
        """Ask which board is there."""
        self._is_open, self._last_heard = True, now
        self._decoder.reset()
        self._out += b"\0"  # ends what noise on the line has begun
        self._ask(BOARD_ID, now)

    def closed(self, now: float) -> None:
        """A pending call is resumed if the same board, still running, is found again."""
        self._is_open, self._pending = False, None
        self._out.clear()
        self._lose_board("the line is closed")

    def receive(self, data: bytes, now: float) -> None:
        """Decode frames and handle them."""
        for frame in self._decoder.feed(data):
            self._last_heard = now
            self._handle(frame, now)

    def tick(self, now: float) -> None:
        """Give up what is late, repeat what was not answered, check a quiet board."""
        self._expire_queued(now)
        call = self._call
        if call is not None and call.command is not None and call.command.deadline <= now:
            self._give_up(call.command, now)
        if not self._is_open:
            return
        request = self._pending
        if self._last_heard + LOST <= now and (request is None or request.command is None):
            self._lose_board("the board does not answer")
        if request is None and self._last_heard + QUIET <= now:
            self._ask(BOARD_ID, now)
        elif request is not None and request.repeat_at <= now:
            self._repeat(request, now)

    def submit(self, command: Command, now: float) -> None:
        """Queue a call."""
        if self._known is not None and self._known.find(command.topic, Flow.SUBSCRIBES) is None:
            raise InvalidBoardMessage(command.topic, "the board has no such topic to call")
        self._enqueue(command)
        self._call_next(now)

    def _handle(self, frame: Frame, now: float) -> None:
        if frame.kind is FrameKind.EVENT:
            self._handle_event(frame)
            return
        if frame.kind is FrameKind.BOARD and self._handle_board(frame, now):
            return
        request = self._pending
        if request is None or not request.is_answered_by(frame):
            self.counters.stray += 1
        elif frame.kind is FrameKind.TAKEN:
            request.delay, request.repeat_at = TAKEN_DELAY, now + TAKEN_DELAY
        elif request.command is not None:
            self._events.append(self._outcome(request.command, frame))
            self._end_call(now)
        else:
            self._pending = None
            self._continue_handshake(frame, now)

    def _handle_board(self, frame: Frame, now: float) -> bool:
        """Whether this board has not opened our session: it was just started, or it is another one."""
        board = frames.decode_board(frame)
        if board is None:
            self.counters.refused += 1
            return True
        if board.session == self._session and self._known is not None:
            return False
        if self._call is not None and self._call.command is not None:
            command, self._call = self._call.command, None
            self._fail(command, "doubt", "the board was restarted before it answered")
        self._lose_board("the board was restarted")
        self._board, self._known, self._topics, self._event_sequence = board, None, [], None
        self._ask_next_topic(now)
        return True

    def _continue_handshake(self, frame: Frame, now: float) -> None:
        if frame.kind is FrameKind.TOPIC:
            topic = frames.decode_topic(frame)
            self.counters.refused += topic is None
            self._topics.append(topic or BoardTopic(f"/unusable/{frame.id}", Flow.PUBLISHES, RAW, frame.id))
            self._ask_next_topic(now)
        elif frame.kind is FrameKind.OPENED and self._board is not None:
            self._known = DeviceInfo(self._board.name, self._board.version, tuple(self._topics))
            self._board_ready(now)
        elif self.info is None:
            self._board_ready(now)  # the same board, still running
        else:
            self._call_next(now)

    def _ask_next_topic(self, now: float) -> None:
        """Ask for the next topic, or open the session when all are known."""
        assert self._board is not None
        if len(self._topics) < self._board.topics:
            self._ask(len(self._topics), now)
        else:
            self._ask(BOARD_ID, now, FrameKind.OPEN, self._session.to_bytes(2, "little"))

    def _board_ready(self, now: float) -> None:
        assert self._known is not None
        self.info = self._known
        self._events.append(BoardReady(self._known))
        if self._call is not None:
            self._repeat(self._call, now)
        else:
            self._call_next(now)

    def _lose_board(self, why: str) -> None:
        if self.info is not None:
            self.info = None
            self._events.append(BoardLost(why))

    def _call_next(self, now: float) -> None:
        """Send the next queued call if none is pending."""
        while self.info is not None and self._pending is None and self._queue:
            command = self._queue.pop(0)
            topic = self.info.find(command.topic, Flow.SUBSCRIBES)
            if topic is None:
                self._fail(command, "unfit", "the board has no such topic to call")
                continue
            try:
                payload = frames.encode_payload(topic.name, topic.type, command.payload)
            except InvalidBoardMessage as error:
                self._fail(command, "unfit", str(error))
                continue
            self._call_sequence = (self._call_sequence + 1) % SEQUENCES
            command.begun = True
            self._call = self._send(Frame(FrameKind.CALL, self._call_sequence, topic.id, payload), now, command)

    def _outcome(self, command: Command, frame: Frame) -> CommandFinished:
        try:
            payload = frames.decode_payload(JSON, frame.payload)
        except InvalidPayload as error:
            self.counters.refused += 1
            payload = b"null"
            undecodable = log_event("answer-undecodable", topic=command.topic)
            log.warning("the answer to a call of %s can't be decoded: %s", command.topic, error, extra=undecodable)
        if frame.kind is FrameKind.DONE:
            return CommandFinished(command, CallStatus.DONE, payload, JSON)
        why = str(msgspec.json.decode(payload) or "the board has not done it")
        return CommandFinished(command, CallStatus.FAILED, reason="refused", detail=why)

    def _give_up(self, command: Command, now: float) -> None:
        """Fail the pending call, and begin a new session, in which its sequence number means nothing."""
        self._lose_board("the board did not answer a call")
        self._session = self._session % MAX_SESSION + 1
        self._fail(command, "doubt", "the board did not answer")
        self._end_call(now)
        if self._is_open:
            self._ask(BOARD_ID, now)

    def _end_call(self, now: float) -> None:
        if self._pending is self._call:
            self._pending = None
        self._call = None
        self._call_next(now)

    def _handle_event(self, frame: Frame) -> None:
        if self._event_sequence is not None:
            self.counters.missed += (frame.sequence - self._event_sequence - 1) % SEQUENCES
        self._event_sequence = frame.sequence
        topics = self._known.topics if self._known else ()
        topic = next((each for each in topics if each.id == frame.id and each.flow is Flow.PUBLISHES), None)
        if topic is None:
            self.counters.stray += 1
            return
        try:
            self._events.append(MessageReceived(topic, frames.decode_payload(topic.type, frame.payload)))
        except InvalidPayload as error:
            self.counters.refused += 1
            undecodable = log_event("message-undecodable", topic=topic.name)
            log.info("a message of the board on %s can't be decoded: %s", topic.name, error, extra=undecodable)

    def _ask(self, what: int, now: float, kind: FrameKind = FrameKind.ASK, payload: bytes = b"") -> None:
        self._ask_sequence = (self._ask_sequence + 1) % SEQUENCES
        self._send(Frame(kind, self._ask_sequence, what, payload), now)

    def _send(self, frame: Frame, now: float, command: Command | None = None) -> Request:
        """Send a request, in place of the one that is pending."""
        data = encode_frame(frame)
        delay = (len(data) + ANSWER_BYTES) * 10 / self.baud + ANSWER_TIME
        self._pending = Request(frame, now + delay, delay, command)
        self._out += data
        self.counters.sent += 1
        return self._pending

    def _repeat(self, request: Request, now: float) -> None:
        """Send a request again after a zero byte, which ends what noise has begun. The next delay is longer."""
        request.delay = min(request.delay * REPEAT_FACTOR, MAX_REPEAT_DELAY)
        request.repeat_at = now + request.delay
        self._pending = request
        self._out += b"\0" + encode_frame(request.frame)
        self.counters.sent += 1
        self.counters.repeated += 1
