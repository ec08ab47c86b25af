"""The orders that arrive at a provider: which are settled first, and which wait until their makers can pay."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from mesh.flood import FairQueue

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.flood import Drops, KnownSenders
    from mesh.market.book import Order
    from mesh.market.settlement import Settlement
    from mesh.network import Subscription
    from schemas import Verified

CHECKED: Final = 512
"""Orders whose makers' funds are asked for at once."""
WAITING: Final = 32_768
"""Orders that wait for that."""


class Arrivals:
    """Takes orders from subscriptions (`take`), and passes them to `settlement` (`run`).

    Those of known signers go first. What an order says that it pays counts only when its maker can pay it.
    """

    def __init__(
        self, settlement: Settlement, *, known: KnownSenders, has_room: Callable[[], Awaitable[None]], drops: Drops
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
