"""The transaction that creates a liability from a match, unless an order of it is withdrawn before it is sent."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.chain import NodeUnreachable, TransactionTimeout
from mesh.errors import ChainError
from mesh.market.book import order_id

if TYPE_CHECKING:
    from mesh.chain import Chain, Created
    from mesh.market.book import Match
    from mesh.market.withdrawals import Withdrawals


class MatchWithdrawn(ChainError, code="match-withdrawn"):
    """An order of a match was withdrawn before a transaction was sent: no liability is created."""


class Creation:
    """The attempts to create the liability of `match` at `lighthouse` (address): `await creation.attempt()`."""

    def __init__(self, chain: Chain, lighthouse: str, match: Match, withdrawals: Withdrawals) -> None:
        self._chain = chain
        self._lighthouse = lighthouse
        self._match = match
        self._withdrawals = withdrawals
        self._may_be_sent = False

    async def attempt(self) -> Created:
        """Send the transaction and wait for it.

        Raises as `Liabilities.create`, and `MatchWithdrawn` if an order is withdrawn and no earlier attempt may still
        be mined.
        """
        if not self._may_be_sent and any(order_id(order) in self._withdrawals for order in self._match):
            raise MatchWithdrawn("an order was withdrawn before its contract was created")
        demand, offer = self._match
        try:
            return await self._chain.liabilities.create(self._lighthouse, demand.message, offer.message)
        except (NodeUnreachable, TransactionTimeout):
            self._may_be_sent = True
            raise
