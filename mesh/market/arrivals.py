"""What arrives at a provider: orders, settled first or held until there is room for them, and results of contracts."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from mesh.flood import FairQueue

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from mesh.flood import Drops, KnownSenders
    from mesh.market.book import Order
    from mesh.market.settlement import Settlement
    from mesh.market.transaction_queue import TransactionQueue
    from mesh.network import Subscription
    from schemas import Result, SignedMessage, Verified

M = TypeVar("M", bound="SignedMessage")

CHECKED: Final = 512
"""Orders whose makers' funds are asked for at once."""
WAITING: Final = 32_768
"""Orders that wait for that."""
LOOKED_UP: Final = 100
"""Results whose contracts are looked up in one call."""
RESULTS_OF_SIGNER: Final = 64
"""Results of one signer that wait for that …"""
RESULTS: Final = 4096
"""… and results in all."""


class _Waiting(Generic[M]):
    """Messages that wait, with the subscriptions that they came from: those of `known` signers go first."""

    def __init__(self, known: KnownSenders, drops: Drops, *, per_sender: int, total: int) -> None:
        self._known = known
        self._drops = drops
        self._queue: FairQueue[tuple[Verified[M], Subscription[Any]]] = FairQueue(per_sender=per_sender, total=total)

    def put(self, message: Verified[M], source: Subscription[Any]) -> None:
        """Let a message wait; what is dropped for it is counted, and taken when it is sent again."""
        is_known = message.signer in self._known
        for dropped, subscription in self._queue.put(message.signer, (message, source), priority=int(is_known)):
            self._drops.count("queue-full", dropped.signer)
            subscription.forget(dropped)

    async def get(self, limit: int) -> list[tuple[Verified[M], Subscription[Any]]]:
        """Wait for the next messages, `limit` of them at most."""
        return await self._queue.get_batch(limit)


class OrderArrivals:
    """Takes orders from subscriptions (`take`), and passes them to `settlement` (`run`).

    Those of known signers go first. What an order says that it pays (`worth`, a priority) counts only when its maker
    can pay it. While `queue` is full of transactions that are worth as much, an order is held.
    """

    def __init__(
        self,
        settlement: Settlement,
        queue: TransactionQueue,
        *,
        worth: Callable[[Order], int],
        known: KnownSenders,
        drops: Drops,
    ) -> None:
        self._settlement = settlement
        self._transactions = queue
        self._worth = worth
        self._drops = drops
        self._arrived: _Waiting[Order] = _Waiting(known, drops, per_sender=WAITING, total=WAITING)
        self._held: _Waiting[Order] = _Waiting(known, drops, per_sender=WAITING, total=WAITING)

    async def take(self, orders: Subscription[Any]) -> None:
        """Take the open orders of other providers, then those that are published, until cancelled."""
        await orders.recall()
        async for order in orders:
            self._arrived.put(order, orders)

    async def run(self) -> None:
        """Pass on what was taken, until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._pass_arrived(), name="arrived orders")
            tasks.create_task(self._pass_held(), name="held orders")

    async def _pass_arrived(self) -> None:
        while True:
            batch = await self._arrived.get(CHECKED)
            await asyncio.sleep(0)  # the transactions of the batch before enter the queue
            settled = []
            for order, orders in batch:
                if self._transactions.has_room_for(self._worth(order.message)):
                    settled.append(order)
                else:
                    self._held.put(order, orders)
            await self._pass(settled)

    async def _pass_held(self) -> None:
        while True:
            batch = await self._held.get(CHECKED)
            await self._transactions.has_room()
            await self._pass([order for order, _ in batch])

    async def _pass(self, orders: Sequence[Verified[Order]]) -> None:
        if not orders:
            return
        for order, shortage in zip(orders, await self._settlement.shortages(orders), strict=True):
            if shortage:
                self._drops.count("unfunded", order.signer)
                self._settlement.set_aside(order, shortage)
            else:
                self._settlement.add(order)


class ResultArrivals:
    """Takes results from a subscription (`take`), and passes them to `settlement`.

    Those of open contracts that it knows go on at once. The others wait until the chain was asked for their contracts
    (`run`), for many in one call: a stranger can sign any number.
    """

    def __init__(self, settlement: Settlement, *, known: KnownSenders, drops: Drops) -> None:
        self._settlement = settlement
        self._unknown: _Waiting[Result] = _Waiting(known, drops, per_sender=RESULTS_OF_SIGNER, total=RESULTS)

    async def take(self, results: Subscription[Result]) -> None:
        """Take what is published, until cancelled."""
        async for result in results:
            if (liability := self._settlement.events.open.get(result.message.liability)) is not None:
                await self._settlement.results.settle(result, liability)
            else:
                self._unknown.put(result, results)

    async def run(self) -> None:
        """Look up the contracts of the others, until cancelled."""
        while True:
            batch = [result for result, _ in await self._unknown.get(LOOKED_UP)]
            found = await self._settlement.events.liabilities([result.message.liability for result in batch])
            for result in batch:
                await self._settlement.results.settle(result, found.get(result.message.liability))
