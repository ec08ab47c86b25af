"""Adding a file of the mesh to IPFS under the very name that it has."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from bridges.ipfs.errors import DaemonRefused, DaemonUnreachable
from mesh.content import ContentUnavailable
from schemas import InputError, parse_block

if TYPE_CHECKING:
    from pathlib import Path

    from bridges.ipfs.daemon import Daemon
    from mesh.content import Store

log = logging.getLogger(__name__)


async def add_as_named(daemon: Daemon, store: Store, path: Path, cid: str, *, timeout: float) -> bool:
    """Add and pin the file at `path`, which `store` holds as `cid`. `timeout` is in seconds.

    A daemon chunks a file as nearly everybody does. One that was chunked otherwise gets another name so, and is then
    given to the daemon block by block: False in that case. Raises `IpfsError`, `ContentUnavailable`.
    """
    name = await daemon.add(path, timeout=timeout)
    if name == cid:
        return True
    try:
        async with asyncio.timeout(timeout):
            await _put_blocks(daemon, store, cid)
    except TimeoutError:
        raise DaemonUnreachable(daemon.api, f"the blocks of {cid} took more than {timeout:g} s") from None
    await daemon.pin(cid, timeout=timeout)
    try:
        await daemon.unpin(name)  # the same bytes once more
    except DaemonRefused as error:
        log.info("%s, the same file as %s, stays pinned: %s", name, cid, error)
    return False


async def _put_blocks(daemon: Daemon, store: Store, cid: str) -> None:
    """From the root down; who asks meanwhile gets what is there, and the rest a moment later."""
    waiting, known = [cid], {cid}
    while waiting:
        name = waiting.pop()
        block = await asyncio.to_thread(store.get_block, name)
        if block is None:
            raise ContentUnavailable(cid, f"its block {name} is not in the store any more")
        await daemon.put_block(block)
        try:
            links = parse_block(block).links
        except InputError as error:
            raise ContentUnavailable(cid, str(error)) from None
        for link in links:
            if link.cid not in known:
                known.add(link.cid)
                waiting.append(link.cid)
