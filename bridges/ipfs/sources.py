"""Blocks from IPFS: whoever gives them is believed only by their hash."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from typing import TYPE_CHECKING, Final, Protocol

from bridges.ipfs.errors import IpfsError
from mesh.content import ContentUnavailable, is_block
from schemas.unixfs import MAX_BLOCK_SIZE

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.content import Assembly, BlockRef, Store

log = logging.getLogger(__name__)

WIDTH: Final = 8
"""Blocks of a file that are on their way at once."""


class Source(Protocol):
    """Gives blocks: a `Daemon`, a `Gateway`."""

    @property
    def api(self) -> str: ...

    async def block(self, cid: str, *, limit: int, timeout: float) -> bytes:
        """A block, unchecked. Raises `IpfsError`."""


class Sources:
    """Several sources, asked one after the other."""

    def __init__(self, *sources: Source) -> None:
        self._sources = sources
        self.lies: Final = Counter[str]()
        """Answers of each source that did not hash to the name asked for."""
        self.bytes = 0
        """Of all blocks that were given and are what they should be."""

    async def block(self, cid: str, *, timeout: float) -> bytes:
        """The block of that name, checked. `timeout` is in seconds, for each source.

        Raises `ContentUnavailable`, with what each source said.
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
            self.lies[source.api] += 1
            reasons.append(f"{source.api} gave other bytes")
            log.warning("%s gave %d bytes for %s that are not it", source.api, len(block), cid)
        raise ContentUnavailable(cid, "; ".join(reasons) or "no IPFS node is configured")

    async def fetch(self, store: Store, cid: str, *, size_limit: int, timeout: float, patience: float) -> Path:
        """Where the file is in `store`, once it is there whole and every block of it was checked.

        `size_limit` is in bytes; `timeout` in seconds for the whole file, `patience` for a block. What came is kept for
        the next attempt. Raises `ContentUnavailable`, `ContentTooLarge`, `ContentCorrupt`, `StoreFull`, `InvalidCid`.
        """
        held = await asyncio.to_thread(store.checked, cid)
        if held is not None:
            return held
        with store.assemble(cid, size_limit=size_limit) as assembly:
            try:
                async with asyncio.timeout(timeout):
                    await self._assemble(assembly, patience)
            except TimeoutError:
                done, size = assembly.progress()
                raise ContentUnavailable(
                    cid, f"{done} of {size or 'an unknown number of'} bytes came within {timeout:g} s"
                ) from None
            return await asyncio.to_thread(assembly.finish)

    async def _assemble(self, assembly: Assembly, patience: float) -> None:
        waiting = [assembly.root]
        running: set[asyncio.Task[list[BlockRef]]] = set()
        try:
            while waiting or running:
                while waiting and len(running) < WIDTH:
                    place = waiting.pop()
                    running.add(asyncio.create_task(self._take(assembly, place, patience), name=f"block {place.cid}"))
                done, running = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    waiting.extend(reversed(task.result()))
        finally:
            for task in running:
                task.cancel()
            if running:
                await asyncio.wait(running)

    async def _take(self, assembly: Assembly, place: BlockRef, patience: float) -> list[BlockRef]:
        block = await asyncio.to_thread(assembly.local, place)
        if block is None:
            block = await self.block(place.cid, timeout=patience)
        return await asyncio.to_thread(assembly.put_checked, place, block)
