"""Demands on their way to an agent's handlers: makers in turn, those who pay more first, nobody who can't pay.

Anybody can sign demands, with any number of keys. What a handler does with one may be expensive (fetching the
objective, offering), so few are handled at once, and those that pay nothing never take all places.
"""

from __future__ import annotations

import asyncio
from contextvars import ContextVar
from functools import partial
from typing import TYPE_CHECKING, Final

from mesh.agent.declines import BUSY, grounds_of
from mesh.agent.errors import Declined
from mesh.agent.handlers import call
from mesh.agent.offers import TooManyOffers
from mesh.content import ContentUnavailable
from mesh.flood import UNFUNDED_POLLS, FairQueue, Rate, RateLimiter
from mesh.work.database import LedgerUnusable
from mesh.work.objectives import Buyer, ObjectiveNotFetched

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.agent.declines import DeclinePublisher
    from mesh.agent.handlers import Handler
    from mesh.chain import Chain
    from mesh.errors import AiraError
    from mesh.flood import Drops, KnownSenders
    from mesh.network import Subscription
    from mesh.outage_log import OutageLog
    from schemas import Demand, Verified

HANDLED: Final = 32
"""Demands that are handled at once: to fetch the objective of one may take long."""
FREE_HANDLED: Final = 16
"""Of these, demands that pay nothing."""
FREE_RATE: Final = Rate(per_second=4.0, burst=64)
"""Demands that pay nothing and are handled. Each offer for one may become a job."""
CHECKED: Final = 512
"""Demands whose makers' funds are asked for at once."""
WAITING: Final = 16_384
"""Demands that wait for the check of their funds, and as many for a handler."""
LOGGED: Final = Rate(per_second=0.2, burst=20)
"""Failures of handlers with the same code that are logged."""

_handled: ContextVar[Buyer | None] = ContextVar("handled", default=None)
"""Whose demand the running code handles."""


def current_buyer() -> Buyer | None:
    """Whose demand the running handler handles; None outside of a demand's handler."""
    return _handled.get()


class DemandDispatcher:
    """Calls `handlers` with the demands of a subscription: `await dispatcher.run()`.

    A demand whose maker can't pay now is not handled, but its next copy is looked at again. Pay counts in `token` (an
    address) only. What is not handled is counted in `drops`; what makers with money should know goes to `declines`.
    """

    def __init__(
        self,
        subscription: Subscription[Demand],
        handlers: Sequence[Handler],
        *,
        chain: Chain,
        token: str,
        customers: KnownSenders,
        outages: OutageLog,
        declines: DeclinePublisher,
        drops: Drops,
    ) -> None:
        self._subscription = subscription
        self._handlers = handlers
        self._chain = chain
        self._token = token
        self._customers = customers
        self._outages = outages
        self._declines = declines
        self._drops = drops
        self._arrived: FairQueue[Verified[Demand]] = FairQueue(per_sender=WAITING, total=WAITING)
        self._funded: FairQueue[Verified[Demand]] = FairQueue(per_sender=WAITING, total=WAITING)
        self._changed = asyncio.Event()
        self._running = self._running_free = 0
        self._logged = RateLimiter(per_sender=LOGGED)
        self._free_rate = RateLimiter(per_sender=FREE_RATE, total=FREE_RATE)

    async def run(self) -> None:
        """Receive, check and handle demands, until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._receive(), name="demands")
            tasks.create_task(self._check(), name="funds of demands")
            await self._handle(tasks)

    async def _receive(self) -> None:
        async for demand in self._subscription:
            is_customer = demand.signer in self._customers
            for dropped in self._arrived.put(demand.signer, demand, priority=int(is_customer)):
                self._drop(dropped, "queue-full")

    async def _check(self) -> None:
        """Pass on the demands whose makers can pay."""
        while True:
            batch = await self._arrived.get_batch(CHECKED)
            question = partial(self._chain.costs.shortages, batch)
            shortages = await self._chain.retrying(question, outages=self._outages)
            for demand, shortage in zip(batch, shortages, strict=True):
                if shortage:
                    self._drop(demand, "unfunded", after=UNFUNDED_POLLS * self._chain.node.timing.poll_interval)
                    continue
                for dropped in self._funded.put(demand.signer, demand, priority=self._worth(demand)):
                    self._drop(dropped, "queue-full")
                    self._declines.decline(dropped, BUSY)
            self._changed.set()

    def _worth(self, demand: Verified[Demand]) -> int:
        """The priority of a demand: by the magnitude of its pay, and of two alike the customer's."""
        return 2 * self._chain.costs.worth(demand.message, token=self._token) + (demand.signer in self._customers)

    async def _handle(self, tasks: asyncio.TaskGroup) -> None:
        while True:
            self._changed.clear()
            while self._has_place():
                demand = self._funded.get_nowait()
                pays = self._chain.costs.worth(demand.message, token=self._token) > 0
                if not pays and not self._free_rate.allow(demand.signer):
                    self._drop(demand, "free-rate")
                    self._declines.decline(demand, BUSY)
                    continue
                self._running += 1
                self._running_free += not pays
                tasks.create_task(self._handle_one(demand, pays=pays), name="handler")
            await self._changed.wait()

    def _has_place(self) -> bool:
        top = self._funded.top
        if top is None or self._running >= HANDLED:
            return False
        return top > 1 or self._running_free < FREE_HANDLED

    async def _handle_one(self, demand: Verified[Demand], *, pays: bool) -> None:
        _handled.set(Buyer(demand.signer, pays))
        grounds = []
        try:
            for handler in self._handlers:
                error = await call(handler, demand, logged=self._is_logged)
                if isinstance(error, ObjectiveNotFetched):
                    self._drop(demand, f"objective-{error.reason}")
                elif isinstance(error, ContentUnavailable):
                    self._drop(demand, "objective-missing")
                elif error is not None and _may_pass(error):
                    self._drop(demand, error.code)
                if error is not None and (reason := grounds_of(error)) is not None:
                    grounds.append(reason)
            if grounds:
                self._declines.decline(demand, grounds[0])
        finally:
            self._running -= 1
            self._running_free -= not pays
            self._changed.set()

    def _is_logged(self, error: AiraError) -> bool:
        return not isinstance(error, ObjectiveNotFetched | Declined) and self._logged.allow(error.code)

    def _drop(self, demand: Verified[Demand], reason: str, *, after: float = 0.0) -> None:
        """Count a demand that is not handled now, and let its next copy through, `after` seconds."""
        self._drops.count(reason, demand.signer)
        self._subscription.forget(demand, after=after)


def _may_pass(error: AiraError) -> bool:
    """Whether a handler that ended with this error may succeed later: the node failed, a disk or a limit is full."""
    from mesh.chain import TransactionTimeout
    from mesh.chain.following import NODE_ERRORS

    return isinstance(error, (*NODE_ERRORS, TransactionTimeout, LedgerUnusable, TooManyOffers))
