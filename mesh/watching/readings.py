"""What Results without a contract hold: the readings that sensors give away."""

from __future__ import annotations

import asyncio
import logging
import tempfile
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import msgspec

from mesh.background import Background
from mesh.content import Exchange, Store
from mesh.errors import AiraError
from mesh.recording import Limits, open_objective
from mesh.watching.claims import JobEvent
from mesh.watching.market import Remembered
from schemas import Result, Verified
from schemas.payloads import decode_value

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    import zenoh

    from mesh.watching.market import Seen

log = logging.getLogger(__name__)

LARGEST: Final = 64 * 1024
"""Bytes of a result that is looked into: a reading is small, and nobody has asked us to fetch recordings."""
LIMITS: Final = Limits(size=LARGEST, expanded=LARGEST, messages=100)
KEPT: Final = 16 * 1024 * 1024
"""Bytes of results that are kept meanwhile; beyond, the oldest go."""
AT_ONCE: Final = 4
WAITING: Final = 64
"""Results that are being fetched or wait for it; more are left out."""
TIMEOUT: Final = 10.0
"""Seconds without a block after which a result is given up."""


class Reading(msgspec.Struct, frozen=True):
    """A message in a Result that belongs to no contract: who signed it, its CID, and what was said on a topic."""

    signer: str
    result: str
    topic: str
    value: Any
    """`Empty`, `String`, JSON data or bytes."""


class Readings:
    """Looks into the Results without a contract that `see` is shown, and gives each reading to `tell`.

    Used with `async with`; the files are in a temporary folder meanwhile. Which Results have a contract is what agents
    say. What can't be had or read is logged.
    """

    def __init__(self, session: zenoh.Session, tell: Callable[[Reading], None]) -> None:
        self._session = session
        self._tell = tell
        self._contracts = Remembered()
        self._turns = asyncio.Semaphore(AT_ONCE)
        self._waiting = 0
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="aira-readings-"))
            store = await asyncio.to_thread(Store, Path(folder), limit=LARGEST, quota=KEPT)
            stack.callback(store.close)
            self._exchange = await stack.enter_async_context(Exchange(self._session, store))
            self._tasks = await stack.enter_async_context(Background())
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        return await self._stack.__aexit__(kind, error, trace)

    def see(self, seen: Seen) -> None:
        """Something happened in the market."""
        if isinstance(seen, JobEvent):
            self._contracts.add(seen.liability.address)
        elif isinstance(seen, Verified) and isinstance(seen.message, Result):
            result = seen.message
            if result.liability in self._contracts:
                return
            if self._waiting == WAITING:
                log.warning("the result %s of %s is not shown: too many at once", result.result, seen.signer)
                return
            self._waiting += 1
            self._tasks.start(self._look_into(result.result, seen.signer), f"reading {result.result}")

    async def _look_into(self, cid: str, signer: str) -> None:
        try:
            async with self._turns:
                path = await self._exchange.fetch(cid, size_limit=LARGEST, timeout=TIMEOUT)
                readings = await asyncio.to_thread(_read, path, cid, signer)
        except AiraError as error:
            log.warning("the result %s of %s can't be shown: %s", cid, signer, error)
        else:
            for reading in readings:
                self._tell(reading)
        finally:
            self._waiting -= 1


def _read(path: Path, cid: str, signer: str) -> list[Reading]:
    return [
        Reading(signer, cid, message.topic, decode_value(message.payload, message.type))
        for message in open_objective(path, LIMITS).messages()
    ]
