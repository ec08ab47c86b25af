"""Calls from the mesh to a device: their parameters, payloads and replies; and the topics of an edge agent itself."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Final

import msgspec

from bridges.serial.dialect import CallStatus, Command
from bridges.serial.errors import CALL_ERRORS, BoardBusy, InvalidBoardMessage
from mesh.log_context import log_event
from schemas.errors import InvalidPayload
from schemas.payloads import Empty, PayloadType, decode_value, encode_as

if TYPE_CHECKING:
    from collections.abc import Mapping

    import zenoh

    from bridges.serial.dialect import BoardTopic, CommandFinished, Dialect
    from bridges.serial.metrics import EdgeCounters

log = logging.getLogger(__name__)

ANSWER: Final = "/answer"
"""The topic below a called one on which a job's recording has what the board answered."""
PATIENCE: Final = 30.0
"""Seconds that a command waits for a board that is absent or busy, by default."""
MAX_PATIENCE: Final = 3600.0


class PendingCalls:
    """The queries that wait for the board to finish their commands, each of which gets one reply. For one thread."""

    def __init__(self, counters: EdgeCounters) -> None:
        self._counters = counters
        self._queries: dict[Command, zenoh.Query] = {}

    def key_of(self, command: Command) -> str:
        """The key on which a command was called; empty if it is no call."""
        query = self._queries.get(command)
        return "" if query is None else str(query.key_expr)

    def submit(self, query: zenoh.Query, topic: BoardTopic, payload: bytes, dialect: Dialect, patience: float) -> bool:
        """Submit a call as a command; `finish` replies to it. False if it is refused, which is its reply."""
        now = time.monotonic()
        command = Command(topic.name, payload, now + timeout_of(query, patience))
        try:
            dialect.submit(command, now)
        except (InvalidBoardMessage, BoardBusy) as error:
            reason = "full" if isinstance(error, BoardBusy) else "unfit"
            self._counters.count_outcome(reason)
            reply_failure(query, reason, str(error))
            return False
        self._queries[command] = query
        return True

    def finish(self, finished: CommandFinished) -> None:
        """Count the outcome of a command, and reply to its call, if it was one."""
        query = self._queries.pop(finished.command, None)
        self._counters.count_outcome(finished.reason or finished.status.value)
        if finished.status is CallStatus.FAILED:
            failed = log_event("command-failed", topic=finished.command.topic, reason=finished.reason)
            log.warning("%s: %s (%s)", finished.command.topic, finished.detail, finished.reason, extra=failed)
        if query is not None:
            reply(query, finished)

    def drop(self) -> None:
        """Drop all queries; their callers get no reply."""
        for query in self._queries.values():
            query.drop()  # type: ignore[no-untyped-call]
        self._queries.clear()


def is_for_device(query: zenoh.Query, device: str) -> bool:
    """Whether a call is for this device: its parameter `device` may name another one."""
    return query.parameters.get("device") in (None, device)


def timeout_of(query: zenoh.Query, default: float) -> float:
    """The seconds that the caller wants to wait: the parameter `timeout`."""
    try:
        seconds = float(query.parameters.get("timeout") or default)
    except ValueError:
        return default
    return min(max(seconds, 0.0), MAX_PATIENCE)


def convert(payload: bytes, given: PayloadType, wanted: PayloadType) -> bytes:
    """A payload converted from the caller's type to the topic's: a text, a number, a list, or nothing.

    Returned unchanged if that can't be done; the check against the topic's type then reports it.
    """
    if given.zenoh_encoding == wanted.zenoh_encoding:
        return payload
    try:
        value = decode_value(payload, given)
        converted = payload if isinstance(value, bytes | Empty) else encode_as(value, wanted)
    except InvalidPayload:
        return payload
    return payload if converted is None else converted


def reply(query: zenoh.Query, finished: CommandFinished) -> None:
    """Reply to a call with its outcome."""
    if finished.status is CallStatus.FAILED:
        reply_failure(query, finished.reason, finished.detail)
        return
    encoding = finished.type.zenoh_encoding if finished.type is not None else ""
    with query:
        query.reply(str(query.key_expr), finished.payload, encoding=encoding, attachment=finished.status.value)


def reply_failure(query: zenoh.Query, reason: str, detail: str) -> None:
    """Reply that a call was not done, or that this is not known; `reason` is a key of `CALL_ERRORS`."""
    assert reason in CALL_ERRORS
    with query:
        query.reply_err(msgspec.json.encode({"reason": reason, "detail": detail}), encoding="application/json")


def reply_about(query: zenoh.Query, dialect: Dialect, names: Mapping[BoardTopic, str], *, port: str, job: str) -> None:
    """Reply with what is known of the board, its topics (with their names in the mesh), and the line."""
    info = dialect.info
    facts = {
        "name": info.name if info is not None else "",
        "version": info.version if info is not None else "",
        "present": info is not None,
        "port": port,
        "job": job,
        "topics": [
            {"name": name, "flow": topic.flow.value, "type": topic.type.schema_name or topic.type.encoding}
            for topic, name in names.items()
        ],
        "counters": vars(dialect.counters),
    }
    with query:
        query.reply(str(query.key_expr), msgspec.json.encode(facts), encoding="application/json")
