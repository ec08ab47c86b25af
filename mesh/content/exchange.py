"""Files by CID over Zenoh: what this agent holds is there for others, and what others hold can be fetched."""

from __future__ import annotations

import asyncio
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self
from weakref import WeakValueDictionary

from mesh.content.asking import Asker
from mesh.content.download import Download
from mesh.content.serving import BlockServer
from mesh.errors import ClosedError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from types import TracebackType

    import zenoh

    from mesh.content.holdings import Progress
    from mesh.content.store import Store

DEFAULT_TIMEOUT: Final = 30.0
"""Seconds without a new block after which a fetch gives up."""


@dataclass(frozen=True, kw_only=True)
class ExchangeStatistics:
    """What an exchange has done so far."""

    served: int
    """Blocks given to who asked."""
    missed: int
    """Queries for blocks that were not held."""
    ignored: int
    """Queries for somebody else, or with a wildcard."""
    fetched_blocks: int
    fetched_bytes: int
    corrupt_blocks: Mapping[str, int]
    """Answers that were not what was asked for, by the holder's Zenoh id (which a liar may have made up)."""


class Exchange:
    """The door between a store and the network: `async with Exchange(session, store) as exchange`.

    Inside, blocks of the store are given to whoever asks on `aira/cid/{cid}`. `width` blocks of a fetch are on their
    way at once. Session and store stay the caller's to close, after the exchange.
    """

    def __init__(self, session: zenoh.Session, store: Store, *, width: int = 8) -> None:
        self._session = session
        self._store = store
        self._width = width
        self._server: BlockServer | None = None
        self._running: dict[Download, asyncio.Future[Path]] = {}
        self._turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._blocks = 0
        self._bytes = 0
        self._lies: Counter[str] = Counter()

    async def __aenter__(self) -> Self:
        if self._server is not None:
            raise ClosedError("this exchange was opened before")
        self._server = BlockServer(self._session, self._store)
        await asyncio.to_thread(self._server.start)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        running = dict(self._running)
        for download in running:
            download.stop()
        if running:
            await asyncio.wait(running.values())
        if self._server is not None:
            await asyncio.to_thread(self._server.stop)

    async def fetch(
        self,
        cid: str,
        *,
        size_limit: int | None = None,
        timeout: float = DEFAULT_TIMEOUT,
        progress: Progress | None = None,
    ) -> Path:
        """Where the file of that CID is in the store, once it is there whole and every block of it was checked.

        A file already held is hashed once per process. `timeout` is in seconds without a new block: a holder may
        come late, a large file may take long. `size_limit` is in bytes. Cancelling keeps the blocks that came; the
        next fetch goes on from them, in this process or another. `progress` is told, in the event loop, the bytes of
        the file that are there and its size. A file that must stay is pinned before it is fetched.

        Raises `InvalidCid`, `ContentUnavailable`, `ContentTooLarge`, `ContentCorrupt` (with the holders, if all that
        answered lied), `QuotaReached`, `StoreFull`.
        """
        turn = self._turns.setdefault(cid, asyncio.Lock())
        async with turn:
            held = await asyncio.to_thread(self._store.checked, cid)
            return held or await self._fetch(cid, size_limit, timeout, progress)

    def statistics(self) -> ExchangeStatistics:
        """A snapshot of the counters. Blocks of fetches that are under way count when they end."""
        server = self._server
        return ExchangeStatistics(
            served=server.served if server else 0,
            missed=server.missed if server else 0,
            ignored=server.ignored if server else 0,
            fetched_blocks=self._blocks,
            fetched_bytes=self._bytes,
            corrupt_blocks=dict(self._lies),
        )

    async def _fetch(self, cid: str, size_limit: int | None, timeout: float, progress: Progress | None) -> Path:
        loop, asker = asyncio.get_running_loop(), Asker(self._session)
        tell = None if progress is None else _in_loop(loop, progress)
        download = Download(self._store, asker, cid, patience=timeout, size_limit=size_limit, progress=tell)
        with ThreadPoolExecutor(self._width + 1, thread_name_prefix=f"aira-fetch-{cid[-6:]}") as pool:
            running = loop.run_in_executor(pool, download.run, pool, self._width)
            self._running[download] = running
            try:
                return await asyncio.shield(running)
            except asyncio.CancelledError:
                download.stop()
                await asyncio.wait([running])
                if not running.cancelled():
                    running.exception()  # taken note of: that it was stopped is no news
                raise
            finally:
                del self._running[download]
                self._blocks += download.blocks
                self._bytes += download.bytes
                self._lies.update(asker.lies)


def _in_loop(loop: asyncio.AbstractEventLoop, progress: Progress) -> Progress:
    def tell(done: int, total: int | None) -> None:
        loop.call_soon_threadsafe(progress, done, total)

    return tell
