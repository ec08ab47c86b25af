"""Content: serves files of IPFS to the mesh, and adds the mesh's files to IPFS.

Files are fetched from the daemon or a gateway block by block, and every block is verified by its hash. What messages
name waits in a queue for each direction, in which the messages' signers take turns.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple, Self

import aiohttp
import zenoh

from bridges.ipfs.daemon import IpfsError, base_url, read_answer, unreachable, without_credentials
from mesh.base.background import call_in_loop
from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.flood import BoundedDict, Drops, FairQueue
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.base.retry import Backoff, RetryPolicy
from mesh.content import ContentUnavailable, is_block, session_address
from mesh.errors import AiraError
from mesh.network.services import declared
from mesh.telemetry.metrics import MetricFamily, counter, gauge
from schemas import CidKey, InputError, cid_selector, parse_block, requested_cid
from schemas.status import ContentMetrics
from schemas.unixfs import MAX_BLOCK_SIZE

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator
    from contextlib import AsyncExitStack
    from pathlib import Path

    from bridges.ipfs.daemon import Daemon
    from mesh.base.clock import Clock
    from mesh.content import Assembly, BlockRef, Exchange, Store

    Found = Callable[[Iterable[str]], None]


log = logging.getLogger(__name__)

RAW: Final = "application/vnd.ipld.raw"
"""The media type of a raw block, the only response of a gateway that can be verified."""


class BlockLimits(NamedTuple):
    """What looking for blocks may take."""

    timeout: float = 10.0
    """Seconds that a source has for a block."""
    probe: float = 2.0
    """Seconds in which the first block of a file named in a message must be found, before the file is transferred."""
    remembered: int = 65_536
    """Blocks known to be parts of files, or to be unavailable."""


BLOCK_LIMITS: Final = BlockLimits()


class Gateway(Lifecycle):
    """The read-only HTTP gateway at `address` (a multiaddr or a URL): `async with Gateway(address) as gateway`."""

    title = "IPFS gateway"

    def __init__(self, address: str) -> None:
        self._base = base_url(address)
        self.api: Final = without_credentials(self._base)

    async def _open(self, stack: AsyncExitStack) -> None:
        self._http = await stack.enter_async_context(aiohttp.ClientSession())

    async def block(self, cid: str, *, limit: int, timeout: float) -> bytes:
        """A block by its CID, unverified. `timeout` is in seconds.

        Raises `IpfsError`, also for more than `limit` bytes. Gateways from before 2022 serve only whole files and can't
        be used.
        """
        try:
            async with self._http.get(
                f"{self._base}/ipfs/{cid}",
                params={"format": "raw"},
                headers={"Accept": RAW},
                timeout=aiohttp.ClientTimeout(total=timeout),
            ) as answer:
                if answer.status != 200:
                    raise IpfsError(self.api, f"HTTP {answer.status} for {cid}")
                if answer.content_type != RAW:
                    raise IpfsError(self.api, "this gateway serves only whole files, not blocks")
                return await read_answer(answer, self.api, limit)
        except (aiohttp.ClientError, TimeoutError) as error:
            raise unreachable(self.api, error, hint="is this the address of a gateway?") from error


class ContentSources:
    """Several sources, asked one after another."""

    def __init__(self, *sources: Daemon | Gateway) -> None:
        self._sources = sources
        self.corrupt: Final = Counter[str]()
        """Blocks that did not match their CID, by source."""
        self.bytes = 0
        """The size of all verified blocks."""

    async def block(self, cid: str, *, timeout: float = BLOCK_LIMITS.timeout) -> bytes:
        """The block of that CID, verified. `timeout` is in seconds, for each source.

        Raises `ContentUnavailable` with the reason of each source.
        """
        reasons = []
        for source in self._sources:
            try:
                block = await source.block(cid, limit=MAX_BLOCK_SIZE, timeout=timeout)
            except IpfsError as error:
                reasons.append(str(error))
                continue
            if is_block(cid, block):
                self.bytes += len(block)
                return block
            self.corrupt[source.api] += 1
            reasons.append(f"{source.api} returned a corrupt block")
            corrupt = log_event("block-corrupt", source=source.api, cid=cid, size=len(block))
            log.warning("%s returned %d bytes that do not match %s", source.api, len(block), cid, extra=corrupt)
        raise ContentUnavailable(cid, "; ".join(reasons) or "no IPFS node is configured")

    async def fetch(
        self, store: Store, cid: str, *, size_limit: int, timeout: float, found: Found = lambda cids: None
    ) -> Path:
        """Fetch a file into `store`, which lacks it, verifying each block; returns its path there.

        `size_limit` is in bytes; `timeout` in seconds. `found` is called with the CIDs of its blocks as they are found.
        Blocks received are kept for the next attempt.

        Raises `ContentUnavailable`, `ContentTooLarge`, `ContentCorrupt`, `StoreFull`, `InvalidCid`.
        """
        with store.assemble(cid, size_limit=size_limit) as assembly:
            try:
                async with asyncio.timeout(timeout):
                    await self._assemble(assembly, found)
            except TimeoutError:
                done, size = assembly.progress()
                raise ContentUnavailable(
                    cid, f"{done} of {size or 'an unknown number of'} bytes arrived within {timeout:g} s"
                ) from None
            return await asyncio.to_thread(assembly.finish)

    async def _assemble(self, assembly: Assembly, found: Found) -> None:
        waiting = [assembly.root]
        running: set[asyncio.Task[list[BlockRef]]] = set()
        try:
            while waiting or running:
                while waiting and len(running) < 8:
                    ref = waiting.pop()
                    running.add(asyncio.create_task(self._take(assembly, ref), name=f"block {ref.cid}"))
                done, running = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    refs = task.result()
                    found(ref.cid for ref in refs)
                    waiting.extend(reversed(refs))
        finally:
            for task in running:
                task.cancel()
            if running:
                await asyncio.wait(running)

    async def _take(self, assembly: Assembly, ref: BlockRef) -> list[BlockRef]:
        block = await asyncio.to_thread(assembly.local, ref)
        if block is None:
            block = await self.block(ref.cid)
        return await asyncio.to_thread(assembly.put_checked, ref, block)


async def add_file(daemon: Daemon, store: Store, path: Path, cid: str, *, timeout: float) -> bool:
    """Add and pin the file at `path`, which `store` holds as `cid`; False if it went block by block.

    A daemon chunks files in the usual way. A file that was chunked otherwise would get another CID, so its blocks are
    put one by one. `timeout` is in seconds. Raises `IpfsError`, `ContentUnavailable`.
    """
    added = await daemon.add(path, timeout=timeout)
    if added == cid:
        return True
    try:
        async with asyncio.timeout(timeout):
            await _put_blocks(daemon, store, cid)
    except TimeoutError:
        raise unreachable(daemon.api, f"the blocks of {cid} took more than {timeout:g} s") from None
    await daemon.pin(cid, timeout=timeout)
    try:
        await daemon.unpin(added)  # the same bytes under another CID
    except IpfsError as error:
        failed = log_event("unpin-failed", cid=added, code=error.code)
        log.info("%s, a copy of %s, stays pinned: %s", added, cid, error, extra=failed)
    return False


async def _put_blocks(daemon: Daemon, store: Store, cid: str) -> None:
    """Put a file's blocks, starting with the root."""
    waiting, known = [cid], {cid}
    while waiting:
        block_cid = waiting.pop()
        block = await asyncio.to_thread(store.get_block, block_cid)
        if block is None:
            raise ContentUnavailable(cid, f"the store no longer holds its block {block_cid}")
        await daemon.put_block(block)
        try:
            links = parse_block(block).links
        except InputError as error:
            raise ContentUnavailable(cid, str(error)) from None
        for link in links:
            if link.cid not in known:
                known.add(link.cid)
                waiting.append(link.cid)


class TransferLimits(NamedTuple):
    """What files in one direction may use."""

    at_once: int = 8
    """Files that are transferred at once."""
    per_signer: int = 32
    """Files that messages of one signer may have waiting."""
    waiting: int = 1024
    """Files that wait, and those that wait to be tried again."""
    pause: float = 60.0
    """Seconds for which a file that was transferred, or that nobody has, is not tried again."""
    remembered: int = 16_384
    """Files of which that is remembered."""


TRANSFER_LIMITS: Final = TransferLimits()

AGAIN, USUAL, URGENT = 0, 1, 2
"""Priorities: what failed before, what orders name, what results name."""


class _Wanted(NamedTuple):
    cid: str
    signer: str
    backoff: Backoff


class TransferQueue:
    """Transfers files by `transfer(cid)`, some at once: `async with TransferQueue(...)`, then `add`.

    Signers take turns. A file that waits already, is being transferred, or was a moment ago, is not transferred once
    more. What fails is tried again by the policy `retry`, after everything that has not been tried yet. What never
    succeeds is not tried for a while (`TRANSFER_LIMITS`). `transfer` should fail soon for a file that nobody has.
    `kind` names the direction in logs.
    """

    def __init__(
        self,
        transfer: Callable[[str], Awaitable[None]],
        *,
        kind: str,
        retry: RetryPolicy,
        drops: Drops,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._transfer = transfer
        self._kind = kind
        self._retry = retry
        self._drops = drops
        self._clock = clock
        self._queue: FairQueue[_Wanted] = FairQueue(
            per_sender=TRANSFER_LIMITS.per_signer, total=TRANSFER_LIMITS.waiting
        )
        self._waiting: set[tuple[str, str]] = set()
        self._running: set[str] = set()
        self._delayed: dict[str, asyncio.TimerHandle] = {}
        self._ended: BoundedDict[str, tuple[bool, float]] = BoundedDict(TRANSFER_LIMITS.remembered)
        """Whether a file was transferred at last, and when."""
        self.failed = 0
        """Files that were given up, and those for which there was no room."""
        self.joined = 0
        """Files that were not transferred because another transfer of the same did."""

    async def __aenter__(self) -> Self:
        self._tasks = [
            asyncio.create_task(self._work(), name=f"{self._kind} {n}") for n in range(TRANSFER_LIMITS.at_once)
        ]
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        for timer in self._delayed.values():
            timer.cancel()
        for task in self._tasks:
            task.cancel()
        await asyncio.wait(self._tasks)

    def add(self, cid: str, signer: str, *, priority: int = USUAL) -> None:
        """Transfer a file as soon as it is its turn."""
        is_under_way = (signer, cid) in self._waiting or cid in self._running or cid in self._delayed
        if is_under_way or self._has_ended(cid, succeeded=True):
            self.joined += 1
        elif self._has_ended(cid, succeeded=False):
            self.failed += 1
            self._drops.count("content-unavailable", signer)
        else:
            self._put(_Wanted(cid, signer, Backoff(self._retry)), priority)

    @property
    def queued(self) -> int:
        """Files that wait for their turn, or to be tried again."""
        return len(self._queue) + len(self._delayed)

    def _put(self, wanted: _Wanted, priority: int) -> None:
        self._waiting.add((wanted.signer, wanted.cid))
        for dropped in self._queue.put(wanted.signer, wanted, priority=priority):
            self._waiting.discard((dropped.signer, dropped.cid))
            self.failed += 1
            self._drops.count("content-queue-full", dropped.signer)

    async def _work(self) -> None:
        while True:
            wanted = await self._queue.get()
            self._waiting.discard((wanted.signer, wanted.cid))
            if wanted.cid in self._running or self._has_ended(wanted.cid, succeeded=True):
                self.joined += 1
                continue
            self._running.add(wanted.cid)
            try:
                await self._transfer(wanted.cid)
            except AiraError as error:
                self._failed(wanted, error)
            else:
                self._remember(wanted.cid, succeeded=True)
            finally:
                self._running.discard(wanted.cid)

    def _failed(self, wanted: _Wanted, error: AiraError) -> None:
        may_retry = isinstance(error, ContentUnavailable | IpfsError) and len(self._delayed) < TRANSFER_LIMITS.waiting
        delay = wanted.backoff.next_delay() if may_retry else None
        if delay is None:
            self.failed += 1
            self._remember(wanted.cid, succeeded=False)
            failed = log_event("transfer-failed", kind=self._kind, cid=wanted.cid, code=error.code)
            log.info("%s of %s failed: %s", self._kind, wanted.cid, error, extra=failed)
            return
        retried = log_event("transfer-retried", kind=self._kind, cid=wanted.cid, code=error.code)
        log.debug("%s of %s is tried again: %s", self._kind, wanted.cid, error, extra=retried)
        timer = asyncio.get_running_loop().call_later(delay, self._try_again, wanted)
        self._delayed[wanted.cid] = timer

    def _try_again(self, wanted: _Wanted) -> None:
        self._delayed.pop(wanted.cid, None)
        self._put(wanted, AGAIN)

    def _has_ended(self, cid: str, *, succeeded: bool) -> bool:
        """Whether the last transfer of a file ended so, a moment ago."""
        result, at = self._ended.get(cid, (succeeded, -TRANSFER_LIMITS.pause))
        return result == succeeded and self._clock.monotonic() - at < TRANSFER_LIMITS.pause

    def _remember(self, cid: str, *, succeeded: bool) -> None:
        self._ended[cid] = succeeded, self._clock.monotonic()


ADD_RETRY: Final = RetryPolicy(initial=10.0, factor=1.0, ceiling=10.0, attempts=4)
"""For files that a message names before the mesh has them."""
FETCH_RETRY: Final = RetryPolicy(initial=10.0, factor=1.0, ceiling=10.0, attempts=2)
"""For files that IPFS does not find at once."""
_COUNTED: Final = ("fetched", "answered", "added", "added_bytes", "by_blocks", "pinned")


@dataclass(frozen=True, kw_only=True)
class ContentParts:
    """What a content bridge works with; the caller closes it. Both sides are limited to files of `size_limit` bytes,
    and to `timeout` seconds for a file."""

    session: zenoh.Session
    store: Store
    exchange: Exchange
    sources: ContentSources
    daemon: Daemon
    providers: tuple[Daemon, ...] = ()
    """Further nodes, which pin what is added to the daemon."""
    size_limit: int
    timeout: float
    drops: Drops = field(default_factory=Drops)
    """What is not transferred because a signer names too many files."""


class ContentBridge(Lifecycle):
    """Transfers files between the mesh and IPFS: `async with ContentBridge(parts) as content`.

    Inside, queries of the mesh for blocks that the store lacks are answered from the sources, and the file that such a
    block begins is fetched and stored. `address` identifies the bridge; `add_retry` applies to `schedule_add`.
    """

    title = "content bridge"

    def __init__(self, parts: ContentParts, *, address: str = "", add_retry: RetryPolicy = ADD_RETRY) -> None:
        self._parts = parts
        self._address = address or session_address(parts.session)
        self.adds: Final = TransferQueue(self._add_if_held, kind="add", retry=add_retry, drops=parts.drops)
        """What is added to IPFS in the background, for messages; a failure is logged and counted."""
        self.fetches: Final = TransferQueue(self._fetch_if_found, kind="fetch", retry=FETCH_RETRY, drops=parts.drops)
        """What is fetched from IPFS in the background."""
        self._inner: BoundedDict[str, None] = BoundedDict(BLOCK_LIMITS.remembered)
        self._unavailable: BoundedDict[str, float] = BoundedDict(BLOCK_LIMITS.remembered)
        self._tasks: set[asyncio.Task[None]] = set()
        self._fetches: dict[str, asyncio.Task[Path]] = {}
        self._answering = 0
        self._adding: Counter[str] = Counter()
        self._counts = Counter[str]()

    async def _open(self, stack: AsyncExitStack) -> None:
        loop = asyncio.get_running_loop()
        stack.push_async_callback(self._end_tasks)
        await stack.enter_async_context(self.adds)
        await stack.enter_async_context(self.fetches)
        queryable = self._parts.session.declare_queryable(
            cid_selector(self._address), lambda query: call_in_loop(loop, self._accept, query)
        )
        stack.enter_context(declared(self._parts.session, queryable))

    async def _end_tasks(self) -> None:
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
            path = await self._parts.exchange.fetch(cid, size_limit=self._parts.size_limit, timeout=self._parts.timeout)
        try:
            size = (await asyncio.to_thread(path.stat)).st_size
            as_file = await add_file(self._parts.daemon, self._parts.store, path, cid, timeout=self._parts.timeout)
        except OSError as error:  # the store evicted it meanwhile
            raise ContentUnavailable(cid, f"it can't be read: {error.strerror}") from error
        self._counts.update(added=1, added_bytes=size, by_blocks=0 if as_file else 1)
        for provider in self._parts.providers:
            try:
                await provider.pin(cid, timeout=self._parts.timeout)
                self._counts["pinned"] += 1
            except IpfsError as error:
                failed = log_event("pin-failed", cid=cid, provider=provider.api, code=error.code)
                log.warning("%s is not pinned: %s", cid, error, extra=failed)

    def metrics(self) -> ContentMetrics:
        return ContentMetrics(
            **{name: self._counts[name] for name in _COUNTED},
            fetched_bytes=self._parts.sources.bytes,
            lies=self._parts.sources.corrupt.total(),
            failed=self.adds.failed + self.fetches.failed,
            joined=self.adds.joined + self.fetches.joined,
            adds_queued=self.adds.queued,
            fetches_queued=self.fetches.queued,
        )

    async def _fetch(self, cid: str) -> Path:
        if (held := await asyncio.to_thread(self._parts.store.checked, cid)) is not None:
            return held
        path = await self._parts.sources.fetch(
            self._parts.store,
            cid,
            size_limit=self._parts.size_limit,
            timeout=self._parts.timeout,
            found=self._remember_parts,
        )
        self._counts["fetched"] += 1
        return path

    async def _fetch_if_found(self, cid: str) -> None:
        if not await asyncio.to_thread(self._parts.store.has, cid):
            await self._parts.sources.block(cid, timeout=min(BLOCK_LIMITS.probe, self._parts.timeout))
        await self.fetch(cid)

    async def _add_if_held(self, cid: str) -> None:
        if not await asyncio.to_thread(self._parts.store.has, cid):
            with self._not_answering(cid):
                is_held = await self._parts.exchange.is_held(cid, timeout=min(BLOCK_LIMITS.probe, self._parts.timeout))
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
        busy = self._answering >= 32  # others get no reply and are sent again
        if not self.is_open or cid is None or busy or cid in self._adding or self._is_unavailable(cid):
            query.drop()  # type: ignore[no-untyped-call]
            return
        self._answering += 1
        task = asyncio.create_task(self._answer(query, cid), name=f"answer {cid}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, query: zenoh.Query, cid: str) -> None:
        try:
            with query:
                if await asyncio.to_thread(self._parts.store.get_block, cid) is not None:
                    return  # the exchange replies
                try:
                    block = await self._parts.sources.block(cid)
                except ContentUnavailable as error:
                    log.debug("%s", error)
                    self._unavailable[cid] = asyncio.get_running_loop().time()
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
        if cid not in self._inner:
            self.fetches.add(cid, "")

    def _remember_parts(self, cids: Iterable[str]) -> None:
        """These are blocks of files that are fetched as a whole: no files to fetch of their own."""
        for cid in cids:
            self._inner[cid] = None

    def _is_unavailable(self, cid: str) -> bool:
        asked = self._unavailable.get(cid)
        return asked is not None and asyncio.get_running_loop().time() - asked < 10.0


def content_families(content: ContentMetrics) -> tuple[MetricFamily, ...]:
    """The metrics of content, for all lighthouses together."""
    return (
        counter("aira_bridge_content_fetched_total", "Files fetched from IPFS and stored", content.fetched),
        counter("aira_bridge_content_fetched_bytes_total", "Blocks received from IPFS, bytes", content.fetched_bytes),
        counter("aira_bridge_content_lies_total", "Blocks from IPFS that did not match their CID", content.lies),
        counter("aira_bridge_content_answered_total", "IPFS blocks served to the mesh", content.answered),
        counter("aira_bridge_content_added_total", "Files of the mesh added to IPFS", content.added),
        counter("aira_bridge_content_added_bytes_total", "Files of the mesh added to IPFS, bytes", content.added_bytes),
        counter("aira_bridge_content_by_blocks_total", "Of these, files added block by block", content.by_blocks),
        counter("aira_bridge_content_pinned_total", "Pins of files on further nodes", content.pinned),
        counter("aira_bridge_content_failed_total", "Files that could not be fetched or added", content.failed),
        counter("aira_bridge_content_joined_total", "Files not transferred once more for a repetition", content.joined),
        gauge("aira_bridge_content_adds_queued", "Files that wait to be added to IPFS", content.adds_queued),
        gauge("aira_bridge_content_fetches_queued", "Files that wait to be fetched from IPFS", content.fetches_queued),
    )
