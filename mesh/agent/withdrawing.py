"""Withdrawals on the chain that a reorganisation reverts are made again."""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING

from mesh.chain import OrderAlreadyUsed
from mesh.errors import AiraError
from mesh.log_context import log_event
from schemas import Demand, Offer, decode

if TYPE_CHECKING:
    from mesh.agent.components import AgentComponents
    from mesh.work.ledger import WithdrawnOrder

log = logging.getLogger(__name__)


class ChainWithdrawals:
    """The orders of an account that it has withdrawn on the chain."""

    def __init__(self, parts: AgentComponents) -> None:
        self._parts = parts
        self._lock = asyncio.Lock()

    async def make_again(self) -> None:
        """Withdraw each order again whose withdrawal the chain has lost, until its deadline.

        Without that, somebody could still make a contract of it. In generation 5, no later order of the account would
        be valid, either: their nonces are ahead of the chain's.
        """
        parts = self._parts
        async with self._lock:
            for order in await parts.ledger.withdrawn_on_chain(head=parts.chain_head.head):
                try:
                    await parts.chain.retrying(partial(self._ensure, order), outages=parts.outages)
                except AiraError as error:
                    facts = log_event("order-not-withdrawn", order=order.identity, code=error.code)
                    log.warning("order %s is not withdrawn on the chain now: %s", order.identity, error, extra=facts)

    async def _ensure(self, withdrawn: WithdrawnOrder) -> None:
        parts, order = self._parts, decode(withdrawn.payload)
        assert isinstance(order, Demand | Offer)
        digest = bytes.fromhex(withdrawn.identity)
        if await parts.chain.liabilities.is_used(order, order_hash=digest, signer=parts.signer.address):
            return
        if await parts.chain.node.has_transaction(withdrawn.tx):
            return  # it waits in the pool
        try:
            tx = (await parts.chain.liabilities.withdraw(order)).tx
        except OrderAlreadyUsed:
            return
        await parts.ledger.use_up(withdrawn.identity, tx)
        facts = log_event("order-withdrawn-again", order=withdrawn.identity, tx=tx)
        log.warning("a reorganisation reverted the withdrawal of %s; withdrawn again", withdrawn.identity, extra=facts)
