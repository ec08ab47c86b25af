"""Answers: the readings in results that belong to no liability."""

from __future__ import annotations

import asyncio
import logging
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from mesh.background import Background
from mesh.content import Exchange, Store
from mesh.errors import AiraError
from mesh.log_context import log_event
from mesh.network import Reading
from mesh.network.readings import LARGEST_READING
from mesh.recording import Limits, open_objective
from mesh.role import Lifecycle
from mesh.watching.market import JobEvent, RecentSet
from schemas import Result, Verified
from schemas.payloads import decode_value

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AsyncExitStack

    import zenoh

    from mesh.watching.market import MarketEvent

log = logging.getLogger(__name__)

LARGEST: Final = LARGEST_READING + 64 * 1024
"""Bytes of a result that is fetched: a reading and what a file adds. Larger recordings are not fetched unasked."""
LIMITS: Final = Limits(size=LARGEST, expanded=LARGEST, messages=100)
KEPT: Final = 16 * 1024 * 1024
"""Bytes of results kept in the temporary store; beyond, the oldest are evicted."""
MAX_FETCHES: Final = 4
"""Results fetched at the same time."""
MAX_PENDING: Final = 64
"""Results being fetched or waiting; more are skipped."""
TIMEOUT: Final = 10.0
"""Seconds without a block after which fetching a result fails."""


class ReadingFetcher(Lifecycle):
    """Fetches the results without a liability among the events given to `handle`, and passes each reading to `deliver`.

    Use with `async with`; files are in a temporary folder meanwhile. Agents' job events show which results have a
    liability. Results that can't be fetched or read are logged.
    """

    title = "fetcher of readings"

    def __init__(self, session: zenoh.Session, deliver: Callable[[Reading], None], *, timeout: float = TIMEOUT) -> None:
        self._session = session
        self._deliver = deliver
        self._timeout = timeout
        self._contracts = RecentSet()
        self._turns = asyncio.Semaphore(MAX_FETCHES)
        self._pending = 0

    async def _open(self, stack: AsyncExitStack) -> None:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="aira-readings-"))
        store = await asyncio.to_thread(Store, Path(folder), limit=LARGEST, quota=KEPT)
        stack.callback(store.close)
        self._exchange = await stack.enter_async_context(Exchange(self._session, store))
        self._tasks = await stack.enter_async_context(Background())

    @property
    def pending(self) -> int:
        """Results being fetched or waiting."""
        return self._pending

    def handle(self, event: MarketEvent) -> None:
        """Take an event of the market."""
        if isinstance(event, JobEvent):
            self._contracts.add(event.liability.address)
        elif isinstance(event, Verified) and isinstance(event.message, Result):
            result = event.message
            if result.liability in self._contracts:
                return
            if self._pending == MAX_PENDING:
                fields = log_event("result-skipped", result=result.result, signer=event.signer)
                log.warning("skipped the result %s of %s: too many at once", result.result, event.signer, extra=fields)
                return
            self._pending += 1
            self._tasks.start(self._fetch(result.result, event.signer), f"reading {result.result}")

    async def _fetch(self, cid: str, signer: str) -> None:
        try:
            async with self._turns:
                path = await self._exchange.fetch(cid, size_limit=LARGEST, timeout=self._timeout)
                readings = await asyncio.to_thread(_read, path, cid, signer)
        except AiraError as error:
            fields = log_event("result-unreadable", result=cid, signer=signer, code=error.code)
            log.warning("can't read the result %s of %s: %s", cid, signer, error, extra=fields)
        else:
            for reading in readings:
                self._deliver(reading)
        finally:
            self._pending -= 1


def _read(path: Path, cid: str, signer: str) -> list[Reading]:
    return [
        Reading(signer, one.topic, decode_value(one.payload, one.type), one.payload, one.type, cid)
        for one in open_objective(path, LIMITS).messages()
    ]
