"""What settlement asks the chain about the state of liabilities, orders and accounts, through outages of the node."""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING

from mesh.chain import NoContracts, NotALiability, RequestRefused, Reverted
from mesh.outage_log import OutageLog

if TYPE_CHECKING:
    from mesh.chain import Chain
    from mesh.market.book import Order
    from schemas import Liability, Verified

log = logging.getLogger(__name__)


class SettlementState:
    """The state of the chain. Each question is asked again until the node answers; see `outages`."""

    def __init__(self, chain: Chain) -> None:
        self._chain = chain
        self.outages = OutageLog(log, "node")
        """Outages of the node while the state is read."""

    async def liability(self, address: str) -> Liability | None:
        """The record of a liability; None while the node knows none at that address."""
        return await self._chain.retrying(partial(self._liability, address), outages=self.outages)

    async def is_used(self, order: Verified[Order]) -> bool:
        """Whether an order became a liability, or was withdrawn on the chain."""
        return await self._chain.retrying(partial(self._is_used, order), outages=self.outages)

    async def has_mined(self, tx: str) -> bool:
        """Whether the node has a transaction, waiting or mined with success."""
        return await self._chain.retrying(partial(self._has_mined, tx), outages=self.outages)

    async def can_pay(self, order: Verified[Order]) -> bool:
        """Whether an order's maker has, and allows the factory to take, what the order costs it.

        True if that can't be read: tokens are contracts of strangers.
        """
        return await self._chain.retrying(partial(self._can_pay, order), outages=self.outages)

    async def _liability(self, address: str) -> Liability | None:
        try:
            return await self._chain.liabilities.get(address)
        except (NotALiability, RequestRefused) as error:
            log.debug("a result waits to be sent again: %s", error)
            return None

    async def _is_used(self, order: Verified[Order]) -> bool:
        try:
            if order.message.generation == 3:
                return await self._chain.liabilities.is_order_used(order.hash, order.signer)
            return await self._chain.liabilities.next_nonce(order.signer) > int(order.message.nonce)
        except RequestRefused:
            return False  # a used order is rejected when its next match fails

    async def _has_mined(self, tx: str) -> bool:
        receipt = await self._chain.node.receipt(tx)
        return await self._chain.node.has_transaction(tx) if receipt is None else receipt.status == 1

    async def _can_pay(self, order: Verified[Order]) -> bool:
        tokens = self._chain.tokens
        try:
            for token, amount in tokens.costs_of(order.message).items():
                if amount and (
                    await tokens.balance(order.signer, token=token) < amount
                    or await tokens.allowance(order.signer, self._chain.factory, token=token) < amount
                ):
                    return False
        except (Reverted, RequestRefused, NoContracts):
            return True
        return True
