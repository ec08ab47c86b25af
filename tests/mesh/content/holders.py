"""Holders of content that are not ours, and waiting until one is there."""

from __future__ import annotations

import asyncio
import random
from contextlib import contextmanager
from typing import TYPE_CHECKING

import zenoh

from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@contextmanager
def answering(session: zenoh.Session, answer: Callable[[zenoh.Query], None]) -> Iterator[None]:
    """Somebody on `aira/cid/*` who is not one of us."""

    def reply(query: zenoh.Query) -> None:
        with query:
            answer(query)

    queryable = session.declare_queryable("aira/cid/*", reply)
    yield
    queryable.undeclare()  # type: ignore[no-untyped-call]


async def reaching(session: zenoh.Session) -> None:
    """Return once somebody who answers for content is known to `session`."""
    querier = session.declare_querier("aira/cid/*")
    while not querier.matching_status:
        await asyncio.sleep(0.01)
    querier.undeclare()  # type: ignore[no-untyped-call]


async def given_by(session: zenoh.Session, cid: str, *, holders: int) -> None:
    """Return once that many holders answer `session` when it asks for a block."""

    def answers() -> int:
        replies = session.get(
            f"aira/cid/{cid}",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=10.0,
        )
        return sum(reply.ok is not None for reply in replies)

    async def enough() -> bool:
        return await asyncio.to_thread(answers) >= holders

    await until_found(enough, what=f"{holders} holders", seconds=30)


def some(size: int) -> bytes:
    """Bytes, always the same."""
    return random.Random(1).randbytes(size)
