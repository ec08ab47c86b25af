"""Sending the ledger's orders again: once the factory may take what they cost."""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING

from mesh.errors import AiraError
from mesh.log_context import log_event

if TYPE_CHECKING:
    from collections.abc import Collection, Container

    from mesh.agent.components import AgentComponents
    from mesh.agent.orders import TradedOrder
    from mesh.background import Background
    from mesh.chain import Allowances

log = logging.getLogger(__name__)


class CoveredOrders:
    """Sends orders of an account once their `allowances` are ensured. `known` are the hashes of those to be sent."""

    tasks: Background
    """Where it waits; set when there may be orders."""

    def __init__(self, parts: AgentComponents, known: Container[str], allowances: Allowances) -> None:
        self._parts, self._known, self._allowances = parts, known, allowances

    def send(self, orders: Collection[TradedOrder]) -> None:
        """Send these orders of the ledger when the factory has the allowance for them, in a task."""
        outbox, costs = self._parts.outbox, self._parts.chain.costs
        outbox.hold(order.identity for order in orders)
        costly = [order for order in orders if any(costs.of(order.signed).values())]
        if free := {order.identity for order in orders} - {order.identity for order in costly}:
            self.tasks.start(outbox.release(free), "resume free orders")
        for order in costly:
            self.tasks.start(self._cover_and_send(order), f"resume {order.identity}")

    async def _cover_and_send(self, order: TradedOrder) -> None:
        chain = self._parts.chain
        ensure = partial(self._allowances.ensure, order, chain.costs.of(order.signed))
        try:
            await chain.retrying(ensure, outages=self._parts.outages)
        except AiraError as error:
            facts = log_event("order-not-covered", order=order.identity, code=error.code)
            log.warning("the %s is open, but no provider can use it now: %s", order, error, extra=facts)
        if order.identity not in self._known:
            self._allowances.release(order)
        await self._parts.outbox.release([order.identity])
