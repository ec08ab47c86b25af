"""The allowance that the factory needs for an account's open orders."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from mesh.agent.errors import FundsShort
from mesh.chain import Reverted
from mesh.log_context import log_event

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.chain import Chain

log = logging.getLogger(__name__)


class Allowances:
    """What the open orders of `account` may cost, by order and token, in the token's smallest unit."""

    def __init__(self, chain: Chain, account: str) -> None:
        self._chain = chain
        self._account = account
        self._amounts: dict[str, Mapping[str, int]] = {}
        self._approving = asyncio.Lock()

    async def ensure(self, order: str, amounts: Mapping[str, int]) -> None:
        """Make sure that the factory may take `amounts` (by token) for `order` and what the other open orders cost.

        Raises `FundsShort`; the order is then not counted.
        """
        async with self._approving:
            for token, amount in amounts.items():
                if amount:
                    others = sum(open_order.get(token, 0) for open_order in self._amounts.values())
                    await self._ensure(token, amount + others)
            self._amounts[order] = amounts

    def release(self, order: str) -> None:
        """Stop counting an order that is no longer open. Unknown ones are ignored."""
        self._amounts.pop(order, None)

    @property
    def orders(self) -> frozenset[str]:
        """The orders that are counted."""
        return frozenset(self._amounts)

    async def _ensure(self, token: str, needed: int) -> None:
        balance = await self._chain.tokens.balance(self._account, token=token)
        if balance < needed:
            raise FundsShort(self._account, token, balance=balance, needed=needed)
        factory = self._chain.factory
        while await self._chain.tokens.allowance(self._account, factory, token=token) < needed:
            facts = log_event("allowance-approved", token=token, amount=needed)
            log.info("approving an allowance of %d of token %s for the factory", needed, token, extra=facts)
            try:
                await self._chain.tokens.approve(factory, needed, token=token)
            except Reverted as error:
                if error.reason != "OutOfGas":
                    raise
                # An order became a contract between estimate and block: setting a used-up allowance costs more gas.
                facts = log_event("allowance-retried", token=token, amount=needed)
                log.info("approving the allowance again: %s", error, extra=facts)
