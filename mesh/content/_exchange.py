"""Files by CID over Zenoh: serve the blocks of a store to others, and fetch files that others hold.

A file is fetched block by block, several at once, from all who hold it, among others that lie. A block proves itself by
its hash, so a lie costs only time: that of receiving it, of hashing it, and of a request that it answers. So the
replies of a session that lied lately are not hashed, and no reply ends a query but the right one. A holder whose reply
was right is asked for the next blocks on its own key, where on a site nobody else may answer.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import Counter, OrderedDict
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, Self
from weakref import WeakValueDictionary

import zenoh

from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.flood import Drops
from mesh.base.log_context import log_event
from mesh.base.retry import Backoff, RetryPolicy
from mesh.content._blocks import ContentCorrupt, is_block
from mesh.content.store import ContentUnavailable
from mesh.errors import AiraError, ClosedError, ContentError, InvalidKey
from schemas.keys import CidKey, cid_selector, parse_key, requested_cid
from schemas.unixfs import MAX_BLOCK_SIZE

if TYPE_CHECKING:
    from collections.abc import Mapping
    from concurrent.futures import Executor, Future
    from pathlib import Path

    from mesh.base.clock import Clock
    from mesh.content._blocks import BlockRef
    from mesh.content.files import Progress
    from mesh.content.store import Assembly, Store


_RETRY: Final = RetryPolicy(initial=0.05, factor=1.5, ceiling=1.0)
"""Shorter delays than for a server: another holder may appear at any moment."""


@dataclass(frozen=True, kw_only=True)
class DownloadTiming:
    """How long a download waits for one block; seconds.

    It asks one known holder for up to `holder_timeout`, else all of them: for `query_timeout` at first, twice as long
    after each failure, and never less than `shortest_query`. A query to all must end early enough that holders which
    appeared meanwhile are asked too. Between two attempts it waits by the policy `retry`.
    """

    retry: RetryPolicy = _RETRY
    holder_timeout: float = 10.0
    query_timeout: float = 2.0
    shortest_query: float = 0.5


class Download:
    """One download of one file. `stop` may be called from any thread; blocks that arrived stay on the disk.

    It fails after `patience` seconds without a new block.
    """

    def __init__(
        self,
        store: Store,
        requester: BlockRequester,
        cid: str,
        *,
        patience: float,
        timing: DownloadTiming,
        size_limit: int | None = None,
        progress: Progress | None = None,
        sync: bool = True,
    ) -> None:
        self._store = store
        self._requester = requester
        self._cid = cid
        self._size_limit = size_limit
        self._patience = patience
        self._timing = timing
        self._progress = progress
        self._sync = sync
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self._last_block = time.monotonic()
        self.blocks = 0
        self.bytes = 0

    def stop(self) -> None:
        """Make `run` end soon, with `ClosedError`."""
        self._stopped.set()
        self._requester.cancel()

    def run(self, pool: Executor, width: int) -> Path:
        """Download with at most `width` blocks under way in threads of `pool`. Returns where the file is in the store.

        Blocks until it is complete or fails. Raises what `Exchange.fetch` does, and `ClosedError` after `stop`.
        """
        with self._store.assemble(self._cid, size_limit=self._size_limit) as assembly:
            waiting = [assembly.root]
            running: set[Future[list[BlockRef]]] = set()
            try:
                while waiting or running:
                    while waiting and len(running) < width:
                        running.add(pool.submit(self._add_block, assembly, waiting.pop()))
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    for added in done:
                        # A stack: parts come in the order of the file, and few wait at a time.
                        waiting.extend(reversed(added.result()))
            except BaseException:
                self.stop()
                wait(running)
                raise
            return assembly.finish(sync=self._sync)

    def _add_block(self, assembly: Assembly, ref: BlockRef) -> list[BlockRef]:
        block = assembly.local(ref)
        if block is None:
            block = self._request(ref)
        refs = assembly.put_checked(ref, block)
        if self._progress is not None:
            with self._lock:  # so that it never goes backwards
                self._progress(*assembly.progress())
        return refs

    def _request(self, ref: BlockRef) -> bytes:
        """The block from the network, requested until nothing at all has arrived for `patience` seconds.

        A known holder has half of what is left of them; if it fails, all are asked.
        """
        timing, requester = self._timing, self._requester
        backoff, query_timeout, hear_liars = Backoff(timing.retry), timing.query_timeout, False
        # Only an inner node covers this much. It is small, and asking all for it shows which of them have the file.
        from_all = ref.size is None or ref.size > MAX_BLOCK_SIZE
        while not self._stopped.is_set():
            timeout = max(self._last_block + self._patience - time.monotonic(), timing.shortest_query)
            block = None
            if not from_all:
                within = min(timeout / 2, timing.holder_timeout)
                block = requester.request(ref.cid, within=within, hear_liars=hear_liars)
            if block is None:
                timeout = min(timeout, query_timeout)
                block = requester.request_from_all(ref.cid, timeout=timeout, hear_liars=hear_liars)
            if block is not None:
                self._count(block)
                return block
            pause = backoff.next_delay()
            if pause is None or time.monotonic() > self._last_block + self._patience:
                raise self._failure(ref.cid)
            self._stopped.wait(pause)
            query_timeout, hear_liars = query_timeout * 2, not hear_liars
        raise ClosedError(f"the download of {self._cid} was stopped", hint="fetch it again: it continues")

    def _count(self, block: bytes) -> None:
        with self._lock:
            self._last_block = time.monotonic()
            self.blocks += 1
            self.bytes += len(block)

    def _failure(self, cid: str) -> ContentError:
        what = "its root" if cid == self._cid else f"its block {cid}"
        senders = self._requester.corrupt_blocks
        if senders:
            return ContentCorrupt(self._cid, f"all replies for {what} were wrong", holders=senders)
        return ContentUnavailable(self._cid, f"no holder sent {what} within {self._patience:g} s")


log = logging.getLogger(__name__)


class LiarLimits(NamedTuple):
    """How long sessions are remembered for their lies, and how many."""

    seconds: float = 60.0
    """In which the replies of one are ignored."""
    sessions: int = 1024
    """The latest ones."""


LIAR_LIMITS: Final = LiarLimits()
LIE: Final = "content-lie"
"""The reason under which lies, and replies that were ignored after one, are counted as drops."""


class Replier(NamedTuple):
    """Who sent a reply: the agent in its key, empty if it names none, and the Zenoh id of its session.

    On a site the routers let only that agent reply on the key. Elsewhere it is a claim. A session's id is a claim
    everywhere, but one that only a changed Zenoh can make for another session.
    """

    agent: str
    session: str

    def __str__(self) -> str:
        return f"{self.agent}@{self.session}"


class Liars:
    """The sessions that sent wrong blocks lately, within `LIAR_LIMITS`. Thread-safe."""

    def __init__(self, drops: Drops, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self.drops: Final = drops
        self._clock = clock
        self._lock = threading.Lock()
        self._until: OrderedDict[str, float] = OrderedDict()

    def add(self, replier: Replier) -> bool:
        """Remember a lie; whether it is the first one of its session in that time."""
        self.drops.count(LIE, str(replier))
        with self._lock:
            is_known = self._until.pop(replier.session, 0.0) > self._clock.monotonic()
            self._until[replier.session] = self._clock.monotonic() + LIAR_LIMITS.seconds
            if len(self._until) > LIAR_LIMITS.sessions:
                self._until.popitem(last=False)
        return not is_known

    def __contains__(self, replier: Replier) -> bool:
        with self._lock:
            return self._until.get(replier.session, 0.0) > self._clock.monotonic()


class BlockRequester:
    """Requests blocks for one file from the sessions that hold it, and checks each by its hash. For any thread.

    Holders that replied correctly are asked for the next blocks, each block from one of them: the one with the fewest
    requests under way, so that all are busy and fast ones send more. If one fails, all are asked.

    `hear_liars` is for the attempt after one that failed: it also hashes replies of sessions that lied, because a liar
    may have replied in the name of an honest session.
    """

    def __init__(self, session: zenoh.Session, liars: Liars) -> None:
        self._session = session
        self._liars = liars
        self._lock = threading.Lock()
        self._token = zenoh.CancellationToken()
        self._pending: dict[str, int] = {}
        """Requests under way to each known holder (address)."""
        self._corrupt: Counter[str] = Counter()

    @property
    def corrupt_blocks(self) -> Mapping[str, int]:
        """How many replies of each replier did not have the hash asked for."""
        with self._lock:
            return dict(self._corrupt)

    def cancel(self) -> None:
        """End every query under way; later ones end at once."""
        self._token.cancel()  # type: ignore[no-untyped-call]

    def request(self, cid: str, *, within: float, hear_liars: bool) -> bytes | None:
        """The block from a known holder; None if none is known, or it does not send it `within` so many seconds."""
        with self._lock:
            if not self._pending:
                return None
            holder = min(self._pending, key=self._pending.__getitem__)
            self._pending[holder] += 1
        try:
            block = self._query(str(CidKey(holder, cid)), cid, within, hear_liars=hear_liars)
        finally:
            with self._lock:
                if holder in self._pending:
                    self._pending[holder] -= 1
        if block is None:
            with self._lock:
                self._pending.pop(holder, None)
        return block

    def request_from_all(self, cid: str, *, timeout: float, hear_liars: bool) -> bytes | None:
        """The block from the first holder that replies within `timeout`, or None.

        All that reply correctly in that time are known holders from then on.
        """
        return self._query(cid_selector(cid=cid), cid, timeout, hear_liars=hear_liars)

    def check(self, cid: str, reply: zenoh.Reply, *, found: bytes | None, hear_liars: bool) -> bytes | None:
        """The block of a reply, if it is right: its sender becomes a known holder. `found` is the block, if known."""
        if reply.ok is None:
            return None
        replier = _replier_of(reply)
        is_liar = replier in self._liars
        if is_liar and not hear_liars:
            self._liars.drops.count(LIE, str(replier))
            return None
        payload = reply.ok.payload
        block = payload.to_bytes() if len(payload) <= MAX_BLOCK_SIZE else b""
        if block == found or is_block(cid, block):
            if replier.agent and not is_liar:
                with self._lock:
                    self._pending.setdefault(replier.agent, 0)
            return block
        with self._lock:
            self._corrupt[str(replier)] += 1
        if self._liars.add(replier):
            event = log_event(
                "content-block-corrupt", holder=replier.agent, session=replier.session, cid=cid, bytes=len(payload)
            )
            log.warning("%s sent %d bytes for %s that have another hash", replier, len(payload), cid, extra=event)
        return None

    def _query(self, selector: str, cid: str, timeout: float, *, hear_liars: bool) -> bytes | None:
        """The first correct reply. Later ones only make their senders known."""
        blocks: list[bytes] = []
        decided = threading.Event()

        def hear(reply: zenoh.Reply) -> None:
            """Check a reply, in a thread of Zenoh's."""
            block = self.check(cid, reply, found=blocks[0] if blocks else None, hear_liars=hear_liars)
            if block is not None and not blocks:
                blocks.append(block)
                decided.set()

        try:
            # Content has a lower priority than the market's messages; BLOCK holds up this thread and nothing else.
            self._session.get(
                selector,
                zenoh.handlers.Callback(hear, decided.set),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
                cancellation_token=self._token,
            )
        except zenoh.ZError as error:
            raise ClosedError(f"the network session can't request {cid}: {error}") from error
        decided.wait()
        return blocks[0] if blocks else None


def _replier_of(reply: zenoh.Reply) -> Replier:
    session = str(reply.replier_id.zid) if reply.replier_id else "unknown"
    assert reply.ok is not None
    try:
        key = parse_key(str(reply.ok.key_expr))
    except InvalidKey:
        return Replier("", session)
    return Replier(key.agent if isinstance(key, CidKey) else "", session)


DEFAULT_TIMEOUT: Final = 30.0
"""Seconds without a new block after which a fetch fails."""

_TIMING: Final = DownloadTiming()


@dataclass(frozen=True, kw_only=True)
class ExchangeStatistics:
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
        replies were wrong), `StoreFull`.
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
        """Declare the queryable and begin to answer.

        Of 256 queries that wait the oldest is dropped: its sender gets an empty reply at once, and asks again.
        """
        self._queryable = self._session.declare_queryable(cid_selector(self._address), zenoh.handlers.RingChannel(256))
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
