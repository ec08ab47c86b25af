"""Reading the events of ranges of blocks with `eth_getLogs`.

The node keeps no filters for us, so a restart on either side loses nothing. `mesh.chain.following` builds on this.
"""

from __future__ import annotations

import asyncio
from contextlib import aclosing
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Final, TypeAlias

from mesh.chain.errors import NodeUnreachable, RequestRefused
from mesh.chain.events import (
    Approval,
    ChainEvent,
    Finalized,
    NewLiability,
    NewLighthouse,
    Transfer,
    decode_log,
    topics_of,
)
from schemas.address import address_bytes

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Collection, Iterable, Sequence

    from mesh.chain.answers import BlockHeader, Log
    from mesh.chain.node import Node

MAX_RANGE: Final = 2_000
"""Blocks in one request. Halved each time a node refuses, and grown by a quarter each time it answers."""

LIST_ATTEMPTS: Final = 5
"""How often blocks are read again that were replaced meanwhile, where nothing is followed."""


@dataclass(frozen=True, slots=True)
class SeenBlock:
    """A block that was read: its number, its hash (32 bytes) and its events, in order."""

    block_number: int
    block_hash: bytes
    events: tuple[ChainEvent, ...]


class ReplacedWhileReading(Exception):
    """The chain was reorganised between two requests: the answers don't belong together."""


Choose: TypeAlias = "Callable[[Sequence[str], Sequence[str]], Awaitable[Collection[str]]]"
"""Returns, of the liabilities (addresses) that were created and of those that ended, the ones whose events are read."""

DecodedLog: TypeAlias = "tuple[Log, ChainEvent | None]"
"""A log and its event, if it is one of the contracts'."""

ReadRange: TypeAlias = "Callable[[int, int, BlockHeader | None], Awaitable[list[SeenBlock]]]"
"""Reads the blocks from one to another, both included, as `read_events` does; of a single block it gets the header."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EventSources:
    """The contracts whose events are read: the factory, a token, any lighthouses, and the factory's liabilities.

    The token's transfers and approvals are those that concern `parties` (addresses), or all.
    """

    factory: str
    token: str
    parties: frozenset[str] | None = None
    lighthouses: tuple[str, ...] = ()
    choose: Choose | None = None
    """Which liabilities' events are read; those of all by default."""
    is_liability: Callable[[str], Awaitable[bool]]
    recognise: Callable[[str], None]
    """Called with each liability that the factory's events name, before `is_liability` is asked about its events."""

    def logs_in(self, header: BlockHeader | None) -> bool:
        """Whether a block may hold a log of the named contracts; with None, it is not known."""
        wanted = [
            (address_bytes(contract), topic)
            for contract in (self.factory, *self.lighthouses)
            for topic in _topics("Factory", "Lighthouse")
        ]
        of_token = [(address_bytes(self.token), topic) for topic in _topics("XRT")]
        if self.parties is None:
            return header is None or header.may_log(*wanted, *of_token)
        parties = [bytes(12) + address_bytes(party) for party in self.parties]
        return header is None or header.may_log(*wanted, *((*one, party) for one in of_token for party in parties))

    async def chosen(self, decoded: Sequence[DecodedLog]) -> list[DecodedLog]:
        """The same logs, with None for each event that is not one of those that are read."""
        liabilities: Collection[str] | None = None
        if self.choose is not None:
            created = [event.liability for _, event in decoded if isinstance(event, NewLiability)]
            ended = [event.liability for _, event in decoded if isinstance(event, Finalized)]
            liabilities = await self.choose(created, ended) if created or ended else ()
        return [(log, event if self._is_read(event, liabilities) else None) for log, event in decoded]

    def _is_read(self, event: ChainEvent | None, liabilities: Collection[str] | None) -> bool:
        match event:
            case Transfer(one, other) | Approval(one, other):
                return self.parties is None or one in self.parties or other in self.parties
            case NewLiability(liability) | Finalized(liability):
                return liabilities is None or liability in liabilities
        return True


class RangeReader:
    """Reads long ranges of blocks in requests that are as long as the node answers."""

    def __init__(self, node: Node, read: ReadRange) -> None:
        self._node = node
        self._read = read
        self._span = MAX_RANGE

    async def read_to(self, first: int, head: BlockHeader) -> AsyncGenerator[SeenBlock, None]:
        """The blocks with events from `first` to the head, and the last block of each request.

        The hash of a block without events is empty, but for the head's. Raises `NodeUnreachable`, `RequestRefused`,
        `ReplacedWhileReading`.
        """
        while first <= head.number:
            last = min(head.number, first + self._span - 1)
            try:
                blocks = await self._read(first, last, head if first == last == head.number else None)
            except (RequestRefused, NodeUnreachable) as error:
                if first == last:
                    raise
                if isinstance(error, NodeUnreachable):
                    # A node may drop the connection because the range is long; one that is gone raises again here.
                    await self._node.block_number()
                self._span = (last - first + 1) // 2
                continue
            if last < head.number:
                # If the node only claims to have that head, reading towards it would never end.
                await self._node.block_hash(last)
            if first < head.number and await self._node.block_hash(head.number) != head.hash:
                # Some of the answers may be of the blocks that were replaced, and their events are of both.
                raise ReplacedWhileReading
            for block in blocks:
                yield _with_hash_of(block, head)
            first = last + 1
            self._span = min(MAX_RANGE, self._span + max(1, self._span // 4))


async def read_events(
    node: Node, sources: EventSources, first: int, last: int, header: BlockHeader | None
) -> list[SeenBlock]:
    """The blocks with events from `first` to `last`, both included, and `last` itself.

    With the `header` of a single block, the node is asked only for logs that the block may hold. Raises
    `ReplacedWhileReading` when the logs of a block are of two different blocks.
    """
    logs: list[Log] = []
    if sources.logs_in(header):
        contracts = [sources.factory, sources.token, *sources.lighthouses]
        logs = await node.logs(first, last, addresses=contracts, topics=topics_of("Factory", "XRT", "Lighthouse"))
    decoded = [(log, decode_log(log)) for log in logs]
    for log, event in decoded:
        if isinstance(event, NewLiability) and log.address == sources.factory:
            sources.recognise(event.liability)
    endings: list[Log] = []
    if header is None or header.may_log(_topics("Liability")):
        endings = await node.logs(first, last, addresses=(), topics=topics_of("Liability"))
    # Any contract can log the same event, and as often as it likes.
    ours = {address for address in {log.address for log in endings} if await sources.is_liability(address)}
    decoded += [(log, decode_log(log)) for log in endings if log.address in ours]
    return _by_block(await sources.chosen(decoded), last)


async def read_created(node: Node, factory: str, first: int, last: int, header: BlockHeader | None) -> list[SeenBlock]:
    """The same with the events of the factory only."""
    if header is not None and not header.may_log(*((address_bytes(factory), topic) for topic in _topics("Factory"))):
        return _by_block((), last)
    logs = await node.logs(first, last, addresses=[factory], topics=topics_of("Factory"))
    return _by_block(((log, decode_log(log)) for log in logs), last)


async def list_created(node: Node, factory: str, from_block: int) -> list[NewLiability | NewLighthouse]:
    """What the factory created from a block to the latest one. Raises `NodeUnreachable`, `RequestRefused`."""
    for _ in range(LIST_ATTEMPTS):
        ranges = RangeReader(node, partial(read_created, node, factory))
        try:
            async with aclosing(ranges.read_to(from_block, await node.latest_header())) as blocks:
                events = [event async for block in blocks for event in block.events]
        except ReplacedWhileReading:
            await asyncio.sleep(node.timing.poll_interval)
        else:
            return [event for event in events if isinstance(event, NewLiability | NewLighthouse)]
    raise NodeUnreachable(node.endpoint, "its blocks are replaced whenever they are read")


def _topics(*contracts: str) -> list[bytes]:
    return [bytes.fromhex(topic[2:]) for topic in topics_of(*contracts)]


def _by_block(decoded: Iterable[DecodedLog], last: int) -> list[SeenBlock]:
    """The blocks of some logs that have events, and the last one."""
    ordered = sorted(decoded, key=lambda one: (one[0].block_number, one[0].log_index))
    blocks = []
    for number, group in groupby(ordered, key=lambda one: one[0].block_number):
        of_block = list(group)
        hashes = {log.block_hash for log, _ in of_block}
        if len(hashes) > 1:
            raise ReplacedWhileReading
        events = tuple(event for _, event in of_block if event is not None)
        if events or number == last:
            blocks.append(SeenBlock(number, hashes.pop(), events))
    if not blocks or blocks[-1].block_number != last:
        blocks.append(SeenBlock(last, b"", ()))
    return blocks


def _with_hash_of(block: SeenBlock, head: BlockHeader) -> SeenBlock:
    if block.block_number != head.number or block.block_hash == head.hash:
        return block
    if block.block_hash:
        raise ReplacedWhileReading
    return SeenBlock(block.block_number, head.hash, block.events)
