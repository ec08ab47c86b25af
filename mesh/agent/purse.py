"""What an account's open orders may cost it, and the allowance that the contracts need for that."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from mesh.agent.errors import ShortOfFunds
from mesh.chain import Reverted

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.chain import Chain

log = logging.getLogger(__name__)


class Allowances:
    """What `account` has promised the factory, by order and token, in the token's smallest unit."""

    def __init__(self, chain: Chain, account: str) -> None:
        self._chain = chain
        self._account = account
        self._promised: dict[str, Mapping[str, int]] = {}
        self._approving = asyncio.Lock()

    async def promise(self, order: str, amounts: Mapping[str, int]) -> None:
        """Let the factory take `amounts` (by token) for `order`, on top of what the other open orders may cost.

        Raises `ShortOfFunds`, and then has promised nothing.
        """
        async with self._approving:
            for token, amount in amounts.items():
                if amount:
                    await self._allow(token, amount + sum(open_.get(token, 0) for open_ in self._promised.values()))
            self._promised[order] = amounts

    def forget(self, order: str) -> None:
        """The order was taken, or is open no more. Unknown ones are ignored."""
        self._promised.pop(order, None)

    async def _allow(self, token: str, needed: int) -> None:
        balance = await self._chain.tokens.balance(self._account, token=token)
        if balance < needed:
            raise ShortOfFunds(self._account, token, balance=balance, needed=needed)
        factory = self._chain.factory
        while await self._chain.tokens.allowance(self._account, factory, token=token) < needed:
            log.info("allowing the factory %d of token %s", needed, token)
            try:
                await self._chain.tokens.approve(factory, needed, token=token)
            except Reverted as error:
                if error.reason != "OutOfGas":
                    raise
                # An order was taken between the estimate and the block: to set an allowance that is used up costs more.
                log.info("allowing the factory once more: %s", error)
