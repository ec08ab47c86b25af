"""The content bridge: serves IPFS content to the mesh, and adds the mesh's files to IPFS."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter, OrderedDict
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh

from bridges.ipfs.errors import IpfsError
from bridges.ipfs.transfer_queue import USUAL, TransferQueue
from bridges.ipfs.transfers import add_file
from mesh.background import call_in_loop
from mesh.content import ContentUnavailable, session_address
from mesh.errors import ClosedError
from mesh.flood import Drops
from mesh.log_context import log_event
from mesh.retry import RetryPolicy
from schemas import CidKey, InputError, cid_selector, parse_block, requested_cid
from schemas.status import ContentMetrics

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from bridges.ipfs.daemon import Daemon
    from bridges.ipfs.transfers import ContentSources
    from mesh.content import Exchange, Store

log = logging.getLogger(__name__)

BLOCK_TIMEOUT: Final = 10.0
"""Seconds that a source has for a block."""
CONCURRENT_ANSWERS: Final = 32
"""Block queries of the mesh that are answered from IPFS at once; others get no reply and are sent again."""
PROBE_TIMEOUT: Final = 2.0
"""Seconds in which the first block of a file named in a message must be found, before the file is transferred."""
ADD_RETRY: Final = RetryPolicy(initial=10.0, factor=1.0, ceiling=10.0, attempts=4)
"""For files that a message names before the mesh has them."""
FETCH_RETRY: Final = RetryPolicy(initial=10.0, factor=1.0, ceiling=10.0, attempts=2)
"""For files that IPFS does not find at once."""
UNAVAILABLE_FOR: Final = 10.0
"""Seconds for which a block that IPFS did not have is not requested again."""
REMEMBERED_BLOCKS: Final = 65_536
"""Blocks known to be parts of files, or to be unavailable."""


class ContentBridge:
    """Transfers files between the mesh and IPFS: `async with ContentBridge(...) as content`.

    Inside, queries of the mesh for blocks that `store` lacks are answered from `sources`, and the file that such a
    block begins is fetched and stored. Files are added to `daemon`; `providers` are further nodes that pin them.
    `size_limit` is in bytes of a file, `timeout` in seconds for a file; `add_retry` applies to `schedule_add`,
    `fetch_retry` to `schedule_fetch`. What is not transferred because a signer names too many files is counted in
    `drops`. The caller closes what is passed in.
    """

    def __init__(
        self,
        session: zenoh.Session,
        store: Store,
        exchange: Exchange,
        sources: ContentSources,
        daemon: Daemon,
        *,
        providers: tuple[Daemon, ...] = (),
        address: str = "",
        size_limit: int,
        timeout: float,
        add_retry: RetryPolicy = ADD_RETRY,
        fetch_retry: RetryPolicy = FETCH_RETRY,
        drops: Drops | None = None,
    ) -> None:
        self._session = session
        self._address = address or session_address(session)
        self._store = store
        self._exchange = exchange
        self._sources = sources
        self._daemon = daemon
        self._providers = providers
        self._size_limit = size_limit
        self._timeout = timeout
        drops = drops or Drops()
        self._adds = TransferQueue(self._add_if_held, kind="add", retry=add_retry, drops=drops)
        self._prefetches = TransferQueue(self._fetch_if_found, kind="fetch", retry=fetch_retry, drops=drops)
        self._parts: OrderedDict[str, None] = OrderedDict()
        self._unavailable: OrderedDict[str, float] = OrderedDict()
        self._tasks: set[asyncio.Task[None]] = set()
        self._fetches: dict[str, asyncio.Task[Path]] = {}
        self._answering = 0
        self._adding: Counter[str] = Counter()
        self._open = False
        self._counts = Counter[str]()

    async def __aenter__(self) -> Self:
        if self._open:
            raise ClosedError("this content bridge is already open")
        self._open = True
        await self._adds.__aenter__()
        await self._prefetches.__aenter__()
        loop = asyncio.get_running_loop()
        self._queryable: Any = self._session.declare_queryable(
            cid_selector(self._address), lambda query: call_in_loop(loop, self._accept, query)
        )
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._open = False
        if not self._session.is_closed():
            self._queryable.undeclare()
        await self._adds.__aexit__()
        await self._prefetches.__aexit__()
        tasks = [*self._tasks, *self._fetches.values()]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    async def fetch(self, cid: str) -> Path:
        """The file's path in the store, fetched from IPFS if necessary. Concurrent calls fetch it once.

        Raises what `ContentSources.fetch` raises.
        """
        fetching = self._fetches.get(cid)
        if fetching is None:
            fetching = asyncio.create_task(self._fetch(cid), name=f"fetch {cid} from IPFS")
            self._fetches[cid] = fetching
            fetching.add_done_callback(lambda _: self._fetches.pop(cid, None))
        return await asyncio.shield(fetching)

    async def add(self, cid: str) -> None:
        """Add a file of the mesh to IPFS under the same CID, and pin it on the providers.

        Raises a `ContentError` when the mesh does not have it, `IpfsError` when the daemon does not accept it.
        """
        with self._not_answering(cid):
            path = await self._exchange.fetch(cid, size_limit=self._size_limit, timeout=self._timeout)
        try:
            size = (await asyncio.to_thread(path.stat)).st_size
            as_file = await add_file(self._daemon, self._store, path, cid, timeout=self._timeout)
        except OSError as error:  # the store evicted it meanwhile
            raise ContentUnavailable(cid, f"it can't be read: {error.strerror}") from error
        self._counts.update(added=1, added_bytes=size, by_blocks=0 if as_file else 1)
        for provider in self._providers:
            try:
                await provider.pin(cid, timeout=self._timeout)
                self._counts["pinned"] += 1
            except IpfsError as error:
                failed = log_event("pin-failed", cid=cid, provider=provider.api, code=error.code)
                log.warning("%s is not pinned: %s", cid, error, extra=failed)

    def schedule_fetch(self, cid: str, signer: str = "", *, priority: int = USUAL) -> None:
        """Like `fetch`, in the background, for a message of `signer`; a failure is logged and counted."""
        self._prefetches.add(cid, signer, priority=priority)

    def schedule_add(self, cid: str, signer: str = "", *, priority: int = USUAL) -> None:
        """Like `add`, in the background, for a message of `signer`; a failure is logged and counted."""
        self._adds.add(cid, signer, priority=priority)

    def metrics(self) -> ContentMetrics:
        """The counts so far."""
        counts = self._counts
        return ContentMetrics(
            fetched=counts["fetched"],
            fetched_bytes=self._sources.bytes,
            lies=self._sources.corrupt.total(),
            answered=counts["answered"],
            added=counts["added"],
            added_bytes=counts["added_bytes"],
            by_blocks=counts["by_blocks"],
            pinned=counts["pinned"],
            failed=self._adds.failed + self._prefetches.failed,
            joined=self._adds.joined + self._prefetches.joined,
            adds_queued=self._adds.queued,
            fetches_queued=self._prefetches.queued,
        )

    async def _fetch(self, cid: str) -> Path:
        if (held := await asyncio.to_thread(self._store.checked, cid)) is not None:
            return held
        path = await self._sources.fetch(
            self._store,
            cid,
            size_limit=self._size_limit,
            timeout=self._timeout,
            block_timeout=BLOCK_TIMEOUT,
            found=self._remember_parts,
        )
        self._counts["fetched"] += 1
        return path

    async def _fetch_if_found(self, cid: str) -> None:
        if not await asyncio.to_thread(self._store.has, cid):
            await self._sources.block(cid, timeout=min(PROBE_TIMEOUT, self._timeout))
        await self.fetch(cid)

    async def _add_if_held(self, cid: str) -> None:
        if not await asyncio.to_thread(self._store.has, cid):
            with self._not_answering(cid):
                is_held = await self._exchange.is_held(cid, timeout=min(PROBE_TIMEOUT, self._timeout))
            if not is_held:
                raise ContentUnavailable(cid, "nobody on the mesh has it")
        await self.add(cid)

    @contextmanager
    def _not_answering(self, cid: str) -> Iterator[None]:
        """Don't answer this bridge's own queries for a file that it is going to add."""
        self._adding[cid] += 1
        try:
            yield
        finally:
            self._adding[cid] -= 1
            if not self._adding[cid]:
                del self._adding[cid]

    def _accept(self, query: zenoh.Query) -> None:
        """Answer a query for a block, unless there are too many."""
        cid = requested_cid(str(query.key_expr))
        busy = self._answering >= CONCURRENT_ANSWERS
        if not self._open or cid is None or busy or cid in self._adding or self._is_unavailable(cid):
            query.drop()  # type: ignore[no-untyped-call]
            return
        self._answering += 1
        task = asyncio.create_task(self._answer(query, cid), name=f"answer {cid}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, query: zenoh.Query, cid: str) -> None:
        try:
            with query:
                if await asyncio.to_thread(self._store.get_block, cid) is not None:
                    return  # the exchange replies
                try:
                    block = await self._sources.block(cid, timeout=BLOCK_TIMEOUT)
                except ContentUnavailable as error:
                    log.debug("%s", error)
                    _remember(self._unavailable, cid, asyncio.get_running_loop().time())
                    return
                query.reply(str(CidKey(self._address, cid)), block, encoding=zenoh.Encoding.APPLICATION_OCTET_STREAM)
                self._counts["answered"] += 1
            self._fetch_file_of(cid, block)
        finally:
            self._answering -= 1

    def _fetch_file_of(self, cid: str, block: bytes) -> None:
        """Fetch the whole file if the block is its root."""
        try:
            links = parse_block(block).links
        except InputError:
            return
        self._remember_parts(link.cid for link in links)
        if cid not in self._parts:
            self.schedule_fetch(cid)

    def _remember_parts(self, cids: Iterable[str]) -> None:
        """These are blocks of files that are fetched as a whole: no files to fetch of their own."""
        for cid in cids:
            _remember(self._parts, cid, None)

    def _is_unavailable(self, cid: str) -> bool:
        asked = self._unavailable.get(cid)
        return asked is not None and asyncio.get_running_loop().time() - asked < UNAVAILABLE_FOR


def _remember(known: OrderedDict[str, Any], cid: str, value: Any) -> None:
    known.pop(cid, None)
    known[cid] = value
    if len(known) > REMEMBERED_BLOCKS:
        known.popitem(last=False)
