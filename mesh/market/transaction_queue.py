"""A provider's transactions: one at a time, each in the provider's turn, and again after failures that may pass.

One attempt does not show whether a failure is the transaction's own fault: an overloaded node refuses anything,
while a token contract can keep a node busy until the request times out, or revert with the lighthouse's own errors. So
such a transaction is tried again, but only a few times, and not for much of the time that others wait for.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import logging
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

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
from mesh.outage_log import OutageLog
from mesh.retry import Backoff, RetryPolicy

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from mesh.chain import Chain, LighthouseState
    from mesh.market.earnings import EarningsLedger

log = logging.getLogger(__name__)

T = TypeVar("T")

RETRY: Final = RetryPolicy(attempts=8)
"""For a transaction that fails, perhaps through its own fault. Other transactions are sent between the attempts."""
BUSY_SECONDS: Final = 100.0
"""How long the failing attempts at one transaction may take in all: the others wait meanwhile."""
QUEUED: Final = 1024
"""Transactions in the queue above which `has_room` waits."""
SET_ASIDE: Final = 4096
"""Transactions that may wait for their next attempt at the same time."""
OUT_OF_TURN: Final = frozenset({"NotYourTurn", "NotAProvider"})
"""The lighthouse's errors for a provider whose turn it is not, whatever the transaction."""
LEAST_GAS: Final = 200_000
"""About what the cheapest transaction of a provider uses."""
WAITS: Final = "a transaction waits"


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


def may_pass(error: NodeUnreachable | RequestRefused | Reverted) -> bool:
    """Whether a failed transaction may succeed unchanged."""
    return not isinstance(error, Reverted) or error.reason in OUT_OF_TURN


@dataclass(slots=True)
class _SendAttempts:
    """The attempts at one transaction."""

    since: int
    """The latest block when the transaction was queued."""
    backoff: Backoff
    busy: float = 0.0
    """Seconds that failed attempts took."""


class TransactionQueue:
    """The transactions of the chain's account as a provider of `lighthouse` (address): those with the highest priority
    first, and of equals the one that came first.

    Turn and nonce belong to the account, so a transaction that waits for the turn, the node or cheaper gas holds up
    all others. `head` returns the latest known block. The cost of reverted transactions goes into `earnings`.
    """

    def __init__(
        self,
        chain: Chain,
        lighthouse: str,
        *,
        head: Callable[[], int],
        earnings: EarningsLedger,
        retry: RetryPolicy = RETRY,
        limit: int = QUEUED,
        set_aside_limit: int = SET_ASIDE,
    ) -> None:
        self._chain = chain
        self._lighthouse = lighthouse
        self._head = head
        self._earnings = earnings
        self._retry = retry
        self._limit = limit
        self._set_aside_limit = set_aside_limit
        self._turns = Turns(chain, lighthouse)
        self._sending = False
        self._waiting: list[tuple[int, int, asyncio.Future[None]]] = []
        """A heap of those that wait to send: the negative priority, a serial number, and what wakes them."""
        self._numbers = itertools.count()
        self._queued = 0
        self._set_aside = 0
        self._room = asyncio.Event()
        self._room.set()
        self._outages = OutageLog(log, "transactions")

    @property
    def is_down(self) -> bool:
        """Whether transactions fail or wait for something other than a turn or a block."""
        return self._outages.is_down

    @property
    def waiting(self) -> int:
        """Transactions that wait in the queue, or for their next attempt."""
        return self._queued + self._set_aside

    async def has_room(self) -> None:
        """Wait until the queue is shorter than its limit. Await it before accepting work that leads to `send`."""
        await asyncio.sleep(0)  # tasks that were created just now enter the queue
        await self._room.wait()

    async def send(self, transaction: Callable[[], Awaitable[T]], *, priority: int = 0) -> T:
        """Send a transaction when all that go before it are sent, in the provider's turn; return its outcome.

        It is tried again without limit while the node is down, gas is too expensive, or the account is short of ETH.
        While the node works for others but not for this transaction, it is tried again as often as the retry policy
        allows, and others go first meanwhile.

        Raises what `transaction` raises: `Reverted` when the contracts refuse it; after the last attempt also
        `NodeUnreachable`, `RequestRefused`, and `Reverted` with an error of `OUT_OF_TURN`.
        """
        attempts = _SendAttempts(self._head(), Backoff(self._retry))
        funds = Backoff(self._chain.node.timing.outage_retry)
        while True:
            try:
                async with self._first_in_queue(priority):
                    return await self._send_in_turn(transaction, attempts)
            except InsufficientFunds as error:
                # Perhaps for this transaction only: a token contract may need any amount of gas.
                self._outages.failed(error, WAITS)
                await funds.wait()
            except (NodeUnreachable, RequestRefused, Reverted) as error:
                await self._wait_aside(attempts, error)

    @asynccontextmanager
    async def _first_in_queue(self, priority: int) -> AsyncIterator[None]:
        """Wait until all that go before are done; the others wait until this is left."""
        self._queued += 1
        if self._queued >= self._limit:
            self._room.clear()
        try:
            await self._acquire(priority)
        finally:
            self._queued -= 1
            if self._queued < self._limit:
                self._room.set()
        try:
            yield
        finally:
            self._release()

    async def _acquire(self, priority: int) -> None:
        if not self._sending:
            self._sending = True
            return
        waiter = asyncio.get_running_loop().create_future()
        heapq.heappush(self._waiting, (-priority, next(self._numbers), waiter))
        try:
            await waiter
        except asyncio.CancelledError:
            if not waiter.cancelled():  # it was woken and cancelled at once
                self._release()
            raise

    def _release(self) -> None:
        while self._waiting:
            *_, waiter = heapq.heappop(self._waiting)
            if not waiter.done():
                waiter.set_result(None)
                return
        self._sending = False

    async def _wait_aside(self, attempts: _SendAttempts, error: NodeUnreachable | RequestRefused | Reverted) -> None:
        """Wait for the next attempt at a transaction while others are sent; raise `error` where there is none."""
        delay = attempts.backoff.next_delay() if may_pass(error) else None
        if delay is None or attempts.busy >= BUSY_SECONDS or self._set_aside >= self._set_aside_limit:
            raise error
        self._outages.failed(error, WAITS)
        self._set_aside += 1
        try:
            await asyncio.sleep(delay)
        finally:
            self._set_aside -= 1

    async def _send_in_turn(self, transaction: Callable[[], Awaitable[T]], attempts: _SendAttempts) -> T:
        """Send a transaction now. Raises also failures that may pass, where the node works and it is our turn."""
        loop, backoff = asyncio.get_running_loop(), Backoff(self._chain.node.timing.outage_retry)
        while True:
            await self._wait_for_turn(attempts.since)
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
                self._turns.took_one()
                self._outages.recovered("transactions go through again")
                return outcome
            # Time has passed, and with it perhaps the turn.
            self._turns.forget()
            await backoff.wait()

    async def _wait_for_turn(self, since: int) -> None:
        """Wait until the turn has come; it comes with a block."""
        heads, backoff = self._chain.node.heads, Backoff(self._chain.node.timing.outage_retry)
        while True:
            try:
                seen = heads.latest or await heads.look()
                if await self._turns.has_come(since=since):
                    return
                await heads.next(seen.hash)
            except (NodeUnreachable, RequestRefused, NoContracts, NoStake) as error:
                self._outages.failed(error, WAITS)
                await backoff.wait()

    async def _is_our_turn(self) -> bool:
        try:
            return await self._chain.lighthouses.is_turn(self._lighthouse)
        except (NodeUnreachable, RequestRefused, NoContracts):
            return False


class Turns:
    """The turns of the chain's account at `lighthouse` (address). Methods raise `NodeUnreachable`, `RequestRefused`.

    The contract lets other providers send after a timeout without transactions. But there may have been nothing to
    send: if all providers sent the next job's transactions at once, all but one would pay for a refusal. So a provider
    whose turn it is not waits, from when it had work, so that those before it have their time. It counts mined blocks
    only, as a transaction of another provider may be mined after one that is sent now.
    """

    def __init__(self, chain: Chain, lighthouse: str) -> None:
        assert chain.account is not None
        self._chain = chain
        self._lighthouse = lighthouse
        self._provider = chain.account.address
        self._left = 0

    async def has_come(self, *, since: int) -> bool:
        """Whether the account may send now a transaction that it has had since block `since`. Raises `NoStake`."""
        if self._left > 0:
            return True
        state = await self._chain.lighthouses.get(self._lighthouse)
        if self._provider not in state.stakes:
            raise NoStake(self._provider, self._lighthouse, minimal_stake=state.minimal_stake)
        if state.current == self._provider:
            self._left = state.quota
            return True
        return await self._chain.lighthouses.is_turn(self._lighthouse) and await self._is_left_to_us(state, since)

    def took_one(self) -> None:
        """Count a transaction of the account that was mined."""
        self._left -= 1

    def forget(self) -> None:
        """Ask the lighthouse again before the next transaction."""
        self._left = 0

    async def _is_left_to_us(self, state: LighthouseState, since: int) -> bool:
        """Whether the providers before this one had their time: the first two a timeout each, the others a block."""
        providers = list(state.stakes)
        before = (providers.index(self._provider) - providers.index(state.current)) % len(providers)
        # After two timeouts the contract lets all of them send. Those far behind don't wait for each silent one.
        behind = min(max(before - 2, 0), state.timeout_blocks)
        return await self._chain.block_number() - since >= min(before, 2) * state.timeout_blocks + behind
