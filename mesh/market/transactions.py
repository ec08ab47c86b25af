"""A provider's transactions: several under way, each in the provider's turn, and again after failures that may pass.

One attempt does not show whether a failure is the transaction's own fault: an overloaded node refuses anything,
while a token contract can keep a node busy until the request times out, or revert with the lighthouse's own errors. So
such a transaction is tried again, but only a few times, and not for much of the time that others wait for.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import logging
from collections import Counter
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from mesh.base.outage_log import OutageLog
from mesh.base.retry import Backoff, RetryPolicy
from mesh.chain import (
    FeeTooHigh,
    InsufficientFunds,
    NoContracts,
    NodeUnreachable,
    RequestRefused,
    Reverted,
    TransactionTimeout,
)
from mesh.errors import ChainError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
    from contextlib import AbstractAsyncContextManager, AbstractContextManager

    from mesh.chain import Chain, Funding, Holding, LighthouseState, Node
    from mesh.market._earnings import EarningsLedger


class NoStake(ChainError, code="no-stake"):
    """A provider has no stake at its lighthouse, which refuses all its transactions. The minimal stake is in wn."""

    def __init__(self, provider: str, lighthouse: str, *, minimal_stake: int) -> None:
        super().__init__(
            f"{provider} has no stake at the lighthouse {lighthouse}",
            hint=f"stake {minimal_stake} wn or more: `aira lighthouse join {minimal_stake}wn`",
        )
        self.provider = provider
        self.lighthouse = lighthouse
        self.minimal_stake = minimal_stake


class Turns:
    """The turns of the chain's account at `lighthouse` (address), with at most `most` transactions under way.

    Methods raise `NodeUnreachable`, `RequestRefused`.

    The contract lets other providers send after a timeout without transactions. But there may have been nothing to
    send: if all providers sent the next job's transactions at once, all but one would pay for a refusal. So a provider
    whose turn it is not waits, from when it had work, so that those before it have their time. It counts mined blocks
    only, as a transaction of another provider may be mined after one that is sent now.

    What the lighthouse says is of the last block. So it is asked only while no transaction is under way, and no more
    are sent than it says are left. One provider alone has a new turn after each: it has no quota, unless somebody
    comes.
    """

    def __init__(self, chain: Chain, lighthouse: str, *, most: int = 1) -> None:
        assert chain.account is not None
        self._chain = chain
        self._lighthouse = lighthouse
        self._provider = chain.account.address
        self._most = most
        self._left = 0
        self._under_way = 0
        self._ended = asyncio.Event()

    async def has_come(self, *, since: int) -> bool:
        """Whether the account may send now a transaction that it has had since block `since`. Raises `NoStake`."""
        if self._left > 0 or self._under_way:
            return self._left > 0
        state = await self._chain.lighthouses.get(self._lighthouse)
        if self._provider not in state.stakes:
            raise NoStake(self._provider, self._lighthouse, minimal_stake=state.minimal_stake)
        if state.current == self._provider:
            self._left = state.quota if len(state.stakes) > 1 else max(state.quota, self._most)
        elif await self._chain.lighthouses.is_turn(self._lighthouse) and await self._is_left_to_us(state, since):
            self._left = 1
        return self._left > 0

    def take_one(self) -> None:
        """Count a transaction of the account that is sent now."""
        self._left -= 1
        self._under_way += 1

    def ended(self) -> None:
        """Count the end of such a transaction: it was mined, or failed, or its outcome is unknown."""
        self._under_way -= 1
        self._ended.set()

    async def one_ended(self) -> bool:
        """Wait for the end of a transaction under way; False if there is none."""
        if not self._under_way:
            return False
        self._ended.clear()
        return await self._ended.wait()

    def forget(self) -> None:
        """Ask the lighthouse again before the next transaction."""
        self._left = 0

    async def _is_left_to_us(self, state: LighthouseState, since: int) -> bool:
        """Whether the providers before this one had their time: the first two a timeout each, the others a block."""
        providers = list(state.stakes)
        before = (providers.index(self._provider) - providers.index(state.current)) % len(providers)
        # After two timeouts the contract lets all of them send. Those far behind don't wait for each silent one.
        behind = min(max(before - 2, 0), state.timeout_blocks)
        return await self._chain.contract_block() - since >= min(before, 2) * state.timeout_blocks + behind


log = logging.getLogger(__name__)

T = TypeVar("T")

RETRY: Final = RetryPolicy(attempts=8)
"""For a transaction that fails, perhaps through its own fault. Other transactions are sent between the attempts."""
BUSY_SECONDS: Final = 100.0
"""How long the failing attempts at one transaction may take in all: the others wait meanwhile."""


class QueueLimits(NamedTuple):
    """How many transactions may be where, at the same time."""

    under_way: int = 16
    """Those that wait to be mined: some nodes keep no more of one account."""
    reserved: int = 4
    """One of so many of these places is kept for transactions with a priority: one that is worth something need not
    wait for the next block because free contracts have taken all places."""
    queued: int = 1024
    """Those in the queue, above which there is no room for others of their priority, or a lower one."""
    set_aside: int = 4096
    """Those that wait for their next attempt."""


QUEUE_LIMITS: Final = QueueLimits()
OUT_OF_TURN: Final = frozenset({"NotYourTurn", "NotAProvider"})
"""The lighthouse's errors for a provider whose turn it is not, whatever the transaction."""
LEAST_GAS: Final = 200_000
"""About what the cheapest transaction of a provider uses."""
WAITS: Final = "a transaction waits"


async def least_cost(node: Node) -> int:
    """About what the cheapest transaction of a provider costs now, wei: its data has some 500 bytes."""
    return LEAST_GAS * await node.gas_price() + await node.data_fee(b"\1" * 500)


def may_pass(error: NodeUnreachable | RequestRefused | Reverted) -> bool:
    """Whether a failed transaction may succeed unchanged."""
    return not isinstance(error, Reverted) or error.reason in OUT_OF_TURN


@dataclass(slots=True)
class _SendAttempts:
    since: int
    """The latest block when the transaction was queued."""
    backoff: Backoff
    busy: float = 0.0
    """Seconds that failed attempts took."""


@dataclass(frozen=True, slots=True)
class Stakes:
    """What a transaction takes: amounts of holdings, and what only one transaction may take at a time."""

    amounts: Mapping[Holding, int] = field(default_factory=dict)
    alone: frozenset[str] = frozenset()


class Commitments:
    """What the transactions under way take. `funding` asks the chain for what is there of holdings."""

    def __init__(self, funding: Callable[[Sequence[Holding]], Awaitable[Mapping[Holding, Funding | None]]]) -> None:
        self._funding = funding
        self._taken: Counter[Holding] = Counter()
        self._alone: set[str] = set()
        self._there: dict[Holding, Funding | None] = {}
        """Of holdings of which something is taken: what there was after anything was given back the last time."""
        self._wanted: set[Holding] = set()
        self._asking = asyncio.Lock()
        self._released = asyncio.Event()

    @asynccontextmanager
    async def take(self, stakes: Stakes, waiting: AbstractContextManager[object]) -> AsyncIterator[None]:
        """Meanwhile take something, as soon as those before leave enough of it, or take nothing of the kind.

        It waits for that within `waiting`.
        """
        with waiting:
            while not await self._is_left(stakes):
                await self._released.wait()
        self._taken.update(stakes.amounts)
        self._alone |= stakes.alone
        try:
            yield
        finally:
            self._give_back(stakes)

    def _give_back(self, stakes: Stakes) -> None:
        self._alone -= stakes.alone
        for holding, amount in stakes.amounts.items():
            self._taken[holding] -= amount
            if not self._taken[holding]:
                del self._taken[holding]
            self._there.pop(holding, None)  # it may have been spent
            self._wanted.discard(holding)
        self._released.set()
        self._released = asyncio.Event()

    async def _is_left(self, stakes: Stakes) -> bool:
        """Whether it can be taken, as of the moment in which this returns."""
        while True:
            if stakes.alone & self._alone:
                return False
            holdings = [holding for holding in stakes.amounts if self._taken[holding]]
            if all(holding in self._there for holding in holdings):
                return all(self._left(holding) >= stakes.amounts[holding] for holding in holdings)
            async with self._asking:
                self._wanted = {holding for holding in holdings if holding not in self._there}
                if self._wanted:
                    found = await self._funding(list(self._wanted))
                    self._there |= {holding: found[holding] for holding in self._wanted}

    def _left(self, holding: Holding) -> int:
        there = self._there[holding]
        return -1 if there is None else min(there) - self._taken[holding]


class TransactionQueue:
    """The transactions of the chain's account as a provider of `lighthouse` (address): those with the highest priority
    first, and of equals the one that came first.

    Turn and nonce belong to the account, so a transaction that waits for the turn holds up all others. `head` returns
    the latest known block. The cost of reverted transactions goes into `earnings`; outages of the node while funds are
    asked for go to `lookups`.

    Each transaction is simulated before it is sent, but the simulation may not know of those that were sent just
    before, and a transaction that fails when it is mined costs gas. So what two compete for is reserved first.
    """

    def __init__(
        self,
        chain: Chain,
        lighthouse: str,
        *,
        head: Callable[[], int],
        earnings: EarningsLedger,
        lookups: OutageLog | None = None,
        retry: RetryPolicy = RETRY,
        limits: QueueLimits = QUEUE_LIMITS,
    ) -> None:
        self._chain = chain
        self._lighthouse = lighthouse
        self._head = head
        self._earnings = earnings
        self._retry = retry
        self._limits = limits
        self._turns = Turns(chain, lighthouse, most=limits.under_way)
        self._free = limits.under_way
        """Places among those under way."""
        self._taking_turn = asyncio.Lock()
        self._has_first = False
        self._waiting: list[tuple[int, int, asyncio.Future[None]]] = []
        """A heap of those that wait for a place: the negative priority, a serial number, and what wakes them."""
        self._numbers = itertools.count()
        self._queued: Counter[int] = Counter()
        """How many there are of each priority."""
        self._set_aside = 0
        self._room = asyncio.Event()
        self._room.set()
        self._outages = OutageLog(log, "transactions")
        self._lookups = lookups or self._outages
        self._commitments = Commitments(self._funding)

    @property
    def is_down(self) -> bool:
        """Whether transactions fail or wait for something other than a turn or a block."""
        return self._outages.is_down

    @property
    def waiting(self) -> int:
        """Transactions that wait in the queue, or for their next attempt."""
        return self._queued.total() + self._set_aside

    async def has_room(self) -> None:
        """Wait until the queue is shorter than its limit."""
        await asyncio.sleep(0)  # tasks that were created just now enter the queue
        await self._room.wait()

    def has_room_for(self, priority: int) -> bool:
        """Whether fewer than the limit wait of this priority and above. Check it before `send`."""
        return sum(count for level, count in self._queued.items() if level >= priority) < self._limits.queued

    def reserve(self, stakes: Stakes, *, priority: int = 0) -> AbstractAsyncContextManager[None]:
        """Meanwhile take what a transaction needs, once those before leave it; it counts as queued until then."""
        return self._commitments.take(stakes, self.counted(priority))

    async def send(self, transaction: Callable[[], Awaitable[T]], *, priority: int = 0) -> T:
        """Send a transaction when all that go before it are under way, in the provider's turn; return its outcome.

        It is tried again without limit while the node is down, gas is too expensive, or the account is short of ETH.
        While the node works for others but not for this transaction, it is tried again as often as the retry policy
        allows, and others go first meanwhile.

        Raises what `transaction` raises: `Reverted` when the contracts refuse it; after the last attempt also
        `NodeUnreachable`, `RequestRefused`, and `Reverted` with an error of `OUT_OF_TURN`.
        """
        attempts = _SendAttempts(self._head(), Backoff(self._retry))
        funds = Backoff(self._chain.node.timing.outage_retry)
        while True:
            await self._wait_for_place(priority, attempts)
            try:
                return await self._send_in_turn(transaction, attempts)
            except InsufficientFunds as error:
                # Perhaps for this transaction only: a token contract may need any amount of gas.
                self._outages.failed(error, WAITS)
                await funds.wait()
            except (NodeUnreachable, RequestRefused, Reverted) as error:
                await self._wait_aside(attempts, error)

    async def _wait_for_place(self, priority: int, attempts: _SendAttempts) -> None:
        """Wait until all that go before are under way, and for a place among them, and the turn; take both."""
        with self.counted(priority):
            await self._become_first(priority)
            try:
                await self._take_turn(attempts.since)
            except BaseException:
                self._free += 1
                raise
            finally:
                self._has_first = False
                self._admit()

    @contextmanager
    def counted(self, priority: int) -> Iterator[None]:
        """Meanwhile count one more transaction in the queue."""
        self._queued[priority] += 1
        if self._queued.total() >= self._limits.queued:
            self._room.clear()
        try:
            yield
        finally:
            self._queued[priority] -= 1
            if not self._queued[priority]:
                del self._queued[priority]
            if self._queued.total() < self._limits.queued:
                self._room.set()

    async def _become_first(self, priority: int) -> None:
        """Take a place when one is free, and be the one that waits for the turn."""
        waiter = asyncio.get_running_loop().create_future()
        heapq.heappush(self._waiting, (-priority, next(self._numbers), waiter))
        self._admit()
        try:
            await waiter
        except asyncio.CancelledError:
            if not waiter.cancelled():  # it was woken and cancelled at once
                self._free, self._has_first = self._free + 1, False
                self._admit()
            raise

    def _admit(self) -> None:
        """Let the next one be the first, if there is a place for it."""
        while self._waiting and self._free and not self._has_first:
            is_worthless = not self._waiting[0][0]
            if is_worthless and self._free <= self._limits.under_way // self._limits.reserved:
                return
            *_, waiter = heapq.heappop(self._waiting)
            if not waiter.done():
                self._free, self._has_first = self._free - 1, True
                waiter.set_result(None)

    async def _wait_aside(self, attempts: _SendAttempts, error: NodeUnreachable | RequestRefused | Reverted) -> None:
        """Wait for the next attempt at a transaction while others are sent; raise `error` where there is none."""
        delay = attempts.backoff.next_delay() if may_pass(error) else None
        if delay is None or attempts.busy >= BUSY_SECONDS or self._set_aside >= self._limits.set_aside:
            raise error
        self._outages.failed(error, WAITS)
        self._set_aside += 1
        try:
            await asyncio.sleep(delay)
        finally:
            self._set_aside -= 1

    async def _send_in_turn(self, transaction: Callable[[], Awaitable[T]], attempts: _SendAttempts) -> T:
        """Send a transaction that has a place and the turn; give both back.

        Raises also failures that may pass, where the node works and it is our turn.
        """
        loop, backoff = asyncio.get_running_loop(), Backoff(self._chain.node.timing.outage_retry)
        try:
            while True:
                began = loop.time()
                try:
                    outcome = await transaction()
                except (FeeTooHigh, TransactionTimeout) as error:
                    self._outages.failed(error, WAITS)
                except (NodeUnreachable, RequestRefused, Reverted) as error:
                    if isinstance(error, Reverted):
                        self._earnings.failed(error)
                    else:
                        attempts.busy += loop.time() - began
                    if not may_pass(error):
                        raise
                    if await self._is_our_turn():
                        self._turns.forget()
                        raise
                    self._outages.failed(error, WAITS)
                else:
                    self._outages.recovered("transactions go through again")
                    return outcome
                finally:
                    self._turns.ended()
                # Time has passed, and with it perhaps the turn.
                self._turns.forget()
                await backoff.wait()
                await self._take_turn(attempts.since)
        finally:
            self._free += 1
            self._admit()

    async def _take_turn(self, since: int) -> None:
        """Wait for the turn, which comes with a block, and take one of its transactions."""
        heads, backoff = self._chain.node.heads, Backoff(self._chain.node.timing.outage_retry)
        async with self._taking_turn:
            while True:
                try:
                    seen = heads.latest or await heads.look()
                    if await self._turns.has_come(since=since):
                        return self._turns.take_one()
                    if not await self._turns.one_ended():
                        await heads.next(seen.hash)
                except (NodeUnreachable, RequestRefused, NoContracts, NoStake) as error:
                    self._outages.failed(error, WAITS)
                    await backoff.wait()

    async def _funding(self, holdings: Sequence[Holding]) -> Mapping[Holding, Funding | None]:
        ask = partial(self._chain.funds.of, holdings, fresh=True)
        return await self._chain.retrying(ask, outages=self._lookups)

    async def _is_our_turn(self) -> bool:
        try:
            return await self._chain.lighthouses.is_turn(self._lighthouse)
        except (NodeUnreachable, RequestRefused, NoContracts):
            return False
