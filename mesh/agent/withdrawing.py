"""Withdrawals on the chain that a reorganisation reverts are made again."""

from __future__ import annotations

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


async def withdraw_again(parts: AgentComponents) -> None:
    """Withdraw each order on the chain again whose withdrawal the chain has lost, until its deadline.

    Without that, somebody could still make a contract of it. In generation 5, no later order of the account would be
    valid, either: their nonces are ahead of the chain's.
    """
    for order in await parts.ledger.withdrawn_on_chain(head=parts.chain_head.head):
        try:
            await parts.chain.retrying(partial(_ensure, parts, order), outages=parts.outages)
        except AiraError as error:
            facts = log_event("order-not-withdrawn", order=order.identity, code=error.code)
            log.warning("the order %s is not withdrawn on the chain any more: %s", order.identity, error, extra=facts)


async def _ensure(parts: AgentComponents, withdrawn: WithdrawnOrder) -> None:
    order, liabilities = decode(withdrawn.payload), parts.chain.liabilities
    assert isinstance(order, Demand | Offer)
    digest = bytes.fromhex(withdrawn.identity)
    if await liabilities.is_used(order, order_hash=digest, signer=parts.signer.address):
        return
    if await parts.chain.node.has_transaction(withdrawn.tx):
        return  # it waits in the pool
    try:
        tx = (await liabilities.withdraw(order)).tx
    except OrderAlreadyUsed:
        return
    await parts.ledger.use_up(withdrawn.identity, tx)
    facts = log_event("order-withdrawn-again", order=withdrawn.identity, tx=tx)
    log.warning(
        "a reorganisation reverted the withdrawal of %s; it is withdrawn again", withdrawn.identity, extra=facts
    )
