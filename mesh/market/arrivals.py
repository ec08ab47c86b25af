"""Orders on their way into a provider's book: signers in turn, and none whose maker can't pay.

An order that can't be paid for must not be matched: its match would take an honest order out of the book, and a turn of
the lighthouse, to learn that from the contracts. It stays in the book, unmatched, and is tried again.
"""

from __future__ import annotations

import asyncio
import heapq
from itertools import count
from typing import TYPE_CHECKING, Any, Final, Protocol

from mesh.flood import FairQueue
from mesh.market.book import order_id
from mesh.retry import Backoff, RetryPolicy

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from mesh.flood import Drops, KnownSenders
    from mesh.market.book import Order, OrderBook
    from mesh.network import Subscription
    from schemas import Verified

CHECKED: Final = 512
"""Orders whose makers' funds are asked for at once."""
WAITING: Final = 32_768
"""Orders that wait for that."""
RETRY: Final = RetryPolicy(initial=2.0, ceiling=60.0)
"""When an order's maker is asked after again."""
LIMIT: Final = 4096
"""Orders that may wait for their makers' funds at the same time."""
CHECKS: Final = 256
"""Orders that are looked at in one round, at most."""


class TakesOrders(Protocol):
    """What orders are passed to: the settlement."""

    async def shortages(self, orders: Sequence[Verified[Order]]) -> Sequence[str]:
        """What the maker of each lacks; empty for one who can pay."""
        ...

    def set_aside(self, order: Verified[Order], reason: str) -> object:
        """Keep an order whose maker can't pay."""
        ...

    def add(self, order: Verified[Order]) -> object:
        """Take an order whose maker can pay."""
        ...


class Arrivals:
    """Takes orders from subscriptions (`take`), and passes them to `settlement` (`run`).

    Those of known signers go first. What an order says that it pays counts only when its maker can pay it.
    """

    def __init__(
        self, settlement: TakesOrders, *, known: KnownSenders, has_room: Callable[[], Awaitable[None]], drops: Drops
    ) -> None:
        self._settlement = settlement
        self._known = known
        self._has_room = has_room
        self._drops = drops
        self._queue: FairQueue[tuple[Verified[Order], Subscription[Any]]] = FairQueue(per_sender=WAITING, total=WAITING)

    async def take(self, orders: Subscription[Any]) -> None:
        """Take the open orders of other providers, then those that are published, until cancelled."""
        await orders.recall()
        async for order in orders:
            is_known = order.signer in self._known
            for dropped, subscription in self._queue.put(order.signer, (order, orders), priority=int(is_known)):
                self._drops.count("queue-full", dropped.signer)
                subscription.forget(dropped)

    async def run(self) -> None:
        """Pass on what was taken, until cancelled."""
        while True:
            batch = [order for order, _ in await self._queue.get_batch(CHECKED)]
            await self._has_room()
            for order, shortage in zip(batch, await self._settlement.shortages(batch), strict=True):
                if shortage:
                    self._drops.count("unfunded", order.signer)
                    self._settlement.set_aside(order, shortage)
                else:
                    self._settlement.add(order)


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
            due = [order for order in (self._next_due() for _ in range(CHECKS)) if order is not None]
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
