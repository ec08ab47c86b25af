"""What happens on the chain, block by block, as it happens."""

from __future__ import annotations

import asyncio
import logging
from contextlib import aclosing
from functools import partial
from typing import TYPE_CHECKING

from mesh.chain.errors import NodeUnreachable, RequestRefused
from mesh.chain.events import NewLiability, NewLighthouse
from mesh.chain.history import History
from mesh.chain.reader import BlockEvents, Sources, read_blocks, read_made, read_once, read_range
from mesh.outage_log import OutageLog

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Iterable

    from mesh.chain.contracts import Contracts

log = logging.getLogger(__name__)


def follow(
    contracts: Contracts,
    from_block: int,
    *,
    lighthouses: Iterable[str] = (),
    token: str = "",
    history: History | None = None,
) -> AsyncGenerator[BlockEvents, None]:
    """Events from a block on, for ever (see `read_blocks`); those of lighthouses only of the given addresses.

    Transfers and approvals are those of the token at the address `token`, XRT by default. Blocks that the chain
    replaced come as `Reorganisation`, also from before where the `history` is given that an earlier iterator filled.
    """
    sources = Sources(
        factory=contracts.factory,
        token=token or contracts.xrt,
        lighthouses=tuple(lighthouses),
        is_liability=contracts.version.is_liability,
        recognise=contracts.version.recognise,
    )
    return read_blocks(contracts.node, partial(read_range, contracts.node, sources), from_block, history=history)


async def list_created(contracts: Contracts, from_block: int) -> AsyncGenerator[NewLiability | NewLighthouse, None]:
    """What the factory created from a block to the latest one, in order."""
    blocks = read_once(contracts.node, partial(read_made, contracts.node, contracts.factory), from_block)
    async with aclosing(blocks):
        async for block in blocks:
            for event in block.events:
                if isinstance(event, NewLiability | NewLighthouse):
                    yield event


async def follow_created(contracts: Contracts, cursor: int) -> AsyncGenerator[NewLiability | NewLighthouse, None]:
    """What the factory creates from a block on, for ever; a node that is lost is waited for."""
    node = contracts.node
    history, outages = History(node.timing.reorg_depth), OutageLog(log, "chain")
    read = partial(read_made, node, contracts.factory)
    while True:
        try:
            async with aclosing(read_blocks(node, read, cursor, history=history)) as blocks:
                async for block in blocks:
                    outages.recovered(f"the chain can be read again, from block {block.block_number}")
                    for event in block.events:
                        if isinstance(event, NewLiability | NewLighthouse):
                            yield event
                    cursor = block.block_number + 1
        except (NodeUnreachable, RequestRefused) as error:
            outages.failed(error, "can't read the chain, retrying")
        await asyncio.sleep(node.timing.poll_interval)
