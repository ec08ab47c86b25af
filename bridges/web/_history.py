"""What has been: the statement of an account, and the contracts of the market that this server knows."""

from __future__ import annotations

import asyncio
import time
from bisect import bisect_right
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from bridges.web._access import WebError
from mesh.agent.statement import read_statement
from mesh.base.flood import BoundedDict, Rate, RateLimiter
from mesh.cli.statement import ENTRY_COLUMNS, csv_of, statement_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bridges.web._market import Market, SeenJob
    from bridges.web.components import WebComponents
    from mesh.agent.statement import Statement
    from mesh.cli.statement import Units

KEPT: Final = 10.0
"""Seconds for which a statement is used again."""
STATEMENTS: Final = Rate(per_second=0.5, burst=16)
"""Statements that one person may ask for, beside those that are used again."""
LONGEST: Final = 2_000
"""Contracts in a statement and in the history, the latest ones."""
HEADERS: Final = 32
"""Blocks whose times are read for the history."""


class PastContracts:
    """Answers questions about the past."""

    def __init__(self, components: WebComponents, market: Market) -> None:
        self._parts = components
        self._market = market
        self._reading = asyncio.Lock()
        self._limiter = RateLimiter(per_sender=STATEMENTS)
        self._statements: BoundedDict[str, tuple[Statement, Units, float]] = BoundedDict(64)  # accounts

    async def statement(self, account: str, *, sender: str) -> dict[str, Any]:
        """What `aira statement --json` says of an account.

        Raises `WebError` if `sender` asks too often, `ChainError`.
        """
        return statement_json(*await self._read(account, sender))

    async def statement_csv(self, account: str, *, sender: str) -> str:
        """What `aira statement --csv` says. Raises as `statement`."""
        found, units = await self._read(account, sender)
        return csv_of(ENTRY_COLUMNS, found.entries, units)

    async def _read(self, account: str, sender: str) -> tuple[Statement, Units]:
        if (known := self._known(account)) is not None:
            return known
        if not self._limiter.allow(sender):
            raise WebError("too many statements", hint="wait a moment", code="too-many-requests")
        async with self._reading:  # one after the other: each reads the chain from its first block
            if (known := self._known(account)) is None:
                found = await read_statement(self._parts.chain, account)
                found = replace(found, entries=found.entries[-LONGEST:])
                units = await self._parts.chain.tokens.units(one.token for one in found.entries)
                known = found, units
                self._statements[account] = *known, time.monotonic()
            return known

    def _known(self, account: str) -> tuple[Statement, Units] | None:
        """A statement that is young enough."""
        found, units, at = self._statements.get(account, (None, {}, 0.0))
        return None if found is None or time.monotonic() - at > KEPT else (found, units)

    async def jobs(self, model: str = "") -> dict[str, Any]:
        """The contracts that this server knows, or those of a model (CID), the newest first."""
        known = [(block, job) for job in self._market.jobs.values() if (block := _block_of(job)) is not None]
        known = [(block, job) for block, job in known if model in ("", job.liability.model)]
        known.sort(key=lambda one: one[0], reverse=True)
        listed = known[:LONGEST]
        times = await self._times([block for block, _ in reversed(listed)])
        return {"jobs": [self._json(job, block, times) for block, job in listed], "truncated": len(known) > LONGEST}

    def _json(self, job: SeenJob, block: int, times: Sequence[tuple[int, float]]) -> dict[str, Any]:
        one = job.liability
        return {
            "address": one.address,
            "model": one.model,
            "cost": str(one.cost),
            "token": self._market.labels.of(one.token),
            "state": one.state,
            "promisor": one.promisor,
            "promisee": one.promisee,
            "block": block,
            "at": time_between(times, block),
        }

    async def _times(self, blocks: Sequence[int]) -> list[tuple[int, float]]:
        """The times of a few blocks around these, which ascend.

        They stay the same while the chain grows, so that few are read again.
        """
        if not blocks:
            return []
        first, last = blocks[0], blocks[-1]
        step = 1
        while (last - first) // step > HEADERS - 3:
            step *= 2
        chosen = sorted({first, *range(first - first % step + step, last, step), last})
        times = await asyncio.gather(*map(self._market.time_of, chosen))
        return [(block, at) for block, at in zip(chosen, times, strict=True) if at is not None]


def _block_of(job: SeenJob) -> int | None:
    """The block of its creation."""
    return next((step["block"] for step in job.steps if step["kind"] == "created"), None)


def time_between(times: Sequence[tuple[int, float]], block: int) -> float | None:
    """The time (Unix) of a block by the times of others, which ascend: exact for these, else between its neighbours.

    That of the next one outside of them, and None without any.
    """
    if not times:
        return None
    place = bisect_right(times, (block, float("inf")))
    if place in (0, len(times)):
        return times[min(place, len(times) - 1)][1]
    (before, since), (after, until) = times[place - 1 : place + 1]
    return since + (until - since) * (block - before) / (after - before)
