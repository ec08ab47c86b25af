"""A connection to an Ethereum node: what is the same whatever contracts the chain holds; and what its operator decides:
how long to wait for the chain (`Timing`), and how much to pay for gas (`FeePolicy`, EIP-1559).

**The latest block** is looked for once for all who wait (`Heads`): pushed by the node, or polled when it is expected.
Where blocks come at a steady pace that is slower than the poll interval (a slot every 12 s), the next one is looked for
when it is due. The pace is that of the blocks' timestamps; when a block of some timestamp is there, by our clock, is
learned: a look that finds the block makes the next one a little earlier, a look that comes too soon makes it later.
Everywhere else, and until the pace is known, the node is asked each poll interval.

**Many functions of contracts** are read in one call: the node runs code that is never deployed, the constructor of
`contracts/src/Multicall.sol`, which makes the calls and returns the answers instead of code. What a node does not
answer that way is asked one by one.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

from mesh.base.log_context import log_event
from mesh.base.retry import RetryPolicy
from mesh.chain._abi import ContractFunctions, SpoiledAnswer, decode, encode, load_artifact, our_functions
from mesh.chain._pending import PendingTransactions, TransactionCounts, TransactionStore
from mesh.chain.answers import (
    ANSWERS,
    BEHIND,
    BlockBody,
    BlockHeader,
    BlockReceipt,
    InvalidAnswer,
)
from mesh.chain.errors import (
    METHOD_NOT_FOUND,
    FeeTooHigh,
    FinalityNotOffered,
    NoContracts,
    NodeUnreachable,
    RequestRefused,
    Reverted,
    WrongChain,
)
from mesh.chain.rpc import RpcClient, is_answered
from mesh.errors import ClosedError, ConfigurationError
from mesh.settings.chains import ANY, ETHEREUM_SECONDS
from schemas import keccak256
from schemas.address import address_bytes

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping, Sequence
    from pathlib import Path
    from typing import Self

    from mesh.chain._abi import ContractCall
    from mesh.chain.answers import Log, MinedTransaction
    from mesh.chain.rpc import Endpoint
    from mesh.errors import AiraError
    from mesh.settings.chains import ChainProfile
    from mesh.telemetry.metrics import MetricFamily

    Call: TypeAlias = tuple[str, bytes]
    "An address and data."


Finality: TypeAlias = Literal["latest", "safe", "finalized"]

GWEI: Final = 10**9
"""Wei."""


class PriceBump(NamedTuple):
    """By how many percent both prices are raised to let a transaction take another's place."""

    wanted: int = 10
    """What nodes want at least (geth's `pricebump`)."""
    offered: int = 15
    """What is offered, at least, where the ceiling allows it."""


PRICE_BUMP: Final = PriceBump()


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Waiting times, in seconds unless said otherwise."""

    poll_interval: float = 1.0
    """Between two looks for a new block, where blocks don't come at a slower pace."""
    receipt_interval: float = 0.1
    """Before the second look for a transaction's receipt, where blocks don't come at a known pace; the others follow
    each new block."""
    receipt_timeout: float = 180.0
    """How long a sent transaction is waited for."""
    confirmations: int = 1
    """Blocks, not seconds: how many a transaction needs, its own included, to count as mined."""
    finality: Finality = "latest"
    """Which blocks count where others may still take something back: those with `confirmations`, or those that the
    node calls safe or finalized. For one's own transactions it is the confirmations that count."""
    replace_after: float = 30.0
    """After how long a transaction that is not mined is sent again with higher fees, each time."""
    repeat_within: float = 600.0
    """How long after a transaction with an unknown outcome the same transaction means that one, if it was mined."""
    metrics_age: float = 10.0
    """How old a metric that comes from the node may be."""
    validator_recheck: float = 60.0
    """How long an answer about a validator is trusted while a transaction can still change it."""
    request_timeout: float = 15.0
    """For one answer of the node."""
    first_timeout: float = 3.0
    """For the answers of a server that has not answered yet as a node does; it gets only one attempt to answer."""
    attempts: int = 4
    """How often a request is made before the node counts as unreachable."""
    retry_delay: float = 0.25
    """Before the second attempt; doubled before each further one."""
    reorg_depth: int = ANY.reorg_depth
    """Blocks, not seconds: how far behind the head replaced blocks are noticed."""

    @property
    def request_retry(self) -> RetryPolicy:
        """For one request, after which the node counts as unreachable."""
        return RetryPolicy(initial=self.retry_delay, ceiling=max(60.0, self.retry_delay), attempts=self.attempts)

    @property
    def outage_retry(self) -> RetryPolicy:
        """For a node that is unreachable: from `poll_interval` to ten times as long, without end."""
        return RetryPolicy(initial=self.poll_interval, ceiling=10 * self.poll_interval)


class Fees(NamedTuple):
    """Prices of a unit of gas, in wei (EIP-1559); without `priority`, the one price of a chain without a base fee."""

    maximum: int
    priority: int | None

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> Fees:
        """The prices in a transaction's fields."""
        if "gasPrice" in fields:
            return cls(fields["gasPrice"], None)
        return cls(fields["maxFeePerGas"], fields["maxPriorityFeePerGas"])

    def fields(self) -> dict[str, int]:
        """The transaction's fields."""
        if self.priority is None:
            return {"gasPrice": self.maximum}
        return {"type": 2, "maxFeePerGas": self.maximum, "maxPriorityFeePerGas": self.priority}


class GasMarket(NamedTuple):
    """The price of a unit of gas now, in wei, and fees that leave room for the base fee to double."""

    price: int
    fees: Fees


@dataclass(frozen=True, slots=True, kw_only=True)
class FeePolicy:
    """How much an account is ready to pay. Prices are wei for a unit of gas."""

    ceiling: int = 500 * GWEI
    """The most that is ever offered, base fee and priority fee together."""

    def offer(self, market: GasMarket) -> Fees:
        """What a transaction offers, within the ceiling. Raises `FeeTooHigh` for a price above it."""
        if market.price > self.ceiling:
            raise FeeTooHigh(market.price, self.ceiling)
        return Fees(min(market.fees.maximum, self.ceiling), market.fees.priority)

    def replacement(self, market: GasMarket, fees: Fees) -> Fees | None:
        """What the replacement of a stuck transaction with `fees` offers: more, and no less than the market's price.

        None if the ceiling leaves no room for what nodes accept as a replacement.
        """
        offered = market.fees
        maximum = min(self.ceiling, max(offered.maximum, _raised(fees.maximum, PRICE_BUMP.offered)))
        if maximum < _raised(fees.maximum, PRICE_BUMP.wanted):
            return None
        if fees.priority is None:
            return Fees(maximum, None)
        priority = max(offered.priority or 0, _raised(fees.priority, PRICE_BUMP.offered))
        return Fees(maximum, min(priority, maximum))


def _raised(price: int, percent: int) -> int:
    """A price raised by that many percent, rounded up."""
    return price + (price * percent + 99) // 100


class HeadPace(NamedTuple):
    """How it is learned when the next block is due, and when it is looked for."""

    samples: int = 5
    """The latest times between two blocks that are compared."""
    steady: int = 4
    """How many of them must be equal, to within a second: slots may be missed."""
    quickest: int = 2
    """Seconds between two blocks below which there is nothing to gain."""
    earlier: float = 0.005
    """The part of the time between two blocks by which the next look comes earlier after a hit."""
    later: float = 0.05
    """The same for a later look after a miss."""
    longest: float = 0.25
    """The same for the longest pause between two looks for a block that is late."""
    silence: float = 60.0
    """Seconds without a block after which a node that pushes blocks is asked all the same, at the latest."""
    missed: int = 3
    """The same, as a multiple of the longest of the latest times between two blocks."""


HEAD_PACE: Final = HeadPace()


class Pace:
    """When the next block is due, by the timestamps of those before it. Pure: times are passed."""

    def __init__(self, interval: float) -> None:
        self._interval = interval
        self._gaps: deque[int] = deque(maxlen=HEAD_PACE.samples)
        self._offset: float | None = None
        """By our clock: how long after its timestamp a block is there."""
        self._misses = 0

    @property
    def seconds(self) -> int | None:
        """Seconds between two blocks; None where they come irregularly, or faster than is worth waiting for."""
        wanted = HEAD_PACE.steady
        for gap in set(self._gaps):
            steady = sum(abs(gap - other) <= 1 for other in self._gaps)
            if not self._is_quick(gap) and steady >= min(wanted, len(self._gaps)) >= wanted - 1:
                return gap
        return None

    def _is_quick(self, gap: int) -> bool:
        return gap <= max(HEAD_PACE.quickest, self._interval)

    @property
    def is_learned(self) -> bool:
        """Whether it is known when the next block is due."""
        return self.seconds is not None and self._offset is not None

    @property
    def is_sampled(self) -> bool:
        """Whether enough blocks were seen to know."""
        return len(self._gaps) >= HEAD_PACE.steady - 1 or any(map(self._is_quick, self._gaps))

    @property
    def silence(self) -> float:
        """Seconds without a pushed block after which the node is asked all the same."""
        if not self.is_sampled or not self._gaps:
            return HEAD_PACE.silence
        return min(HEAD_PACE.silence, 5.0 + HEAD_PACE.missed * max(self._gaps))

    def add(self, earlier: BlockHeader, later: BlockHeader) -> None:
        """Count the time between two blocks, of which the second follows the first."""
        if later.number == earlier.number + 1:
            self._gaps.append(later.timestamp - earlier.timestamp)

    def found(self, block: BlockHeader, now: float, *, waited: float) -> None:
        """A look found a new block, `waited` seconds after the look before."""
        seconds, delay = self.seconds, now - block.timestamp
        if seconds is None:
            self._offset = None
        elif self._offset is None:
            self._offset = delay if waited <= 2 * self._interval else None
        else:
            self._offset = min(self._offset, delay) - (0 if self._misses else HEAD_PACE.earlier * seconds)
        self._misses = 0

    def missed(self) -> None:
        """A look at the time when a block was due found none."""
        self._misses = min(self._misses + 1, 10)
        if self._misses == 1 and self._offset is not None:
            self._offset += HEAD_PACE.later * (self.seconds or 0)

    def is_early(self, latest: BlockHeader, now: float) -> bool:
        """Whether it is too early for the block after the latest."""
        return self.is_learned and not self._misses and self.pause(latest, now) > 0

    def pause(self, latest: BlockHeader | None, now: float) -> float:
        """Seconds until the next look."""
        seconds = self.seconds
        if latest is None or seconds is None or self._offset is None:
            return self._interval
        if self._misses:
            return min(HEAD_PACE.later * (1 << self._misses - 1), HEAD_PACE.longest) * seconds
        return min(max(latest.timestamp + seconds + self._offset - now, 0.0), float(seconds))


def _now() -> float:
    return asyncio.get_running_loop().time()


class Heads:
    """The latest block: `look` asks for it now, and `next` waits for one that the caller has not seen.

    `ask` asks the node; `header` asks for the block of a number. Both raise the errors of the node, to one of those who
    wait; the others then ask themselves. `request_pushes` asks the node, when somebody waits, to call `pushed`; it is
    called often.
    """

    def __init__(
        self,
        ask: Callable[[], Awaitable[BlockHeader]],
        header: Callable[[int], Awaitable[BlockHeader | None]],
        *,
        interval: float,
        request_pushes: Callable[[], None] = lambda: None,
    ) -> None:
        self.latest: BlockHeader | None = None
        """The latest block that the node has returned or pushed, if any."""
        self.is_pushed = False
        """Whether the node pushes new blocks."""
        self.pace = Pace(interval)
        self._ask = ask
        self._header = header
        self._interval = interval
        self._request_pushes = request_pushes
        self._seen_at = 0.0
        self._expected = 0
        self._measured: BlockHeader | None = None
        self._looking = asyncio.Lock()
        self._news = asyncio.Event()

    @property
    def are_timely(self) -> bool:
        """Whether `next` returns soon after a block is there, so that nothing is gained by asking meanwhile."""
        return self.is_pushed or self.pace.is_learned

    async def look(self) -> BlockHeader:
        """The latest block, asked for now."""
        head = await self._ask()
        self._take(head)
        return head

    async def recent(self) -> BlockHeader:
        """The latest block, as it was a poll interval ago or later; the node is asked only if it is not known."""
        if self.latest is not None:
            now = _now()
            if now - self._seen_at <= self._interval or self.is_pushed or self.pace.is_early(self.latest, now):
                return self.latest
        return await self.look()

    async def block_time(self, blocks: int = 200) -> float | None:
        """Seconds between two of the last `blocks` blocks, measured at times; None if the chain does not tell."""
        last = await self.recent()
        if self._measured is None or not 0 <= last.number - self._measured.number <= 2 * blocks:
            self._measured = await self._header(max(1, last.number - blocks))
        first = self._measured
        if first is None or first.number >= last.number or first.timestamp >= last.timestamp:
            self._measured = None
            return None
        return (last.timestamp - first.timestamp) / (last.number - first.number)

    async def next(self, seen: bytes) -> BlockHeader:
        """The latest block as soon as its hash is not `seen`."""
        while self.latest is None or self.latest.hash == seen:
            async with self._looking:
                if self.latest is None:
                    await self.look()
                elif self.latest.hash == seen:
                    await self._wait_and_look(self.latest)
        return self.latest

    def expect(self, number: int) -> None:
        """The chain has a block of this number, as a receipt says: it is looked for at once if somebody waits."""
        if self.latest is not None and self.latest.number < number:
            self._expected = number
            self._announce()

    def pushed(self, head: BlockHeader | None) -> None:
        """The node has pushed a block; None means that it pushes no more."""
        self.is_pushed = head is not None
        if head is None:
            self._announce()  # who waits for a push looks itself
        else:
            self._take(head)

    def _take(self, head: BlockHeader) -> None:
        before, self.latest, self._seen_at = self.latest, head, _now()
        if before is None or before.hash != head.hash:
            if before is not None and before.hash == head.parent_hash:
                self.pace.add(before, head)
            self._announce()

    def _announce(self) -> None:
        self._news.set()
        self._news = asyncio.Event()

    async def _wait_and_look(self, latest: BlockHeader) -> None:
        """Wait until the next block is due, or pushed; then look for it."""
        self._request_pushes()
        news, is_due, asked_at = self._news, self.pace.is_learned, self._seen_at
        pause = self.pace.silence if self.is_pushed else self.pace.pause(latest, _now())
        if self._expected > latest.number:
            self._expected, pause = 0, 0.0
        with suppress(TimeoutError):
            async with asyncio.timeout(pause):
                await news.wait()
                return
        if not self.pace.is_sampled:
            await self._sample(latest)
        if (head := await self.look()).hash != latest.hash:
            self.pace.found(head, _now(), waited=_now() - asked_at)
        elif is_due:
            self.pace.missed()

    async def _sample(self, later: BlockHeader) -> None:
        """Learn the pace from the blocks before the latest one."""
        while not self.pace.is_sampled and later.number > 0:
            earlier = await self._header(later.number - 1)
            if earlier is None or earlier.hash != later.parent_hash:
                return
            self.pace.add(earlier, later)
            later = earlier


class NodePace(NamedTuple):
    """For how many seconds what the node has said is used, before it is asked again."""

    counting: float = 3600.0
    """Whose blocks contracts count."""
    counting_refused: float = 60.0
    """The same if it did not say."""
    data_fee: float = 60.0
    """What the oracle of a rollup takes for data."""
    no_oracle: float = 600.0
    """That a chain has no such oracle: a node may have answered nothing by mistake."""
    priority_fee: float = 60.0
    """The priority fee that it suggests; the base fee is that of the latest block."""


NODE_PACE: Final = NodePace()

RUN_NUMBER: Final = bytes.fromhex("4360005260206000f3")
"""Creation code that returns the number of the block it runs in, instead of code: NUMBER, then MSTORE and RETURN."""


class ContractBlocks:
    """How far blocks have come by the count of contracts, their `block.number`: deadlines, refunds and turns go by it.

    On most chains that is the number of the block. On Arbitrum it is about that of Ethereum's latest block: far from
    the chain's own numbers, the same for many blocks, and then one or several more. So the node is asked to run NUMBER,
    in code that is never deployed, which sees what contracts of any kind see: once, and again rarely, where both are
    the same; elsewhere each `interval` (seconds) at most. `run` runs it at a block; `heads` are the chain's own.
    """

    def __init__(self, heads: Heads, run: Callable[[int | str], Awaitable[int | None]], *, interval: float) -> None:
        self._heads = heads
        self._run = run
        self._interval = interval
        self._are_own = True
        self._check_at = float("-inf")
        self._seen = 0
        self._ask_at = float("-inf")
        self._asking = asyncio.Lock()

    async def last(self, head: int) -> int:
        """The contracts' number of the latest block, by which those after it are higher; `head` is the chain's own.

        Where contracts count other blocks, it is one below the number that they see now: the next transaction may see
        the same again.
        """
        return head if await self.are_own() else await self._ask()

    async def seconds(self, blocks: int) -> float | None:
        """Seconds between two of the blocks that contracts count, by the last `blocks`; None if it is not known."""
        return await self._heads.block_time(blocks) if await self.are_own() else ETHEREUM_SECONDS

    async def are_own(self) -> bool:
        """Whether contracts count the chain's own blocks."""
        if _now() >= self._check_at:
            async with self._asking:
                if _now() >= self._check_at:
                    await self._check()
        return self._are_own

    async def _check(self) -> None:
        head = (await self._heads.recent()).number
        number = await self._run(head)
        if number is not None:
            self._are_own = number in (head, head + 1)  # some nodes run calls in the block after
        self._check_at = _now() + (NODE_PACE.counting_refused if number is None else NODE_PACE.counting)

    async def _ask(self) -> int:
        async with self._asking:
            if _now() >= self._ask_at:
                number = await self._run("latest")
                self._seen = max(self._seen, (number or 0) - 1)  # another machine of the node may be behind
                self._ask_at = _now() + self._interval
        return self._seen


FEE_ORACLE: Final = "0x420000000000000000000000000000000000000F"
"""Where each OP-type rollup has its contract `GasPriceOracle`."""
GET_L1_FEE: Final = bytes.fromhex("49948e0e")
"""Selector of its `getL1Fee(bytes)`: what a transaction with these bytes, unsigned, pays for its data, wei."""
FEE_SAMPLE: Final = b"".join([keccak256(bytes([number])) for number in range(32)])
"""Bytes that can't be compressed: what the oracle is asked about."""


class DataFees:
    """What a rollup of the OP type charges for the data of transactions, which it brings to Ethereum, beside their gas.

    Its oracle is asked once a minute at most, or once in ten where it has never answered. What is charged goes by the
    compressed length, to which zeros add nothing, so each other byte costs about the same. `call` calls it.
    """

    def __init__(self, call: Callable[[bytes], Awaitable[bytes | None]]) -> None:
        self._call = call
        self._per_byte = 0.0
        self._until = float("-inf")

    async def of(self, data: bytes) -> int:
        """What a transaction with this data is charged now, about; 0 elsewhere, wei."""
        now = _now()
        if now >= self._until:
            answer = await self._call(GET_L1_FEE + encode(["bytes"], [FEE_SAMPLE]))
            if answer is not None and len(answer) == 32:
                self._per_byte = int.from_bytes(answer) / len(FEE_SAMPLE)
            has_oracle = self._per_byte or answer != b""
            self._until = now + (NODE_PACE.data_fee if has_oracle else NODE_PACE.no_oracle)
        other_fields = 64  # bytes, about: number, fees, gas, recipient
        return round(self._per_byte * (len(data) - data.count(0) + other_fields))


log = logging.getLogger(__name__)


class NodeLimits(NamedTuple):
    """How much a node is asked at once, and how often the same."""

    requests: int = 32
    """For blocks or receipts, at the same time."""
    calls: int = 100
    """In one call: the creation code has 49,152 bytes at most (EIP-3860), and what it returns 24,576 (EIP-170)."""
    reads: int = 3
    """How often a contract's function is called while what it returns does not decode."""
    refusals: int = 5
    """Of `eth_getLogs` for blocks whose receipts the node has, after which only receipts are asked for."""
    doubts: int = 8
    """Empty answers for a block, against its Bloom filter and without receipts, of which the last one is believed."""


NODE_LIMITS: Final = NodeLimits()


def getters(contract: str, address: str, names: Iterable[str]) -> list[ContractCall]:
    """Calls of the getters `names` at an address that holds one of our contracts (`artifacts.NAMES`)."""
    functions = our_functions(contract)
    return [functions[name].at(address) for name in names]


def _values(call: ContractCall, returned: bytes | None) -> Any:
    """What a contract's function returned, several values as a tuple. Raises `SpoiledAnswer`."""
    if returned is None:
        raise SpoiledAnswer(f"{call.fn_name} failed")
    values = decode(call.outputs, returned)
    return values[0] if len(values) == 1 else values


def encode_calls(calls: Sequence[Call], *, gas: int, most: int) -> bytes:
    """The creation code that makes the calls, each with at most `gas`, for at most `most` bytes of its answer."""
    packed = b"".join([bytes.fromhex(to[2:]) + len(data).to_bytes(2) + data for to, data in calls])
    words = b"".join([number.to_bytes(32) for number in (gas, most, 96, len(packed))])  # 96: where the length is
    return load_artifact("Multicall").bytecode + words + packed + bytes(-len(packed) % 32)


def decode_answers(returned: bytes, *, number: int) -> list[bytes | None]:
    """What a number of calls returned, or None for those that failed. Raises `SpoiledAnswer`."""
    answers: list[bytes | None] = []
    at = 0
    while at < len(returned):
        data = at + 3
        end = data + int.from_bytes(returned[at + 1 : data])
        if end > len(returned) or returned[at] > 1:
            raise SpoiledAnswer("the answers to many calls are cut off")
        answers.append(returned[data:end] if returned[at] else None)
        at = end
    if len(answers) != number:
        raise SpoiledAnswer(f"there are {len(answers)} answers to {number} calls")
    return answers


class Node:
    """A node reached at `endpoint`: `http(s)://…`, `ws(s)://…` or a `Transport` (which stays open).

    Several endpoints (a sequence, or one text with commas) are nodes of one chain: when one does not answer, the next
    is asked, and stays in use until it fails in turn.

    `profile` is the chain that it must be of, by default any. `fees` is what its accounts pay at most. Transactions are
    recorded in the folder `transactions`, if given: then several processes of one account never use the same nonce, and
    one that is restarted continues what it began.

    Used with `async with`, which connects: raises `NodeUnreachable` when nobody answers, `ConfigurationError` when one
    of several is on another chain, `WrongChain` when all are, and `FinalityNotOffered` when they don't say which blocks
    are final although the timing wants that. Creating it raises `ConfigurationError` for what is no endpoint. Its
    methods raise `NodeUnreachable` when the node is lost, after bounded retries, and `RequestRefused`.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        *,
        timing: Timing | None = None,
        fees: FeePolicy | None = None,
        transactions: Path | None = None,
        profile: ChainProfile = ANY,
    ) -> None:
        self.profile = profile
        self.timing = timing or Timing()
        self.fees = fees or FeePolicy()
        self.sent = TransactionCounts()
        """What was sent through it."""
        self._transactions = transactions
        self._chain_folder: Path | None = None
        self.rpc = RpcClient(
            endpoint,
            retry=self.timing.request_retry,
            timeout=self.timing.request_timeout,
            first_timeout=self.timing.first_timeout,
        )
        """The requests to the node."""
        self.heads = Heads(
            self._ask_latest, self.header, interval=self.timing.poll_interval, request_pushes=self._request_pushes
        )
        """The latest block, for all who wait for the next one."""
        self.contract_blocks = ContractBlocks(self.heads, self._run_number, interval=self.timing.poll_interval)
        """The blocks as contracts count them."""
        self._data_fees = DataFees(self._ask_fee_oracle)
        self._logs_refused = 0
        self._doubted = b"", 0
        """The block of the last empty answer that could not be proven, and how many there were for it."""
        self._is_doubt_told = False
        self._has_block_receipts = True
        self._has_pending = True
        self._priority = 0.0, 0
        self._final = -1
        """The last block that the node has called final, in the sense of the timing."""
        self._final_until = 0.0
        """Until when it is not asked again, on the monotonic clock."""
        self._chain_id: int | None = None
        self._pending: dict[str, PendingTransactions] = {}

    def families(self) -> tuple[MetricFamily, ...]:
        """The metrics of the transactions that were sent through the node, and of its answers."""
        return (*self.sent.families(), *self.rpc.families())

    @property
    def endpoint(self) -> str:
        """Where the node is, for people to read."""
        return self.rpc.endpoint

    @property
    def chain_id(self) -> int:
        """EIP-155 number of the chain. Raises `ClosedError` before the connection."""
        if self._chain_id is None:
            raise ClosedError("the node is not connected: use it with `async with`")
        return self._chain_id

    async def __aenter__(self) -> Self:
        self._pending.clear()
        self.rpc.open()
        try:
            self._chain_id = int(await self._ask("eth_chainId"))
            await self.rpc.check_chains(self._chain_id)
            if self.profile.chain_id not in (0, self._chain_id):
                raise WrongChain(self.endpoint, self._chain_id, self.profile)
            if self.timing.finality != "latest":
                await self._find_final(self.timing.finality)
            if self._transactions is not None:  # a development chain that was restarted has another first block
                self._chain_folder = self._transactions / f"{self._chain_id}-{(await self.block_hash(0)).hex()[:16]}"
        except BaseException:
            await self.rpc.close()
            raise
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._chain_id = None
        for pending in self._pending.values():
            pending.close()
        await self.rpc.close()

    async def request(self, method: str, *params: Any) -> Any:
        """The result of any JSON-RPC method, as JSON."""
        return await self.rpc.request(method, list(params))

    async def client_version(self) -> str:
        """The name and version of the node's program."""
        return str(await self._ask("web3_clientVersion"))

    async def is_syncing(self) -> bool:
        """Whether the node says that it has not all blocks yet."""
        return bool(await self._ask("eth_syncing"))

    async def block_number(self) -> int:
        """Number of the latest block."""
        return int(await self._ask("eth_blockNumber"))

    async def contract_block(self) -> int:
        """The contracts' number of the latest block, which deadlines and refunds count: see `ContractBlocks.last`."""
        return await self.contract_blocks.last(await self.block_number())

    async def _run_number(self, block: int | str) -> int | None:
        """The number that a contract sees in the state after a block; None if the node does not run such code."""
        try:
            returned = await self.call({"data": "0x" + RUN_NUMBER.hex()}, block=block)
        except (RequestRefused, Reverted) as error:
            log.debug("the number of blocks that contracts see can't be asked: %s", error)
            return None
        return int.from_bytes(returned) if len(returned) == 32 else None  # some ignore code without an address

    async def header(self, block: int | str) -> BlockHeader | None:
        """A block, by its number or `latest`; None if the chain does not have it."""
        header: BlockHeader | None = await self._ask("eth_getBlockByNumber", _block(block), False)
        if header is not None and block not in ("latest", header.number):
            raise InvalidAnswer(f"eth_getBlockByNumber for {block}", f"it is block {header.number}")
        return header

    async def counted(self, head: int) -> int:
        """The last block that counts, of a chain that was read up to block `head`: see `Timing.finality`.

        Below 0 if none does. A node that says what is final is asked at times only. Raises `NodeUnreachable`.
        """
        tag = self.timing.finality
        if tag == "latest":
            return head - self.timing.confirmations + 1
        if self._final < head and time.monotonic() >= self._final_until:
            try:
                await self._find_final(tag)
            except FinalityNotOffered as error:  # it did at the start: one of its machines is behind
                log.debug("%s", error)
        return min(self._final, head)

    async def counts(self, block: int) -> bool:
        """Whether what happened in a block counts. Raises `NodeUnreachable`."""
        return await self.counted((await self.heads.recent()).number) >= block

    async def until_counts(self, block: int) -> None:
        """Return when what happened in a block counts. Raises `NodeUnreachable`."""
        while True:
            if await self.counts(block):
                return
            await asyncio.sleep(self.timing.poll_interval)

    async def _find_final(self, tag: Finality) -> None:
        """Ask for the last block that is final. The further it is behind, the less often it changes."""
        try:
            final: BlockHeader | None = await self._ask("eth_getBlockByNumber", tag, False)
        except (RequestRefused, NodeUnreachable) as error:
            if not is_answered(error):
                raise
            why = error.detail if isinstance(error, RequestRefused) else error.why
            raise FinalityNotOffered(self.endpoint, tag, why) from None
        if final is None:
            raise FinalityNotOffered(self.endpoint, tag, "it answers none")
        behind = (await self.heads.recent()).timestamp - final.timestamp
        pause = max(self.timing.poll_interval, min(behind / 30, HEAD_PACE.silence))
        self._final, self._final_until = max(self._final, final.number), time.monotonic() + pause

    async def _ask_latest(self) -> BlockHeader:
        """A null is asked again like any other spoiled answer: every chain has a latest block."""
        found: BlockHeader = await self.rpc.request("eth_getBlockByNumber", ["latest", False], kind=BlockHeader)
        return found

    async def block_hash(self, number: int) -> bytes:
        """The 32-byte hash of a block. Raises `NodeUnreachable` if the node does not have the block."""
        header: BlockHeader = await self.rpc.request(
            "eth_getBlockByNumber", [hex(number), False], kind=BlockHeader
        )  # not null: another machine, or another node, may have it
        return header.hash

    async def first_block_since(self, time: int) -> int:
        """The number of the first block whose timestamp is `time` (Unix) or later; one after the latest if none is."""
        head = await self.heads.look()
        first, end = 0, head.number + 1
        while first < end:
            middle = (first + end) // 2
            header = await self.header(middle)
            if header is None:
                raise NodeUnreachable(self.endpoint, f"it lacks block {middle}")
            first, end = (middle + 1, end) if header.timestamp < time else (first, middle)
        return first

    async def logs(
        self,
        first: int,
        last: int,
        *,
        addresses: Collection[str],
        topics: Sequence[str],
        about: str = "",
        place: int = 1,
    ) -> list[Log]:
        """The logs of the blocks from `first` to `last`, both included, whose first topic is one of `topics`.

        Those of all contracts, unless `addresses` are given; with `about`, those whose topic in that `place` is this
        address.
        """
        query: dict[str, Any] = {"fromBlock": hex(first), "toBlock": hex(last), "topics": [list(topics)]}
        if about:
            query["topics"] += [None] * (place - 1)
            query["topics"].append("0x" + (bytes(12) + address_bytes(about)).hex())
        if addresses:
            query["address"] = list(addresses)
        logs: list[Log] = await self._ask("eth_getLogs", query)
        if any(not first <= log.block_number <= last for log in logs):
            raise InvalidAnswer(f"eth_getLogs for the blocks {first} to {last}", "a log is of another block")
        return logs

    async def block_logs(self, block: BlockHeader, *, addresses: Collection[str], topics: Sequence[str]) -> list[Log]:
        """The logs of one block, as `logs` returns them, from a machine that has the block.

        An empty answer that the header's Bloom filter contradicts, and a refusal, are checked with the block's
        receipts: nodes that want an address, or have no `eth_getLogs`, have these. Raises `NodeUnreachable` if the node
        can't prove its answer; who reads asks again. A filter can also claim logs that the block lacks, and a node may
        keep no receipts: after `NODE_LIMITS.doubts` empty answers for a block that the node has, it is believed.
        """
        query: dict[str, Any] = {"blockHash": "0x" + block.hash.hex(), "topics": [list(topics)]}
        if addresses:
            query["address"] = list(addresses)
        wanted = [bytes.fromhex(topic[2:]) for topic in topics]
        emitters = [address_bytes(address) for address in addresses]
        refused: RequestRefused | None = None
        if self._logs_refused < NODE_LIMITS.refusals:
            try:
                logs: list[Log] = await self._ask("eth_getLogs", query)
            except RequestRefused as error:
                refused = error
            else:
                if any((log.block_hash, log.block_number) != (block.hash, block.number) for log in logs):
                    raise InvalidAnswer(f"eth_getLogs for block {block.number}", "a log is of another block")
                alternatives = product(emitters, wanted) if emitters else product(wanted)
                if logs or not block.has_bloom or not block.may_log(*alternatives):
                    return logs
        found = await self._logs_by_receipts(block)
        if found is None and refused is None and await self._is_empty(block):
            return []
        if found is None:
            why = f"a machine behind it lacks the logs of block {block.number}"
            raise refused or NodeUnreachable(self.endpoint, why, code="missing-logs")
        if refused is not None and not BEHIND.search(refused.detail):
            self._logs_refused += 1
        return [
            log
            for log in found
            if log.topics and log.topics[0] in wanted and (not addresses or log.address in addresses)
        ]

    async def _is_empty(self, block: BlockHeader) -> bool:
        """Whether to believe one more empty answer for a block whose receipts the node lacks."""
        doubted, times = self._doubted
        self._doubted = block.hash, times + 1 if doubted == block.hash else 1
        if self._doubted[1] < NODE_LIMITS.doubts or await self._body(block) is None:
            return False
        if not self._is_doubt_told:
            self._is_doubt_told = True
            facts = log_event("logs-unproven", block=block.number, node=self.endpoint)
            lacks = "the node %s has no receipts for block %d, so what it says of the logs of blocks can't be checked"
            log.warning(lacks, self.endpoint, block.number, extra=facts)
        return True

    async def _body(self, block: BlockHeader) -> BlockBody | None:
        body: BlockBody | None = await self._ask("eth_getBlockByHash", "0x" + block.hash.hex(), False)
        return None if body is None or body.hash != block.hash else body

    async def _logs_by_receipts(self, block: BlockHeader) -> list[Log] | None:
        """All logs of a block by its receipts; None if the node lacks one of them."""
        try:
            body = await self._body(block)
            if body is None:
                return None
            receipts = await self._block_receipts(body)
        except RequestRefused:
            return None
        if len(receipts) != len(body.transactions) or any(
            receipt is None or receipt.block_hash != block.hash for receipt in receipts
        ):
            return None
        return [log for receipt in receipts if receipt is not None for log in receipt.logs]

    async def _block_receipts(self, body: BlockBody) -> Sequence[BlockReceipt | None]:
        if self._has_block_receipts:
            try:
                return await self._ask("eth_getBlockReceipts", "0x" + body.hash.hex()) or []
            except RequestRefused as refused:
                self._has_block_receipts = refused.rpc_code != METHOD_NOT_FOUND
        ask = partial(self.rpc.request, "eth_getTransactionReceipt", kind=BlockReceipt | None)
        return [await ask(["0x" + tx.hex()]) for tx in body.transactions]

    async def check_logs(self) -> None:
        """Raise `ConfigurationError` if the node can't say what contracts have logged, so that events can't be read."""
        last: AiraError | None = None
        for _ in range(self.timing.attempts):
            try:
                await self.block_logs(await self.heads.look(), addresses=(), topics=["0x" + "00" * 32])
                return
            except (RequestRefused, NodeUnreachable) as error:
                if isinstance(error, NodeUnreachable) and error.code != "missing-logs":
                    raise
                last = error
                await asyncio.sleep(self.timing.retry_delay)
        if isinstance(last, RequestRefused):
            raise ConfigurationError(
                f"the node refuses eth_getLogs and the receipts of blocks, so nothing can be followed: {last.detail}",
                hint="name a node that answers eth_getLogs with web3_http_provider",
                code="node-lacks-logs",
            ) from last

    async def check_calls(self, address: str) -> None:
        """Raise for a node that lacks a call which roles need, with the call in the error.

        For `address` a transaction is prepared, and not sent. Raises `ConfigurationError`, `RequestRefused`.
        """
        await self.check_logs()
        await self.gas_market()
        await self.transaction_count(address, block="pending")
        try:
            await self.estimate_gas({"from": address, "to": address, "data": "0x", "value": 0})
            await self.receipt("0x" + "00" * 32)
        except Reverted:
            return  # it answers
        except RequestRefused as refused:
            if refused.rpc_code == METHOD_NOT_FOUND:
                raise

    async def eth_balance(self, address: str) -> int:
        """Wei of an account."""
        return int(await self._ask("eth_getBalance", address, "latest"))

    async def transaction_count(self, address: str, *, block: int | str = "latest") -> int:
        """How many transactions an account has up to a block; for "pending" also those that wait to be mined."""
        return int(await self._ask_at(block, "eth_getTransactionCount", address))

    async def code(self, address: str, *, block: int | str = "latest") -> bytes:
        """The code of the contract at an address, in the state after a block; empty if there is none."""
        return bytes(await self._ask("eth_getCode", address, _block(block)))

    async def gas_price(self) -> int:
        """The price of a unit of gas that the node suggests, wei."""
        return int(await self._ask("eth_gasPrice"))

    async def data_fee(self, data: bytes) -> int:
        """What a transaction with this data is charged for it beside its gas, wei; 0 but on OP-type rollups."""
        return await self._data_fees.of(data)

    async def data_gas(self, data: bytes) -> int:
        """The same as the gas that can be bought for it now."""
        fee = await self.data_fee(data)
        return -(-fee // max((await self.gas_market()).price, 1)) if fee else 0

    async def _ask_fee_oracle(self, data: bytes) -> bytes | None:
        try:
            return await self.call({"to": FEE_ORACLE, "data": "0x" + data.hex()})
        except (RequestRefused, Reverted) as error:
            log.debug("the fee for data can't be asked: %s", error)
            return None

    async def gas_market(self) -> GasMarket:
        """The price of gas in the latest block, with the priority fee that the node suggested of late."""
        head = await self.heads.recent()
        if head.base_fee is None:
            price = await self.gas_price()
            return GasMarket(price, Fees(price, None))
        until, priority = self._priority
        if time.monotonic() >= until:
            priority = await self._suggested_priority(head.base_fee)
            self._priority = time.monotonic() + NODE_PACE.priority_fee, priority
        return GasMarket(head.base_fee + priority, Fees(2 * head.base_fee + priority, priority))

    async def estimate_gas(self, call: Mapping[str, Any]) -> int:
        """Gas of a transaction in the state that pending ones leave, where the node has that. Raises `Reverted`."""
        return int(await self._ask_at("pending", "eth_estimateGas", _call(call)))

    async def call(self, call: Mapping[str, Any], *, block: int | str = "latest") -> bytes:
        """What a call (`from`, `to`, `data`, `value`) returns in the state after a block. Raises `Reverted`."""
        return bytes(await self._ask_at(block, "eth_call", _call(call)))

    async def send_raw(self, raw: bytes) -> None:
        """Give a signed transaction to the node, once."""
        await self._ask("eth_sendRawTransaction", "0x" + raw.hex())

    async def has_transaction(self, tx: str) -> bool:
        """Whether the node has a transaction, mined or waiting."""
        try:
            return await self._ask("eth_getTransactionByHash", tx) is not None
        except RequestRefused:
            return False

    async def has_mined(self, tx: str) -> bool:
        """Whether the node has a transaction that waits, or was mined with success."""
        receipt = await self.receipt(tx)
        return await self.has_transaction(tx) if receipt is None else receipt.status == 1

    async def receipt(self, tx: str) -> MinedTransaction | None:
        """The receipt of a transaction; None if it is not mined."""
        receipt: MinedTransaction | None = await self._ask("eth_getTransactionReceipt", tx)
        return receipt

    async def read(self, call: ContractCall, *, block: int | str = "latest") -> Any:
        """What a contract's function returns, several values as a tuple; asked again if it does not decode.

        Raises `Reverted`, `NoContracts` if there is no such contract, `InvalidAnswer` for other data.
        """
        request = {"to": call.address, "data": "0x" + call.data.hex()}
        for attempt in range(NODE_LIMITS.reads):
            returned = await self.call(request, block=block)
            try:
                return _values(call, returned)
            except SpoiledAnswer as error:
                failure = error
            if not attempt and not returned and not await self.code(call.address, block=block):
                raise NoContracts(f"contract with {call.fn_name} at {call.address}", self.chain_id)
        raise InvalidAnswer(f"{call.fn_name} of {call.address}", str(failure))

    async def read_all(self, calls: Iterable[ContractCall], *, block: int | str) -> list[Any]:
        """What several functions return in the state of one block, asked for in one call. Raises as `read` does."""
        calls = list(calls)
        if block == "latest" and len(calls) > NODE_LIMITS.calls:
            block = await self.block_number()
        found: list[Any] = []
        for start in range(0, len(calls), NODE_LIMITS.calls):
            some = calls[start : start + NODE_LIMITS.calls]
            try:
                answers = await self._call_together([(call.address, call.data) for call in some], block)
                found += [_values(call, answer) for call, answer in zip(some, answers, strict=True)]
            except (RequestRefused, Reverted, ValueError) as error:
                log.debug("%d functions are read one by one: %s", len(some), error)
                found += await self._read_each(some, block)
        return found

    async def _read_each(self, calls: Sequence[ContractCall], block: int | str) -> list[Any]:
        number = await self.block_number() if block == "latest" and len(calls) > 1 else block
        answers = await asyncio.gather(*(self.read(call, block=number) for call in calls), return_exceptions=True)
        for answer in answers:
            if isinstance(answer, BaseException):
                raise answer
        return answers

    async def call_all(self, calls: Sequence[Call], *, gas: int, most: int) -> list[bytes | None]:
        """What each call returns, `most` bytes of it, and None if it fails, also because it needs more than `gas`.

        Asked again if the answer does not decode. Raises `Reverted` and `RequestRefused`, as when all calls together
        are too much for the node.
        """
        for _ in range(NODE_LIMITS.reads):
            try:
                return await self._call_together(calls, "latest", gas=gas, most=most)
            except SpoiledAnswer as error:
                failure = error
        raise InvalidAnswer(f"{len(calls)} calls in one", str(failure))

    async def _call_together(
        self,
        calls: Sequence[Call],
        block: int | str,
        *,
        gas: int = 2**256 - 1,
        most: int = 0xFFFF,  # what two bytes of length can say
    ) -> list[bytes | None]:
        code = encode_calls(calls, gas=gas, most=most)
        return decode_answers(await self.call({"data": "0x" + code.hex()}, block=block), number=len(calls))

    def creation_code(self, name: str, *arguments: Any) -> bytes:
        """The data of a transaction that deploys one of our contracts (`artifacts.NAMES`)."""
        artifact = load_artifact(name)
        inputs = next((entry["inputs"] for entry in artifact.abi if entry["type"] == "constructor"), ())
        return artifact.bytecode + encode([member["type"] for member in inputs], arguments)

    def pending_transactions(self, address: str) -> PendingTransactions:
        """What all senders of one account through this node share. Raises `ConfigurationError` for the folder."""
        if address not in self._pending:
            folder = self._chain_folder
            store = None if folder is None else TransactionStore(folder / address.lower())
            self._pending[address] = PendingTransactions(store)
        return self._pending[address]

    async def _ask(self, method: str, *params: Any) -> Any:
        """What the node answers to one of the methods in `ANSWERS`, with the type that is declared there."""
        return await self.rpc.request(method, list(params), kind=ANSWERS[method])

    async def _ask_at(self, block: int | str, method: str, *params: Any) -> Any:
        """The answer in the state of a block. Nodes without a pending state answer in that of the latest block."""
        if block != "pending":
            return await self._ask(method, *params, _block(block))
        refused: AiraError | None = None
        if self._has_pending:
            try:
                return await self._ask(method, *params, block)
            except (RequestRefused, NodeUnreachable) as error:
                if not is_answered(error):
                    raise
                refused = error
        try:
            answer = await self._ask(method, *params, "latest")  # raises the request's own fault, if that is why
        except RequestRefused as error:
            if method != "eth_estimateGas" or "argument" not in error.detail.lower():
                raise
            answer = await self._ask(method, *params)  # some take no block
        self._has_pending = self._has_pending and refused is None
        return answer

    async def _suggested_priority(self, base: int) -> int:
        """The priority fee that the node suggests, or how far its gas price is above the base fee, or the usual one."""
        suggested = await self._quantity_or_none("eth_maxPriorityFeePerGas")
        if suggested is not None:
            return suggested
        price = await self._quantity_or_none("eth_gasPrice")
        if price is not None:
            return max(price - base, 0)
        try:
            history = await self.rpc.request("eth_feeHistory", ["0x5", "latest", [50]])
            return max(int(rewards[0], 16) for rewards in history["reward"])
        except (RequestRefused, TypeError, KeyError, ValueError, IndexError):
            return GWEI

    async def _quantity_or_none(self, method: str) -> int | None:
        """A node's suggestion; None where the node lacks the method, in whatever words, or answers nothing."""
        try:
            found = await self.rpc.request(method, [])
            return int(found, 16) if isinstance(found, str) and len(found) <= len("0x") + 64 else None
        except (RequestRefused, ValueError):
            return None

    def _request_pushes(self) -> None:
        self.rpc.push_heads(self.heads.pushed)

    def contract(self, name: str, address: str) -> ContractFunctions:
        """The functions of the contract at an address with the ABI of one of ours (`artifacts.NAMES`)."""
        return ContractFunctions(address, our_functions(name))


def _block(identifier: int | str) -> str:
    """A block as JSON-RPC has it: its number as a quantity, or a tag."""
    return identifier if isinstance(identifier, str) else hex(identifier)


def _call(call: Mapping[str, Any]) -> dict[str, Any]:
    """A call as JSON-RPC has it."""
    return {name: hex(member) if isinstance(member, int) else member for name, member in call.items()}
