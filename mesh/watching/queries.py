"""Zenoh queries that several processes may answer, or none."""

from __future__ import annotations

import asyncio
from itertools import islice
from typing import TYPE_CHECKING, Final

import zenoh

if TYPE_CHECKING:
    from collections.abc import Iterable

TIMEOUT: Final = 3.0
"""Seconds to wait for replies."""
MAX_REPLIES: Final = 256
"""Replies read per query."""


async def query_all(
    session: zenoh.Session, keys: Iterable[str], *, payload: bytes | None = None, timeout: float = TIMEOUT
) -> list[zenoh.Reply]:
    """All replies, errors included, to queries on these keys, sent at once. Empty if nobody replies within `timeout`
    seconds. Cancelling ends the queries."""
    token = zenoh.CancellationToken()
    try:
        return await asyncio.to_thread(_query_all, session, list(keys), payload, timeout, token)
    finally:
        token.cancel()  # type: ignore[no-untyped-call]


def _query_all(
    session: zenoh.Session, keys: list[str], payload: bytes | None, timeout: float, token: zenoh.CancellationToken
) -> list[zenoh.Reply]:
    queries = [
        session.get(
            key,
            zenoh.handlers.FifoChannel(MAX_REPLIES),
            payload=payload,
            encoding=None if payload is None else "application/json",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
            cancellation_token=token,
        )
        for key in keys
    ]
    return [reply for replies in queries for reply in islice(replies, MAX_REPLIES)]
