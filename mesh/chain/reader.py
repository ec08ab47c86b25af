"""Reading a chain's events block by block from a cursor.

By `eth_getLogs` over ranges of blocks: no filters are kept by the node, so nothing is missed across its restarts or
ours.
"""

from __future__ import annotations

import asyncio
from contextlib import aclosing
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final, cast

from mesh.chain.errors import ChainWentBack, RequestRefused
from mesh.chain.events import ChainEvent, NewLighthouse, decode_log, topics_of
from schemas.address import parse_address

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Collection, Sequence

    from web3.types import FilterParams

    from mesh.chain.node import Node

MAX_RANGE: Final = 2_000
"""Blocks asked for at once; halved as often as a node refuses."""


@dataclass(frozen=True, slots=True)
class BlockEvents:
    """The events of a block, in order. All blocks up to `block_number` have been read: the next cursor is one more."""

    block_number: int
    events: tuple[ChainEvent, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sources:
    """Whose events are read: the factory, the token XRT, any lighthouses, and all liabilities of the factory."""

    factory: str
    xrt: str
    lighthouses: tuple[str, ...] = ()
    is_liability: Callable[[str], Awaitable[bool]]


async def read_blocks(node: Node, sources: Sources, from_block: int) -> AsyncGenerator[BlockEvents, None]:
    """Events from `from_block` on, for ever; block numbers only grow.

    A block without events comes where nothing else would tell how far was read. Raises `ChainWentBack` at the start,
    `NodeUnreachable`, `RequestRefused`; reading goes on from the cursor with a new iterator.
    """
    head = await node.block_number()
    if from_block > head + 1:
        raise ChainWentBack(from_block, head)
    cursor = from_block
    while True:
        async with aclosing(_read_to(node, sources, cursor, head)) as blocks:
            async for block in blocks:
                yield block
        cursor = max(cursor, head + 1)
        await asyncio.sleep(node.timing.poll_interval)
        head = await node.block_number()


async def find_lighthouses(node: Node, sources: Sources, from_block: int) -> list[NewLighthouse]:
    """All lighthouses made from a block to the latest, in order. Raises `NodeUnreachable`, `RequestRefused`."""
    blocks = _read_to(node, sources, from_block, await node.block_number())
    return [event async for block in blocks for event in block.events if isinstance(event, NewLighthouse)]


async def _read_to(node: Node, sources: Sources, first: int, head: int) -> AsyncGenerator[BlockEvents, None]:
    """The events from a block to another, in ranges as long as the node answers."""
    span = MAX_RANGE
    while first <= head:
        last = min(head, first + span - 1)
        try:
            blocks = await read_range(node, sources, first=first, last=last)
        except RequestRefused:
            if span == 1:
                raise
            span = max(1, span // 2)
            continue
        for block in blocks:
            yield block
        first = last + 1


async def read_range(node: Node, sources: Sources, *, first: int, last: int) -> list[BlockEvents]:
    """The events of the blocks from `first` to `last`, both included; an empty one stands for an eventless last."""
    addresses = [sources.factory, sources.xrt, *sources.lighthouses]
    ours = await _logs(node, first, last, addresses=addresses, topics=topics_of("Factory", "XRT", "Lighthouse"))
    finals = await _logs(node, first, last, addresses=(), topics=topics_of("Liability"))
    finals = [log for log in finals if await sources.is_liability(parse_address(log["address"]))]
    logs = sorted((*ours, *finals), key=lambda log: (log["blockNumber"], log["logIndex"]))
    blocks = []
    for number, of_block in groupby(logs, key=lambda log: int(log["blockNumber"])):
        events = tuple(event for log in of_block if (event := decode_log(log)) is not None)
        blocks.append(BlockEvents(number, events))
    if not blocks or blocks[-1].block_number != last:
        blocks.append(BlockEvents(last, ()))
    return blocks


async def _logs(node: Node, first: int, last: int, *, addresses: Collection[str], topics: Sequence[str]) -> list[Any]:
    query: dict[str, Any] = {"fromBlock": first, "toBlock": last, "topics": [list(topics)]}
    if addresses:
        query["address"] = list(addresses)
    return list(await node.web3.eth.get_logs(cast("FilterParams", query)))
