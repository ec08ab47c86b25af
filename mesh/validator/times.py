"""When a liability was created and when its Result came, by the chain's clock and this machine's.

Recordings must have been made in between. If the two clocks differ, the longer time counts: a wrong clock of the
validator must not fail honest work.
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import TYPE_CHECKING

from mesh.chain import NodeUnreachable, RequestRefused

if TYPE_CHECKING:
    from mesh.chain import BlockHeader, Chain


async def created_ns(chain: Chain, block: int) -> int:
    """When a block was made, in nanoseconds of Unix time, never in the future.

    The clock of a development chain may be ahead, because each block is a second later than the one before.
    """
    now, header, head = time.time_ns(), await _header(chain, block), await _header(chain, "latest")
    if header is None or head is None:
        return now
    ahead = max(0, head.timestamp * 10**9 - now)
    return min(now, header.timestamp * 10**9 - ahead)


async def arrived_ns(chain: Chain) -> int:
    """What time it is now, in nanoseconds of Unix time: the later of the two clocks."""
    head = await _header(chain, "latest")
    return time.time_ns() if head is None else max(time.time_ns(), head.timestamp * 10**9)


async def _header(chain: Chain, block: int | str) -> BlockHeader | None:
    """A block; None if the node does not say."""
    with suppress(NodeUnreachable, RequestRefused):
        return await chain.node.header(block)
    return None
