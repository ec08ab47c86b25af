"""Transfers of files between a store and IPFS: fetched from the daemon or gateways, added to the daemon.

Every block received is verified by its hash.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from typing import TYPE_CHECKING, Final, Protocol, Self

import aiohttp

from bridges.ipfs.addresses import base_url, without_credentials
from bridges.ipfs.errors import DaemonRefused, DaemonUnreachable, IpfsError
from mesh.content import ContentUnavailable, is_block
from mesh.errors import ClosedError
from mesh.log_context import log_event
from schemas import InputError, parse_block
from schemas.unixfs import MAX_BLOCK_SIZE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from bridges.ipfs.daemon import Daemon
    from mesh.content import Assembly, BlockRef, Store

    Found = Callable[[Iterable[str]], None]

log = logging.getLogger(__name__)

RAW: Final = "application/vnd.ipld.raw"
"""The media type of a raw block, the only response of a gateway that can be verified."""
CONCURRENT_BLOCKS: Final = 8
"""Blocks of one file that are requested at the same time."""


class ContentSource(Protocol):
    """Gives blocks: a `Daemon` or a `Gateway`."""

    @property
    def api(self) -> str: ...

    async def block(self, cid: str, *, limit: int, timeout: float) -> bytes:
        """A block, unverified. Raises `IpfsError`."""


class Gateway:
    """The read-only HTTP gateway at `address` (a multiaddr or a URL): `async with Gateway(address) as gateway`."""

    def __init__(self, address: str) -> None:
        self._base = base_url(address)
        self.api: Final = without_credentials(self._base)
        self._http: aiohttp.ClientSession | None = None

    async def __aenter__(self) -> Self:
        self._http = aiohttp.ClientSession()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        http, self._http = self._http, None
        if http is not None:
            await http.close()

    async def block(self, cid: str, *, limit: int, timeout: float) -> bytes:
        """A block by its CID, unverified. `timeout` is in seconds.

        Raises `DaemonUnreachable`, and `DaemonRefused`, also for more than `limit` bytes. Gateways from before 2022
        serve only whole files and can't be used.
        """
        if self._http is None:
            raise ClosedError("the client of the IPFS gateway is not open", hint="use it inside `async with`")
        try:
            async with self._http.get(
                f"{self._base}/ipfs/{cid}",
                params={"format": "raw"},
                headers={"Accept": RAW},
                timeout=aiohttp.ClientTimeout(total=timeout),
            ) as answer:
                if answer.status != 200:
                    raise DaemonRefused(self.api, answer.status, f"HTTP {answer.status} for {cid}")
                if answer.content_type != RAW:
                    raise DaemonRefused(self.api, answer.status, "this gateway serves only whole files, not blocks")
                content = bytearray()
                async for chunk in answer.content.iter_any():
                    content += chunk
                    if len(content) > limit:
                        raise DaemonRefused(self.api, answer.status, f"an answer of more than {limit} bytes")
        except (aiohttp.ClientError, TimeoutError) as error:
            raise DaemonUnreachable(self.api, str(error) or type(error).__name__) from error
        return bytes(content)


class ContentSources:
    """Several sources, asked one after another."""

    def __init__(self, *sources: ContentSource) -> None:
        self._sources = sources
        self.corrupt: Final = Counter[str]()
        """Blocks that did not match their CID, by source."""
        self.bytes = 0
        """The size of all verified blocks."""

    async def block(self, cid: str, *, timeout: float) -> bytes:
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
        self,
        store: Store,
        cid: str,
        *,
        size_limit: int,
        timeout: float,
        block_timeout: float,
        found: Found = lambda cids: None,
    ) -> Path:
        """Fetch a file into `store`, which lacks it, verifying each block; returns its path there.

        `size_limit` is in bytes; `timeout` in seconds for the file, `block_timeout` for a block. `found` is called with
        the CIDs of its blocks as they are found. Blocks received are kept for the next attempt.

        Raises `ContentUnavailable`, `ContentTooLarge`, `ContentCorrupt`, `StoreFull`, `InvalidCid`.
        """
        with store.assemble(cid, size_limit=size_limit) as assembly:
            try:
                async with asyncio.timeout(timeout):
                    await self._assemble(assembly, block_timeout, found)
            except TimeoutError:
                done, size = assembly.progress()
                raise ContentUnavailable(
                    cid, f"{done} of {size or 'an unknown number of'} bytes arrived within {timeout:g} s"
                ) from None
            return await asyncio.to_thread(assembly.finish)

    async def _assemble(self, assembly: Assembly, block_timeout: float, found: Found) -> None:
        waiting = [assembly.root]
        running: set[asyncio.Task[list[BlockRef]]] = set()
        try:
            while waiting or running:
                while waiting and len(running) < CONCURRENT_BLOCKS:
                    ref = waiting.pop()
                    running.add(asyncio.create_task(self._take(assembly, ref, block_timeout), name=f"block {ref.cid}"))
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

    async def _take(self, assembly: Assembly, ref: BlockRef, block_timeout: float) -> list[BlockRef]:
        block = await asyncio.to_thread(assembly.local, ref)
        if block is None:
            block = await self.block(ref.cid, timeout=block_timeout)
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
        raise DaemonUnreachable(daemon.api, f"the blocks of {cid} took more than {timeout:g} s") from None
    await daemon.pin(cid, timeout=timeout)
    try:
        await daemon.unpin(added)  # the same bytes under another CID
    except DaemonRefused as error:
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
