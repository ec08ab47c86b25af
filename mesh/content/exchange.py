"""Files by CID over Zenoh: serve the blocks of a store to others, and fetch files that others hold."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self
from weakref import WeakValueDictionary

import zenoh

from mesh.content.download import Download, DownloadTiming
from mesh.content.requester import BlockRequester, Liars
from mesh.errors import AiraError, ClosedError
from mesh.flood import Drops
from mesh.log_context import log_event
from schemas.agent_keys import CidKey
from schemas.selectors import cid_selector, requested_cid

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from mesh.content.files import Progress
    from mesh.content.store import Store

log = logging.getLogger(__name__)

DEFAULT_TIMEOUT: Final = 30.0
"""Seconds without a new block after which a fetch fails."""

_QUEUED: Final = 256
"""Queries that may wait. Beyond it the oldest is dropped: its sender gets an empty reply at once, and asks again."""
_TIMING: Final = DownloadTiming()


@dataclass(frozen=True, kw_only=True)
class ExchangeStatistics:
    """What an exchange has done so far."""

    served: int
    """Blocks sent to others."""
    missed: int
    """Queries for blocks that are not held."""
    ignored: int
    """Queries for no single block."""
    fetched_blocks: int
    fetched_bytes: int
    corrupt_blocks: Mapping[str, int]
    """Replies that did not have the hash asked for, by their sender: `ADDRESS@SESSION`, see `Replier`."""


class Exchange:
    """Connects a store to the network: `async with Exchange(session, store) as exchange`.

    Inside, it serves blocks of the store on `aira/agent/{address}/cid/{cid}`, and `fetch` gets files from others,
    `width` blocks at a time. `address` is that of the account, by default one made from the session's id. Replies that
    are lies are counted in `drops`. Session and store remain the caller's, who closes them after the exchange.
    """

    def __init__(
        self,
        session: zenoh.Session,
        store: Store,
        *,
        address: str = "",
        width: int = 8,
        timing: DownloadTiming = _TIMING,
        drops: Drops | None = None,
    ) -> None:
        self._session = session
        self._store = store
        self._width = width
        self._timing = timing
        self._address = address or session_address(session)
        self._liars = Liars(drops or Drops())
        self._server: BlockServer | None = None
        self._running: dict[Download, asyncio.Future[Path]] = {}
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._blocks = 0
        self._bytes = 0
        self._corrupt: Counter[str] = Counter()

    async def __aenter__(self) -> Self:
        if self._server is not None:
            raise ClosedError("this exchange was opened before")
        self._server = BlockServer(self._session, self._store, self._address)
        await asyncio.to_thread(self._server.start)
        return self

    async def __aexit__(self, *exc_info: object) -> None:
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
        sync: bool = True,
    ) -> Path:
        """Where the file is in the store, once it is complete and every block of it was checked.

        A file that is already held is hashed once per process. `timeout` is in seconds without a new block: a holder
        may appear late, and a large file may take long. `size_limit` is in bytes. Cancelling keeps the blocks that
        arrived; the next fetch continues with them, in this process or another. `progress` is called in the event loop
        with the bytes of the file that have arrived and its size. Pin a file before fetching it if it must stay.
        Without `sync`, a power loss soon afterwards may damage the file, and it is fetched again.

        Raises `InvalidCid`, `ContentUnavailable`, `ContentTooLarge`, `ContentCorrupt` (with the holders, if all
        replies were wrong), `QuotaReached`, `StoreFull`.
        """
        lock = self._locks.setdefault(cid, asyncio.Lock())
        async with lock:
            held = await asyncio.to_thread(self._store.checked, cid)
            return held or await self._download(cid, size_limit, timeout, progress, sync=sync)

    async def is_held(self, cid: str, *, timeout: float) -> bool:
        """Whether somebody on the mesh replies with the first block of a file within `timeout` seconds."""
        requester = BlockRequester(self._session, self._liars)
        asking = asyncio.to_thread(requester.request_from_all, cid, timeout=timeout, hear_liars=True)
        try:
            return await asking is not None
        finally:
            requester.cancel()

    def statistics(self) -> ExchangeStatistics:
        """A snapshot of the counters. The blocks of a fetch are counted when it ends."""
        server = self._server
        return ExchangeStatistics(
            served=server.served if server else 0,
            missed=server.missed if server else 0,
            ignored=server.ignored if server else 0,
            fetched_blocks=self._blocks,
            fetched_bytes=self._bytes,
            corrupt_blocks=dict(self._corrupt),
        )

    async def _download(
        self, cid: str, size_limit: int | None, timeout: float, progress: Progress | None, *, sync: bool
    ) -> Path:
        loop, requester = asyncio.get_running_loop(), BlockRequester(self._session, self._liars)
        download = Download(
            self._store,
            requester,
            cid,
            patience=timeout,
            timing=self._timing,
            size_limit=size_limit,
            progress=None if progress is None else _in_loop(loop, progress),
            sync=sync,
        )
        with ThreadPoolExecutor(self._width + 1, thread_name_prefix=f"aira-fetch-{cid[-6:]}") as pool:
            running = loop.run_in_executor(pool, download.run, pool, self._width)
            self._running[download] = running
            try:
                return await asyncio.shield(running)
            except asyncio.CancelledError:
                download.stop()
                await asyncio.wait([running])
                if not running.cancelled():
                    running.exception()  # retrieve it: asyncio would report it as unhandled
                raise
            finally:
                del self._running[download]
                self._blocks += download.blocks
                self._bytes += download.bytes
                self._corrupt.update(requester.corrupt_blocks)


class BlockServer:
    """Answers queries for blocks, on the keys of `address`, with the bytes, or with nothing if one is not held.

    `start` and `stop` may block for a moment; neither closes the session. A thread of its own reads the disk.
    """

    def __init__(self, session: zenoh.Session, store: Store, address: str) -> None:
        self._session = session
        self._store = store
        self._address = address
        self._queryable: zenoh.Queryable[zenoh.Handler[zenoh.Query]] | None = None
        self._thread = threading.Thread(target=self._serve, name="aira-blocks", daemon=True)
        self.served = 0
        self.missed = 0
        self.ignored = 0

    def start(self) -> None:
        """Declare the queryable and begin to answer."""
        self._queryable = self._session.declare_queryable(
            cid_selector(self._address), zenoh.handlers.RingChannel(_QUEUED)
        )
        self._thread.start()

    def stop(self) -> None:
        """Undeclare the queryable and wait for the answer under way."""
        if self._queryable is not None and not self._session.is_closed():
            self._queryable.undeclare()  # type: ignore[no-untyped-call]
        self._thread.join()

    def _serve(self) -> None:
        assert self._queryable is not None
        for query in self._queryable:
            with query:
                try:
                    self._answer(query)
                except (OSError, AiraError, zenoh.ZError) as error:
                    event = log_event("content-serve-failed", key=query.key_expr, error=error)
                    log.exception("a query for a block could not be answered", extra=event)

    def _answer(self, query: zenoh.Query) -> None:
        cid = requested_cid(str(query.key_expr))
        if cid is None:
            self.ignored += 1
            return
        block = self._store.get_block(cid)
        if block is None:
            self.missed += 1
            return
        query.reply(str(CidKey(self._address, cid)), block, encoding=zenoh.Encoding.APPLICATION_OCTET_STREAM)
        self.served += 1


def session_address(session: zenoh.Session) -> str:
    """An address for a session without an account: its Zenoh id, filled up with zeros."""
    return f"0x{session.zid()!s:0>40}"


def _in_loop(loop: asyncio.AbstractEventLoop, progress: Progress) -> Progress:
    def call(done: int, total: int | None) -> None:
        loop.call_soon_threadsafe(progress, done, total)

    return call
