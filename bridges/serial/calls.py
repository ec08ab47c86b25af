"""Calls from the mesh to a device: their parameters and payloads, their replies, and the job they belong to."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

import msgspec

from bridges.serial.dialect import CallStatus
from bridges.serial.errors import CALL_ERRORS
from mesh.errors import InvalidKey
from mesh.log_context import log_event
from schemas.errors import InvalidPayload
from schemas.keys import EventKey, parse_key
from schemas.payloads import EMPTY, JSON, STRING, PayloadType, String

if TYPE_CHECKING:
    import zenoh

    from bridges.serial.dialect import CommandFinished

log = logging.getLogger(__name__)

PATIENCE: Final = 30.0
"""Seconds that a command waits for a board that is absent or busy, by default."""
MAX_PATIENCE: Final = 3600.0


class JobTracker:
    """The agent's jobs that are ready and not complete, in order, as its edge agent sees them."""

    def __init__(self) -> None:
        self._open: list[str] = []

    @property
    def current(self) -> str:
        """The liability (address) that the device works for now: the first one; empty for none."""
        return self._open[0] if self._open else ""

    def begin(self, liability: str) -> None:
        """Make this job the current one: a command named it."""
        if liability in self._open:
            self._open.remove(liability)
        self._open.insert(0, liability)

    def handle_event(self, key: str) -> None:
        """Update the jobs by an event of the agent, given its key."""
        try:
            event = parse_key(key)
        except InvalidKey as error:
            log.info("%s", error, extra=log_event("key-ignored", key=key))
            return
        if not isinstance(event, EventKey):
            return
        if event.event == "ready" and event.liability not in self._open:
            self._open.append(event.liability)
        elif event.event in ("complete", "finalized") and event.liability in self._open:
            self._open.remove(event.liability)


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
    """A text or nothing, converted from the caller's type to the topic's; any other payload is returned unchanged."""
    try:
        if (given, wanted) == (STRING, JSON):
            return msgspec.json.encode(String.decode(payload).data)
        if (given, wanted) == (JSON, STRING) and isinstance(text := msgspec.json.decode(payload), str):
            return String(text).encode()
        if (given, wanted) == (JSON, EMPTY) and msgspec.json.decode(payload) is None:
            return b""
    except (InvalidPayload, msgspec.DecodeError, UnicodeDecodeError):
        pass  # it is not of the type it claims; the check against the topic's type will report that
    return payload


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
