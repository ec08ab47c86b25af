"""Questions to whoever answers on a key: there may be several, or nobody."""

from __future__ import annotations

import asyncio
from itertools import islice
from typing import TYPE_CHECKING, Final

import zenoh

if TYPE_CHECKING:
    from collections.abc import Iterable

TIMEOUT: Final = 3.0
"""Seconds to wait for answers that take their maker no time."""
ANSWERS: Final = 256
"""Answers to one question that are read at most."""


async def answers(session: zenoh.Session, keys: Iterable[str], *, timeout: float = TIMEOUT) -> list[bytes]:
    """What is answered on these keys, all asked at once. Nobody there, an error, and silence for so many seconds are
    no answer. Cancelling ends the asking."""
    asking = zenoh.CancellationToken()
    try:
        return await asyncio.to_thread(_answers, session, list(keys), timeout, asking)
    finally:
        asking.cancel()  # type: ignore[no-untyped-call]


def _answers(session: zenoh.Session, keys: list[str], timeout: float, asking: zenoh.CancellationToken) -> list[bytes]:
    asked = [
        session.get(
            key,
            zenoh.handlers.FifoChannel(ANSWERS),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
            cancellation_token=asking,
        )
        for key in keys
    ]
    return [
        reply.ok.payload.to_bytes() for replies in asked for reply in islice(replies, ANSWERS) if reply.ok is not None
    ]
