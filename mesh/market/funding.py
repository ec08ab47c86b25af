"""Whether the makers of orders can pay: before their orders are matched, and while transactions are under way.

An order that can't be paid for must not be matched: its match would take an honest order out of the book, and a turn of
the lighthouse, to learn that from the contracts. It stays in the book, unmatched, and is tried again.

Each transaction is simulated before it is sent, but the simulation may not know of those that were sent just before,
and a transaction that fails when it is mined costs gas. So what two transactions compete for is taken here first.
"""

from __future__ import annotations

import asyncio
import heapq
from collections import Counter
from contextlib import asynccontextmanager, nullcontext
from itertools import count, islice
from typing import TYPE_CHECKING, Final, TypeAlias

from mesh.chain import Holding
from mesh.market.book import order_id
from mesh.retry import Backoff, RetryPolicy

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
    from contextlib import AbstractContextManager

    from mesh.chain import Funding, OrderCosts
    from mesh.market.book import Match, Order, OrderBook
    from schemas import Verified

    Stakes: TypeAlias = Mapping["Holding | str", int]
    """What a transaction takes: amounts of holdings, and by name what only one transaction may take at a time."""

RETRY: Final = RetryPolicy(initial=2.0, ceiling=60.0)
"""When an order's maker is asked after again."""
LIMIT: Final = 4096
"""Orders that may wait for their makers' funds at the same time."""
CHECKS: Final = 256
"""Orders that are looked at in one round, at most."""


class UnfundedOrders:
    """The orders in `book` whose makers can't pay; if one can again, its order is taken out and passed to `funded`.

    `shortages` says of each order what its maker lacks. `interval` is in seconds between two rounds, of at most
    `CHECKS` orders each.
    """

    def __init__(
        self,
        book: OrderBook,
        shortages: Callable[[Sequence[Verified[Order]]], Awaitable[Sequence[str]]],
        *,
        funded: Callable[[Verified[Order]], object],
        interval: float,
        retry: RetryPolicy = RETRY,
        limit: int = LIMIT,
    ) -> None:
        self._book = book
        self._shortages = shortages
        self._funded = funded
        self._interval = interval
        self._retry = retry
        self._limit = limit
        self._waiting: dict[bytes, tuple[float, Backoff]] = {}
        self._queue: list[tuple[float, int, Verified[Order]]] = []
        self._numbers = count()

    def __contains__(self, order: Verified[Order]) -> bool:
        return order_id(order) in self._waiting and order_id(order) in self._book

    def add(self, order: Verified[Order]) -> bool:
        """Keep an order, which is not in the book, in the book without matching it; False if there is no room."""
        if len(self._waiting) >= self._limit or not self._book.set_aside(order):
            return False
        self._schedule(order, Backoff(self._retry))
        return True

    def hasten(self, order: Verified[Order]) -> None:
        """Its maker sends the order again, perhaps because it can pay now: look at it in the next round."""
        due, backoff = self._waiting[order_id(order)]
        if due > (now := asyncio.get_running_loop().time()):
            self._enter(order, now, backoff)

    async def run(self) -> None:
        """Look at the orders when they are due, until cancelled."""
        while True:
            await asyncio.sleep(self._interval)
            due = list(islice(iter(self._next_due, None), CHECKS))
            for order, shortage in zip(due, await self._shortages(due), strict=True):
                waiting = self._waiting.pop(order_id(order), None)
                if waiting is None or order_id(order) not in self._book:
                    continue
                if shortage:
                    self._schedule(order, waiting[1])
                else:
                    self._book.remove(order_id(order))
                    self._funded(order)

    def _next_due(self) -> Verified[Order] | None:
        """The next order that is due; forgets those that have left the book."""
        now = asyncio.get_running_loop().time()
        while self._queue and self._queue[0][0] <= now:
            at, _, order = heapq.heappop(self._queue)
            waiting = self._waiting.get(order_id(order))
            if waiting is None or waiting[0] != at:
                continue
            if order_id(order) in self._book:
                return order
            del self._waiting[order_id(order)]
        return None

    def _schedule(self, order: Verified[Order], backoff: Backoff) -> None:
        self._enter(order, asyncio.get_running_loop().time() + (backoff.next_delay() or 0.0), backoff)

    def _enter(self, order: Verified[Order], at: float, backoff: Backoff) -> None:
        self._waiting[order_id(order)] = at, backoff
        heapq.heappush(self._queue, (at, next(self._numbers), order))


class Commitments:
    """What the transactions under way take. `funding` asks the chain for what is there of holdings."""

    def __init__(self, funding: Callable[[Sequence[Holding]], Awaitable[Mapping[Holding, Funding | None]]]) -> None:
        self._funding = funding
        self._taken: Counter[Holding | str] = Counter()
        self._there: dict[Holding, Funding | None] = {}
        """Of holdings of which something is taken: what there was after anything was given back the last time."""
        self._wanted: set[Holding] = set()
        self._asking = asyncio.Lock()
        self._released = asyncio.Event()

    @asynccontextmanager
    async def take(
        self, stakes: Stakes, *, waiting: AbstractContextManager[object] | None = None
    ) -> AsyncIterator[None]:
        """Meanwhile take something, as soon as those before leave enough of it, or take nothing of the kind.

        It waits for that within `waiting`.
        """
        with waiting or nullcontext():
            while not await self._is_left(stakes):
                await self._released.wait()
        self._taken.update(stakes)
        try:
            yield
        finally:
            self._give_back(stakes)

    def _give_back(self, stakes: Stakes) -> None:
        for what, amount in stakes.items():
            self._taken[what] -= amount
            if not self._taken[what]:
                del self._taken[what]
            if isinstance(what, Holding):  # it may have been spent
                self._there.pop(what, None)
                self._wanted.discard(what)
        self._released.set()
        self._released = asyncio.Event()

    async def _is_left(self, stakes: Stakes) -> bool:
        """Whether it can be taken, as of the moment in which this returns."""
        while True:
            shared = [what for what in stakes if self._taken[what]]
            holdings = [what for what in shared if isinstance(what, Holding)]
            if len(holdings) < len(shared):
                return False
            if all(holding in self._there for holding in holdings):
                return all(self._left(holding) >= stakes[holding] for holding in holdings)
            async with self._asking:
                self._wanted = {holding for holding in holdings if holding not in self._there}
                if self._wanted:
                    found = await self._funding(list(self._wanted))
                    self._there |= {holding: found[holding] for holding in self._wanted}

    def _left(self, holding: Holding) -> int:
        there = self._there[holding]
        return -1 if there is None else min(there) - self._taken[holding]


def creation_stakes(match: Match, costs: OrderCosts) -> Stakes:
    """What creating the liability of a match takes: what its orders cost, and the nonces of generation 5 in turn."""
    stakes: Counter[Holding | str] = Counter()
    for order in match:
        stakes.update({Holding(token, order.signer): amount for token, amount in costs.of(order.message).items()})
        if order.message.generation == 5:
            stakes[f"nonce of {order.signer}"] = 1
    return +stakes
