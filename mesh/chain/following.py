"""Events: decoding and reading them, and following the chain with its reorganisations.

    async with aclosing(chain.follow(cursor, history=history)) as blocks:
        async for block in blocks:
            if isinstance(block, Reorganisation):
                undo(block.reverted_events)
            handle(block.events)
            save(block.block_number + 1, history.encode())

**What is yielded.** A `BlockEvents` for each block that has events, with its events in the order of the chain, and for
some blocks that have none, so that the consumer knows how far the chain was read. Block numbers only grow, except
after a reorganisation. A block is yielded as soon as the node has it: waiting for confirmations is up to the consumer.

**In a reorganisation** the chain replaces its last blocks. A `Reorganisation` is then yielded before anything else.
Its `block_number` is the last block that is still as it was yielded; its `reverted_events` are all events that were
yielded from later blocks, the newest first. The consumer must undo them in that order. The blocks that replace the
old ones follow: an event that happened on both sides is reverted first and then yielded again. A chain that is only
shorter has replaced nothing yet (the node may be behind), so nothing is reverted before the new blocks are there.

**The cursor** is the next block to read: always `block.block_number + 1` of what was yielded last, also for a
`Reorganisation`. A consumer that fails while it handles a block starts again from the cursor it saved, and gets that
block again: handling must be idempotent.

**The history** (`History`) holds the hashes and events of the last `Timing.reorg_depth` blocks that were yielded.
Hashes are compared with the chain's to notice a reorganisation; the events are what it reverts. `follow` fills the
history that it is given. Save it with the cursor and pass it again after a restart: blocks that were replaced in the
meantime are then reverted first. Without one, only a reorganisation that happens while following is noticed:
`history_at` is for a consumer that must know of each since it decided where to begin.

**When the node fails**, the failure is logged once (`OutageLog`) and reading continues from the cursor as soon as the
node answers, with the backoff `Timing.outage_retry`. What stops `follow` is a chain that can't be the one that was
read: `ChainWentBack` (the cursor is past its end, or no block of the history is on it).

**Reading.** An answer should prove which block it is for: the node may be many machines, and one that lacks the newest
blocks answers `[]` to `eth_getLogs`, or leaves logs out, and that looks like a true answer. So the `recent` blocks
(`FollowLimits`) are read one by one: their headers are a chain of hashes that ends at the head, and `Node.block_logs`
asks for the logs of a hash. This is a proof, at the price of a header for each block. Older blocks are read in ranges,
which is none: a range is `asked` for several times at once, and the answer with the most logs is taken. So a log is
lost if all these answers come from machines that lack all `recent` blocks: an eighth of the ranges if half of the
machines do, a thousandth if a tenth do. The node keeps no filters for us: a restart on either side loses nothing.

**Where blocks are quick** (`FollowPace`), a header for each would be most of what a node is asked. There a look first
glances at the logs of the last half minute, in ranges. It reads block by block only if there is a log of a block that
it has not read that way, or if one that it has yielded is gone. A glance proves nothing, but each block is in many of
them: a log that shows only later is yielded as after a reorganisation of the blocks from there on.
"""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import aclosing
from dataclasses import dataclass
from functools import cache, partial
from itertools import groupby, pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, TypedDict, TypeVar, get_args

import msgspec
from eth_utils.abi import event_abi_to_log_topic
from msgspec import Struct
from msgspec.structs import replace

from mesh.base.log_context import log_event
from mesh.base.outage_log import OutageLog
from mesh.base.retry import Backoff
from mesh.chain._abi import SpoiledAnswer, decode, load_artifact
from mesh.chain._node import NODE_LIMITS
from mesh.chain.answers import InvalidAnswer
from mesh.chain.errors import ChainWentBack, NoContracts, NodeUnreachable, RequestRefused
from mesh.errors import InputError
from mesh.settings.chains import ANY
from schemas.address import ZERO_ADDRESS, address_bytes
from schemas.cid import format_cid
from schemas.decoding import InvalidData, decode_json
from schemas.errors import InvalidCid

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Collection, Iterable, Mapping, Sequence

    from mesh.chain._contracts import Contracts, ContractVersion
    from mesh.chain._node import Node
    from mesh.chain.answers import BlockHeader, Log
    from mesh.errors import AiraError


E = TypeVar("E")


class NewLiability(Struct, frozen=True, tag=True):
    """A liability was created."""

    liability: str
    tx: str


class Finalized(Struct, frozen=True, tag=True):
    """A liability was finalized. `result` is a CID, empty when it was refunded."""

    liability: str
    success: bool
    result: str
    tx: str


class NewLighthouse(Struct, frozen=True, tag=True):
    """A lighthouse was created; `name` is its label."""

    lighthouse: str
    name: str
    tx: str


class Transfer(Struct, frozen=True, tag=True):
    """Tokens were transferred: XRT (`value` in wn) or the followed token. The zero address mints and burns."""

    sender: str
    recipient: str
    value: int
    tx: str


class Approval(Struct, frozen=True, tag=True):
    """An owner allowed a spender to take up to `value` of its tokens: XRT (wn) or the followed token."""

    owner: str
    spender: str
    value: int
    tx: str


ChainEvent: TypeAlias = NewLiability | Finalized | NewLighthouse | Transfer | Approval

EVENT_CLASSES: Final[Mapping[str, type[ChainEvent]]] = {kind.__name__: kind for kind in get_args(ChainEvent)}


def decode_log(log: Log) -> ChainEvent | None:
    """The event in a log; None for a log of other contracts that only looks similar."""
    layout = _layouts().get(log.topics[0]) if log.topics else None
    if layout is None or len(log.topics) != 1 + len(layout.indexed):
        return None
    try:
        keys = [decode([kind], topic)[0] for kind, topic in zip(layout.indexed, log.topics[1:], strict=True)]
        # The original factory of generation 3 does not pad its string to whole words.
        data = log.data + bytes(-len(log.data) % 32) if layout.plain == ["string"] else log.data
        values = (*keys, *decode(layout.plain, data))
        if layout.event is Finalized:
            success, result = values
            values = success, format_cid(result) if result else ""
    except (SpoiledAnswer, InvalidCid):
        return None
    if layout.event is NewLighthouse and len(values[1]) > 255:  # the original factories take any text as a name
        return None
    emitter = (log.address,) if layout.has_emitter else ()
    event: ChainEvent = layout.event(*emitter, *values, "0x" + log.transaction_hash.hex())
    return event


@cache
def topics_of(*contracts: str) -> tuple[str, ...]:
    """The topics (0x…) of the events of these contracts (keys of `EVENTS`)."""
    names = {name for contract in contracts for name in EVENTS[contract]}
    return tuple("0x" + topic.hex() for topic, layout in _layouts().items() if layout.event.__name__ in names)


def first_event(logs: Iterable[Log], kind: type[E], *, emitter: str = "") -> E:
    """What a transaction created, by its logs: those of one contract, as others, such as tokens, may log the same.

    Raises `InvalidAnswer` if they don't say it.
    """
    for log in logs:
        event = decode_log(log) if emitter in ("", log.address) else None
        if isinstance(event, kind):
            return event
    raise InvalidAnswer("the transaction", f"no event {kind.__name__} is in its receipt")


def xrt_minted(logs: Iterable[Log], *, xrt: str, account: str) -> int:
    """The XRT (wn) that a transaction minted for an account. Other tokens may log the same event."""
    transfers = (decode_log(log) for log in logs if log.address == xrt)
    return sum(
        transfer.value
        for transfer in transfers
        if isinstance(transfer, Transfer) and (transfer.sender, transfer.recipient) == (ZERO_ADDRESS, account)
    )


EVENTS: Final = {
    "Factory": ("NewLiability", "NewLighthouse"),
    "Liability": ("Finalized",),
    "XRT": ("Transfer", "Approval"),
}


class _Layout(NamedTuple):
    """How a contract logs an event: the types of its indexed members and of the others."""

    event: type[Any]
    """One of `EVENT_CLASSES`."""
    has_emitter: bool
    """Whether the event begins with the contract that logged it."""
    indexed: list[str]
    plain: list[str]


@cache
def _layouts() -> dict[bytes, _Layout]:
    """Those of `EVENTS`, by topic."""
    layouts = {}
    for contract, names in EVENTS.items():
        logged = {entry["name"]: entry for entry in load_artifact(contract).abi if entry["type"] == "event"}
        for name in names:
            layouts[event_abi_to_log_topic(logged[name])] = _Layout(
                EVENT_CLASSES[name],
                contract == "Liability",
                [member["type"] for member in logged[name]["inputs"] if member["indexed"]],
                [member["type"] for member in logged[name]["inputs"] if not member["indexed"]],
            )
    return layouts


class FollowLimits(NamedTuple):
    """How the blocks up to the head are read."""

    recent: int = 256
    """Blocks that are read one by one, by their hashes; a machine of the node may lack them."""
    asked: int = 3
    """How often the logs of a range of older ones are asked for."""


FOLLOW_LIMITS: Final = FollowLimits()


class SeenBlock(Struct, frozen=True):
    """A block that was read: its number, its hash (32 bytes) and its events, in order."""

    block_number: int
    block_hash: bytes
    events: tuple[ChainEvent, ...]


class ReplacedWhileReading(Exception):
    """The chain was reorganised between two requests: the answers don't belong together."""


Choose: TypeAlias = "Callable[[Sequence[str], Sequence[str]], Awaitable[Collection[str]]]"
"""Returns, of the liabilities (addresses) that were created and of those that ended, the ones whose events are read."""

Glance: TypeAlias = "Callable[[int, int], Awaitable[Sequence[Log]]]"
"""The logs of a range that may be events, from one block to another, both included."""

DecodedLog: TypeAlias = "tuple[Log, ChainEvent | None]"
"""A log and its event, if it is one of the contracts'."""

ReadRange: TypeAlias = "Callable[[int, int, BlockHeader | None], Awaitable[list[SeenBlock]]]"
"""Reads the blocks from one to another, both included, as `read_events` does; of a single block it gets the header."""


class Selection(TypedDict, total=False):
    """Which events are read, by default all."""

    token: str
    """The address of the token whose transfers and approvals are read; XRT by default."""
    parties: Collection[str]
    """Addresses: transfers and approvals are read that concern one of them."""
    choose: Choose | None
    """Which liabilities' events are read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EventSources:
    """The contracts whose events are read: the factory, a token (empty: none), and the factory's liabilities.

    The token's transfers and approvals are those that concern `parties` (addresses), or all.
    """

    factory: str
    token: str
    parties: frozenset[str] | None = None
    choose: Choose | None = None
    """Which liabilities' events are read; those of all by default."""
    version: ContractVersion
    """Told each liability that the factory's events name, before it is asked about its events."""

    @classmethod
    def of(cls, contracts: Contracts, selection: Selection) -> EventSources:
        """Those of a generation's contracts."""
        return cls(
            factory=contracts.factory,
            token=selection.get("token") or contracts.xrt,
            parties=frozenset(selection["parties"]) if "parties" in selection else None,
            choose=selection.get("choose"),
            version=contracts.version,
        )

    @property
    def named(self) -> list[tuple[str, str]]:
        """The contracts but for the liabilities: their addresses, and their names in `EVENTS`."""
        return [(self.factory, "Factory"), *([(self.token, "XRT")] if self.token else [])]

    def logs_in(self, header: BlockHeader | None) -> bool:
        """Whether a block may hold a log of the named contracts; with None, it is not known."""
        if header is None:
            return True
        wanted: list[tuple[bytes, ...]] = []
        for address, contract in self.named:
            of_contract = [(address_bytes(address), topic) for topic in _topics(contract)]
            if contract == "XRT" and self.parties is not None:
                parties = [bytes(12) + address_bytes(party) for party in self.parties]
                wanted += ((*one, party) for one in of_contract for party in parties)
            else:
                wanted += of_contract
        return header.may_log(*wanted)

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
        self._most = self._span = node.profile.log_range
        """Blocks in one request: halved each time a node refuses, and grown by a quarter each time it answers."""

    async def read_to(self, first: int, head: BlockHeader) -> AsyncGenerator[SeenBlock, None]:
        """The blocks with events from `first` to the head, and the last block of each request.

        The hash of an older block without events is empty. Raises `NodeUnreachable`, `RequestRefused`,
        `ReplacedWhileReading`.
        """
        while first <= head.number:
            last = min(head.number - FOLLOW_LIMITS.recent, first + self._span - 1)
            if last <= first:
                last = min(head.number, first + NODE_LIMITS.requests - 1)
                async with aclosing(self._read_singly(first, last, head)) as singles:
                    async for block in singles:
                        yield block
                first = last + 1
                continue
            try:
                blocks = await self._read(first, last, None)
            except (RequestRefused, NodeUnreachable) as error:
                if isinstance(error, NodeUnreachable):
                    # A node may drop the connection because the range is long; one that is gone raises again here.
                    await self._node.block_number()
                self._span = (last - first + 1) // 2
                continue
            # If the node only claims to have that head, reading towards it would never end.
            await self._node.block_hash(last)
            await self._check_head(head)
            for block in blocks:
                yield block
            first = last + 1
            self._span = min(self._most, self._span + max(1, self._span // 4))

    async def _read_singly(self, first: int, last: int, head: BlockHeader) -> AsyncGenerator[SeenBlock, None]:
        """The blocks with events from `first` to `last`, at most `NODE_LIMITS.requests` of them, and `last` itself."""
        found = await asyncio.gather(*map(self._node.header, range(first, min(last + 1, head.number))))
        headers = [header for header in found if header is not None]
        if len(headers) != len(found):
            raise NodeUnreachable(self._node.endpoint, f"it lacks a block before {last + 1}")
        if last == head.number:
            headers.append(head)
        else:
            await self._check_head(head)
        # The first block is never replaced, but anvil makes it anew when it loads a chain from a file.
        if any(later.parent_hash != earlier.hash for earlier, later in pairwise(headers) if earlier.number):
            raise ReplacedWhileReading
        for header in headers:
            for block in await self._read(header.number, header.number, header):
                if block.events or header.number == last:
                    yield replace(block, block_hash=header.hash)

    async def _check_head(self, head: BlockHeader) -> None:
        """Raise `ReplacedWhileReading` if the answers may be of blocks that were replaced, or of both."""
        if await self._node.block_hash(head.number) != head.hash:
            raise ReplacedWhileReading


async def read_events(
    node: Node, sources: EventSources, first: int, last: int, header: BlockHeader | None
) -> list[SeenBlock]:
    """The blocks with events from `first` to `last`, both included, and `last` itself.

    With the `header` of a single block, the node is asked only for logs that the block may hold. Raises
    `ReplacedWhileReading` when the logs of a block are of two different blocks.
    """
    logs: list[Log] = []
    if sources.logs_in(header):
        addresses, contracts = zip(*sources.named, strict=True)
        logs = await _logs(node, first, last, header, addresses, topics_of(*contracts))
    decoded = [(log, decode_log(log)) for log in logs]
    for log, event in decoded:
        if isinstance(event, NewLiability) and log.address == sources.factory:
            sources.version.recognise(event.liability)
    endings: list[Log] = []
    if header is None or header.may_log(_topics("Liability")):
        endings = await _logs(node, first, last, header, (), topics_of("Liability"))
    # Any contract can log the same event, and as often as it likes.
    newest = max(last, node.heads.latest.number if node.heads.latest else 0)  # the state of old blocks may be gone
    ours = await sources.version.recognised({log.address for log in endings}, newest) if endings else ()
    decoded += [(log, decode_log(log)) for log in endings if log.address in ours]
    return _by_block(await sources.chosen(decoded), last)


async def glance(node: Node, sources: EventSources, first: int, last: int) -> list[Log]:
    """The logs from block `first` to `last` that may be events which are read, with those of their `parties` only.

    Each range is asked for once, so a machine of the node that is behind may leave some out.
    """
    contracts = ["Liability", *(contract for _, contract in sources.named if contract != "XRT")]
    asked = [node.logs(first, last, addresses=(), topics=topics_of(*contracts))]
    for party in (sources.parties or ()) if sources.token else ():
        for place in (1, 2):
            token = node.logs(first, last, addresses=[sources.token], topics=topics_of("XRT"), about=party, place=place)
            asked.append(token)
    return [log for answer in await asyncio.gather(*asked) for log in answer]


async def _logs(
    node: Node, first: int, last: int, header: BlockHeader | None, addresses: Collection[str], topics: Sequence[str]
) -> list[Log]:
    if header is not None:
        return await node.block_logs(header, addresses=addresses, topics=topics)
    asked = [node.logs(first, last, addresses=addresses, topics=topics) for _ in range(FOLLOW_LIMITS.asked)]
    most: list[Log] = []
    for answer in await asyncio.gather(*asked, return_exceptions=True):
        if isinstance(answer, BaseException):
            raise answer
        most = max(most, answer, key=len)
    return most


async def read_created(node: Node, factory: str, first: int, last: int, header: BlockHeader | None) -> list[SeenBlock]:
    """The same with the events of the factory only."""
    if header is not None and not header.may_log(*((address_bytes(factory), topic) for topic in _topics("Factory"))):
        return _by_block((), last)
    logs = await _logs(node, first, last, header, [factory], topics_of("Factory"))
    return _by_block(((log, decode_log(log)) for log in logs), last)


async def list_created(node: Node, factory: str, from_block: int) -> list[NewLiability | NewLighthouse]:
    """What the factory created from a block to the latest one. Raises `NodeUnreachable`, `RequestRefused`."""
    blocks = await list_blocks(node, partial(read_created, node, factory), from_block)
    events = [event for block in blocks for event in block.events]
    return [event for event in events if isinstance(event, NewLiability | NewLighthouse)]


async def list_blocks(node: Node, read: ReadRange, from_block: int, to_block: int | None = None) -> list[SeenBlock]:
    """The blocks that `read` finds events in, from one block to another (by default the latest), in order.

    Raises `NodeUnreachable`, `RequestRefused`.
    """
    for _ in range(5):  # they may be replaced meanwhile
        ranges = RangeReader(node, read)
        head = await node.heads.look() if to_block is None else await node.header(to_block)
        if head is None:
            raise NodeUnreachable(node.endpoint, f"it lacks block {to_block}")
        try:
            async with aclosing(ranges.read_to(from_block, head)) as blocks:
                found = [block async for block in blocks if block.events]
            if await node.block_hash(head.number) != head.hash:
                raise ReplacedWhileReading
        except ReplacedWhileReading:
            await asyncio.sleep(node.timing.poll_interval)
        else:
            return found
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


log = logging.getLogger(__name__)

T = TypeVar("T")

NODE_ERRORS: Final = (NodeUnreachable, RequestRefused)
"""A node that is gone, or that can't answer for now."""

READ_ERRORS: Final = (*NODE_ERRORS, NoContracts)
"""A node that is behind the one that was asked before also lacks its newest contracts."""


class FollowPace(NamedTuple):
    """The times of following, in seconds."""

    told: float = 10.0
    """Between two log lines that say how far a long catching up has come."""
    quick: float = 1.0
    """Between two blocks of a chain, by its profile, below which not each block is read."""
    glance: float = 30.0
    """How far each look glances back there."""
    replaced: float = 10.0
    """Between two looks there for replaced blocks without events; for those with events it looks each time."""


FOLLOW_PACE: Final = FollowPace()


@dataclass(frozen=True, slots=True)
class BlockEvents:
    """The events of a block, in order. Everything up to `block_number` has been read: the next cursor is one more."""

    block_number: int
    events: tuple[ChainEvent, ...]


@dataclass(frozen=True, slots=True)
class Reorganisation(BlockEvents):
    """The chain replaced all blocks after `block_number`; `reverted_events`, the newest first, did not happen.

    `events` is empty. The blocks that replace the old ones are yielded next.
    """

    reverted_events: tuple[ChainEvent, ...] = ()


class History:
    """The last blocks that `follow` yielded, back to `depth` blocks behind the newest.

    It holds every block with events, and the newest one without. One more block is kept below the depth: what a
    reorganisation of the whole depth goes back to.
    """

    def __init__(self, depth: int = ANY.reorg_depth) -> None:
        self.depth = depth
        self._blocks: list[SeenBlock] = []

    @property
    def blocks(self) -> tuple[SeenBlock, ...]:
        """The remembered blocks, the oldest first."""
        return tuple(self._blocks)

    def remember(self, block: SeenBlock) -> None:
        """Add a block, unless it is not newer than the others, and forget those that are now too old."""
        if self._blocks and block.block_number <= self._blocks[-1].block_number:
            return
        self._blocks.append(block)
        oldest = block.block_number - self.depth
        while len(self._blocks) > 1 and self._blocks[1].block_number <= oldest:
            del self._blocks[0]

    def forget_above(self, block_number: int) -> tuple[ChainEvent, ...]:
        """Forget the blocks above a number; their events, the newest first."""
        gone = [block for block in self._blocks if block.block_number > block_number]
        del self._blocks[len(self._blocks) - len(gone) :]
        return tuple(event for block in reversed(gone) for event in reversed(block.events))

    def encode(self) -> bytes:
        """The history as JSON."""
        return msgspec.json.encode((self.depth, self._blocks))

    @classmethod
    def decode(cls, data: bytes) -> History:
        """The history that `encode` returned as `data`. Raises `InputError` for anything else."""
        try:
            depth, blocks = decode_json(data, tuple[int, list[SeenBlock]])
        except InvalidData as error:
            raise InputError(f"this is not a chain history ({error})", hint="start with an empty one") from None
        history = cls(depth)
        for block in blocks:
            history.remember(block)
        return history


async def history_at(node: Node, block_number: int) -> History:
    """The history of a consumer that has read nothing yet and begins after a block: `follow` notices its replacement.

    It holds that block and earlier ones, at twice the distance each time and at last a whole depth below it. If blocks
    are replaced, reading goes back to the newest of these that was not. Raises `NodeUnreachable` if the node lacks one.
    """
    history = History(node.timing.reorg_depth)
    distances = [0, *(1 << power for power in range(history.depth.bit_length())), history.depth]
    numbers = sorted({block_number - min(distance, history.depth, block_number) for distance in distances})
    for number, block_hash in zip(numbers, await asyncio.gather(*map(node.block_hash, numbers)), strict=True):
        history.remember(SeenBlock(number, block_hash, ()))
    return history


async def follow(
    node: Node,
    read: ReadRange,
    cursor: int,
    *,
    look: Glance | None = None,
    history: History | None = None,
    outages: OutageLog | None = None,
) -> AsyncGenerator[BlockEvents, None]:
    """The events from the block `cursor` on, as `read` finds them, without end; see the module.

    `look` glances at a range where blocks are quick; without it each block is read there, too. Raises `ChainWentBack`.
    Other failures of the node are retried and logged to `outages`.
    """
    follower = _Follower(node, read, cursor, history or History(node.timing.reorg_depth), look)
    outages = outages or OutageLog(log, "chain")
    backoff = Backoff(node.timing.outage_retry)
    lagging = 0
    while True:
        try:
            async with aclosing(follower.read_to_head()) as blocks:
                async for block in blocks:
                    outages.recovered(f"the chain can be read again, from block {block.block_number}")
                    backoff.reset()
                    lagging = 0
                    yield block
        except READ_ERRORS as error:
            follower.must_check_cursor = True
            if lagging < 3 and not outages.is_down and await _answers(node):
                lagging += 1  # one of the node's machines may be a block behind
                await asyncio.sleep(node.timing.poll_interval)
                continue
            outages.failed(error, f"the chain can't be read on from block {follower.cursor}, trying again")
            await backoff.wait()
        else:
            outages.recovered(f"the chain can be read again, from block {follower.cursor}")
            backoff.reset()
            lagging = 0


async def _answers(node: Node) -> bool:
    """Whether the node answers at all, so that what failed may only be one of its machines that is behind."""
    try:
        await node.block_number()
    except NODE_ERRORS:
        return False
    return True


async def retrying(
    node: Node,
    question: Callable[[], Awaitable[T]],
    *,
    outages: OutageLog | None = None,
    errors: tuple[type[AiraError], ...] = NODE_ERRORS,
) -> T:
    """The answer to a question to the node, asked again after each of `errors` with `Timing.outage_retry`.

    The outage is logged to `outages`. Other errors are raised.
    """
    outages = outages or OutageLog(log, "chain")
    backoff = Backoff(node.timing.outage_retry)
    while True:
        try:
            answer = await question()
        except errors as error:
            outages.failed(error, "the chain can't be read, trying again")
            await backoff.wait()
        else:
            outages.recovered("the chain can be read again")
            return answer


class _Follower:
    """The state of one `follow`: its cursor and its history."""

    def __init__(self, node: Node, read: ReadRange, cursor: int, history: History, look: Glance | None) -> None:
        self.cursor = cursor
        self.must_check_cursor = True
        self._seen = b""
        """The hash of the head that was read last."""
        self._node = node
        self._history = history
        self._read, self._look = read, look
        self._ranges = RangeReader(node, self._read_block)
        self._first = cursor
        """The first block that is read here."""
        pace, depth = node.profile.block_seconds, min(history.depth, FOLLOW_LIMITS.recent)
        is_quick = look is not None and pace < FOLLOW_PACE.quick
        self._window = min(depth, round(FOLLOW_PACE.glance / pace)) if is_quick else 0
        """Blocks up to the head that are glanced at; 0 if each is read."""
        self._proven: dict[int, bytes] = {}
        """The hashes of blocks among these that were read one by one, by their numbers."""
        self._check_at = float("-inf")

    async def _read_block(self, first: int, last: int, header: BlockHeader | None) -> list[SeenBlock]:
        blocks = await self._read(first, last, header)
        if header is not None and self._window:
            self._proven[first] = header.hash
        return blocks

    async def read_to_head(self) -> AsyncGenerator[BlockEvents, None]:
        """Wait for a new head, and read to it: first what the chain has replaced, then the new blocks."""
        head = await (self._node.heads.look() if self.must_check_cursor else self._node.heads.next(self._seen))
        self._seen = head.hash
        news: int | None = self.cursor
        if self.must_check_cursor:
            await self._check_cursor(head)
            self.must_check_cursor = False
        elif 0 <= head.number - self.cursor < self._window:
            news = await self._first_news(head)
        replaced = None
        if news is not None or time.monotonic() >= self._check_at:
            self._check_at = time.monotonic() + FOLLOW_PACE.replaced
            replaced = await self._find_replaced(head)
        if replaced is None and news is None:
            self._history.remember(SeenBlock(head.number, head.hash, ()))
            self.cursor = head.number + 1
            yield BlockEvents(head.number, ())
            return
        if replaced is None and news is not None and news < self.cursor:
            replaced = Reorganisation(news - 1, (), self._history.forget_above(news - 1))
        if replaced is not None:
            self.cursor = min(self.cursor, replaced.block_number + 1)
            yield replaced
        if not self._history.blocks and 0 < self.cursor <= head.number + 1:
            for block in (await history_at(self._node, self.cursor - 1)).blocks:
                self._history.remember(block)
        told = time.monotonic()
        try:
            async with aclosing(self._ranges.read_to(self.cursor, head)) as blocks:
                async for block in blocks:
                    if block.block_hash:
                        self._history.remember(block)
                    self.cursor = block.block_number + 1
                    if head.number > block.block_number and time.monotonic() - told >= FOLLOW_PACE.told:
                        told = time.monotonic()
                        facts = log_event("chain-catching-up", block=block.block_number, head=head.number)
                        log.info("catching up: read to block %d of %d", block.block_number, head.number, extra=facts)
                    yield BlockEvents(block.block_number, block.events)
        except ReplacedWhileReading:
            self.must_check_cursor = True  # the next call finds what was replaced
            await asyncio.sleep(self._node.timing.poll_interval)

    async def _first_news(self, head: BlockHeader) -> int | None:
        """The block from which to read on one by one: the first with a log that was not read so, or the next one.

        None if there is none, and all that was yielded is still there. What shows before the next block was left out
        by a machine that was behind.
        """
        assert self._look is not None
        first = max(self._first, head.number - self._window + 1)
        self._proven = {number: found for number, found in self._proven.items() if number >= first}
        try:
            logs = await self._look(first, head.number)
        except RequestRefused as refused:
            log.debug("blocks are read one by one: %s", refused)
            self._window = 0
            return self.cursor
        there = {(one.block_number, one.block_hash) for one in logs}
        if any(
            one.events and one.block_number >= first and (one.block_number, one.block_hash) not in there
            for one in self._history.blocks
        ):
            return self.cursor  # it was replaced, or another machine answers
        return min((number for number, found in there if self._proven.get(number) != found), default=None)

    async def _check_cursor(self, head: BlockHeader) -> None:
        """Raise `ChainWentBack` if the cursor is past the head, unless the node is a few blocks behind another."""
        if self.cursor <= head.number + 1:
            return
        if self.cursor - 1 - head.number <= self._history.depth:
            for block in reversed(self._history.blocks):
                if block.block_number <= head.number and await self._is_on_chain(block, head):
                    return
        raise ChainWentBack(self.cursor, head.number)

    async def _find_replaced(self, head: BlockHeader) -> Reorganisation | None:
        """What the chain has replaced of the history; None if it only grew, or is shorter. Raises as `follow` does."""
        known = [block for block in self._history.blocks if block.block_number <= head.number]
        for block in reversed(known):
            if await self._is_on_chain(block, head):
                if block is known[-1]:
                    return None
                return Reorganisation(block.block_number, (), self._history.forget_above(block.block_number))
        if known:
            raise ChainWentBack(known[0].block_number, head.number, is_final=True)
        return None

    async def _is_on_chain(self, block: SeenBlock, head: BlockHeader) -> bool:
        """Whether the chain that ends at `head` has the block."""
        if block.block_number == head.number:
            return block.block_hash == head.hash
        if block.block_number == head.number - 1:
            return block.block_hash == head.parent_hash
        return await self._node.block_hash(block.block_number) == block.block_hash
