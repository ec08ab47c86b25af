"""What is at stake in transactions that are under way, so that none of them makes another one fail.

Each transaction is simulated before it is sent, but the simulation may not know of those that were sent just before,
and a transaction that fails when it is mined costs gas. So what two transactions compete for is taken here first.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import asynccontextmanager, nullcontext
from typing import TYPE_CHECKING, TypeAlias

from mesh.chain import Holding

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
    from contextlib import AbstractContextManager

    from mesh.chain import Funding, OrderCosts
    from mesh.market.book import Match

    Stakes: TypeAlias = Mapping["Holding | str", int]
    """What a transaction takes: amounts of holdings, and by name what only one transaction may take at a time."""


class Commitments:
    """What the transactions under way take.

    `funding` asks the chain for what is there of holdings. What waits does so within `waiting()`.
    """

    def __init__(
        self,
        funding: Callable[[Sequence[Holding]], Awaitable[Mapping[Holding, Funding | None]]],
        *,
        waiting: Callable[[], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        self._funding = funding
        self._waiting = waiting
        self._taken: Counter[Holding | str] = Counter()
        self._there: dict[Holding, Funding | None] = {}
        """Of holdings of which something is taken: what there was after anything was given back the last time."""
        self._wanted: set[Holding] = set()
        self._asking = asyncio.Lock()
        self._released = asyncio.Event()

    @asynccontextmanager
    async def take(self, stakes: Stakes) -> AsyncIterator[None]:
        """Meanwhile take something, as soon as those before leave enough of it, or take nothing of the kind."""
        with self._waiting():
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
