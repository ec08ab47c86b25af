"""Withdrawals on the chain that a reorganisation reverts are made again, and the nonces that it freed used up."""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING, Final

from mesh.agent.terms import TermsWriter
from mesh.chain import OrderAlreadyUsed
from mesh.errors import AiraError
from mesh.log_context import log_event
from schemas import Demand, Offer, decode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.agent.components import AgentComponents
    from mesh.agent.orders import TradedOrder
    from mesh.work.ledger import WithdrawnOrder

log = logging.getLogger(__name__)

LOOKS: Final = 3
"""Poll intervals to wait before a nonce counts as free: the node may have been a block behind."""


class ChainWithdrawals:
    """What an account withdraws on the chain unasked: orders that it has withdrawn there before, and freed nonces."""

    def __init__(self, parts: AgentComponents, orders: Mapping[str, TradedOrder]) -> None:
        self._parts = parts
        self._orders = orders
        """The account's orders that can still become contracts."""
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

    async def use_up_nonces(self, order: TradedOrder) -> None:
        """Use up the nonces before that of an open order, unless another open order of the account has one.

        In generation 5 a reorganisation may free them: it reverts the contract of an earlier order, which has expired
        or was withdrawn since. The open order may not be signed again with such a nonce: both could become contracts.
        """
        if self._lock.locked():
            return
        parts, write = self._parts, TermsWriter(self._parts, {}).sign_again
        async with self._lock:
            await asyncio.sleep(LOOKS * parts.chain.node.timing.poll_interval)
            try:
                while order.is_open:
                    nonce = await parts.chain.liabilities.next_nonce()
                    is_waiting = any(one.is_open and one.nonce == nonce for one in self._orders.values())
                    if is_waiting or order.nonce is None or order.nonce <= nonce:
                        return
                    await parts.chain.liabilities.withdraw(await write(order.signed))
                    facts = log_event("nonce-used-up", order=order.identity, nonce=nonce)
                    log.warning("the nonce %d before that of the %s was free; used up", nonce, order, extra=facts)
            except OrderAlreadyUsed:
                return  # another program of the account was faster
            except AiraError as error:
                facts = log_event("nonce-not-used-up", order=order.identity, code=error.code)
                log.warning("the nonce before that of the %s can't be used up now: %s", order, error, extra=facts)

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
