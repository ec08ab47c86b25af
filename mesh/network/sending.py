"""Putting a message on a session: at once where somebody may wait for it, in a batch with others in a stream.

Zenoh holds a small message back for up to a millisecond, to send it with others in one batch. An `express` message is
sent at once, but takes one of the sixteen batches of each link's queue for itself. A stream of them fills the queues as
soon as a machine is busy for a few milliseconds, and messages are dropped. So a message is express only if nothing was
put on the session just before it, and if the session has credit left: a little from time to time, and one message for
each that it receives. A conversation is express throughout; of a stream, only the beginning is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from mesh.base.clock import SYSTEM_CLOCK

if TYPE_CHECKING:
    from zenoh import Session

    from mesh.base.clock import Clock


class SendingPace(NamedTuple):
    """When a message is sent at once, not with those that follow it."""

    quiet: float = 0.00025
    """Seconds without a message after which the next one may be."""
    credit: float = 8.0
    """Messages in succession that may be while nothing is received: half of a link's batches."""
    refill: float = 200.0
    """Such messages that a session gains in a second."""


SENDING_PACE: Final = SendingPace()
JSON: Final = "application/json"


class _Pace:
    __slots__ = ("credit", "last")

    def __init__(self) -> None:
        self.last = 0.0
        self.credit = SENDING_PACE.credit


_paces: dict[int, _Pace] = {}
"""The pace of each session, by the session's `id`: Zenoh's sessions hold no attributes."""


def put(
    session: Session,
    key: str,
    payload: bytes,
    *,
    encoding: str = JSON,
    attachment: bytes | None = None,
    clock: Clock = SYSTEM_CLOCK,
) -> None:
    """Put bytes on a key. A congested link drops them rather than block."""
    pace, now = _pace_of(session), clock.monotonic()
    quiet = now - pace.last
    pace.last = now
    pace.credit = min(SENDING_PACE.credit, pace.credit + quiet * SENDING_PACE.refill)
    express = quiet >= SENDING_PACE.quiet and pace.credit >= 1
    pace.credit -= express
    options: dict[str, Any] = {} if attachment is None else {"attachment": attachment}
    drop = zenoh.CongestionControl.DROP
    session.put(key, payload, encoding=encoding, congestion_control=drop, express=express, **options)


def received(session: Session) -> None:
    """A message was received on the session, which may answer it at once. Call it on any thread."""
    pace = _pace_of(session)
    pace.credit = min(SENDING_PACE.credit, pace.credit + 1)


def forget(session: Session) -> None:
    """The session was closed."""
    _paces.pop(id(session), None)


def _pace_of(session: Session) -> _Pace:
    pace = _paces.get(id(session))
    return _paces.setdefault(id(session), _Pace()) if pace is None else pace
