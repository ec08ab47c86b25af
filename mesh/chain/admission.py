"""What orders need: an allowance for what they cost, and makers who can pay it."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from mesh.chain.errors import InsufficientTokens, Reverted
from mesh.chain.funds import NO_TOKEN, SHORT_POLLS, Holding
from mesh.log_context import log_event
from schemas.messages import Offer

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Mapping, Sequence

    from mesh.chain.contracts import Contracts
    from mesh.chain.funds import Funding, Funds
    from mesh.chain.tokens import Tokens
    from schemas import Liability, Verified
    from schemas.messages import Order

log = logging.getLogger(__name__)

TOKEN_UNREADABLE: Final = "TokenUnreadable"
"""The reason of a rejection when a contract does not tell balances and allowances, so that it can't be paid with."""
LEAST_AHEAD: Final = 4
MOST_AHEAD: Final = 16
"""An allowance that contracts have used up is approved for so many times what the open orders need, growing."""


class OrderCosts:
    """What orders cost their makers, and whether these can pay it. `chain.costs`."""

    def __init__(self, contracts: Contracts, funds: Funds) -> None:
        self._xrt = contracts.xrt
        self._funds = funds

    def of(self, order: Order) -> Mapping[str, int]:
        """What the factory may take from the maker of an order, by token, in the token's smallest unit."""
        if isinstance(order, Offer):
            return {self._xrt: order.lighthouse_fee}
        costs = {order.token: order.cost}
        costs[self._xrt] = costs.get(self._xrt, 0) + order.validator_fee
        return costs

    async def shortages(self, orders: Sequence[Verified[Order]], *, fresh: bool = False) -> list[str]:
        """What each order's maker lacks to pay what the order costs it, as the contracts call it; empty if nothing.

        Without `fresh`, the answers may be a few poll intervals old. They are empty, too, if the node refuses them.
        Raises `NodeUnreachable`.
        """
        costs = [
            {Holding(token, order.signer): amount for token, amount in self.of(order.message).items() if amount}
            for order in orders
        ]
        known = await self._funds.of((holding for one in costs for holding in one), fresh=fresh)
        short = {holding for one in costs for holding, amount in one.items() if _lacks(known[holding], amount)}
        if short and not fresh:
            known = {**known, **await self._funds.of(short, within=SHORT_POLLS)}  # they may have paid in since
        return [
            next(filter(None, (_lacks(known[holding], amount) for holding, amount in one.items())), "") for one in costs
        ]

    def worth(self, order: Order | Liability, *, token: str = "") -> int:
        """The priority of an order, or of its liability, where there are too many: the magnitude of its cost.

        It is 0 unless the cost is in `token` (an address; XRT by default): anybody can make a token, and have any
        number of it.
        """
        return order.cost.bit_length() if order.token == (token or self._xrt) else 0


def _lacks(funding: Funding | None, amount: int) -> str:
    """What is missing to pay an amount; empty if nothing is, or nothing is known."""
    if funding is None or min(funding) >= amount:
        return ""
    if funding == NO_TOKEN:
        return TOKEN_UNREADABLE
    return "ERC20InsufficientAllowance" if funding.allowance < amount else "ERC20InsufficientBalance"


class Allowances:
    """The allowance of the factory: what the orders of `account` may cost, by order and token (smallest unit)."""

    def __init__(self, tokens: Tokens, factory: str, account: str) -> None:
        self._tokens = tokens
        self._factory = factory
        self._account = account
        self._open: dict[Hashable, Mapping[str, int]] = {}
        self._withdrawn: dict[Hashable, Mapping[str, int]] = {}
        self._approved: dict[str, int] = {}
        """By token: what this agent approved last."""
        self._ahead: dict[str, int] = {}
        self._approving = asyncio.Lock()

    async def ensure(self, order: Hashable, amounts: Mapping[str, int]) -> None:
        """Make sure that the factory may take `amounts` (by token) for `order` and what the other orders may cost.

        The account must own what its open orders cost; withdrawn ones only need the allowance. Raises
        `InsufficientTokens`; a new order is then not counted.
        """
        async with self._approving:
            for token, amount in amounts.items():
                if amount:
                    others = (costs for key, costs in self._open.items() if key != order)
                    funds = amount + _sum(others, token)
                    needed = funds + _sum(self._withdrawn.values(), token)
                    await self._ensure(token, funds=funds, needed=needed)
            if order not in self._withdrawn:
                self._open[order] = amounts

    def count(self, order: Hashable, amounts: Mapping[str, int]) -> None:
        """Count an order of an earlier run, whose allowance was approved then."""
        self._open[order] = amounts

    def withdraw(self, order: Hashable) -> None:
        """Count an order that is withdrawn, but may become a contract all the same."""
        if order in self._open:
            self._withdrawn[order] = self._open.pop(order)

    def release(self, order: Hashable) -> None:
        """Stop counting an order that can't become a contract any more. Unknown ones are ignored."""
        self._open.pop(order, None)
        self._withdrawn.pop(order, None)

    async def _ensure(self, token: str, *, funds: int, needed: int) -> None:
        factory, tokens = self._factory, self._tokens
        balance, allowed = await tokens.balance_and_allowance(self._account, factory, token=token)
        if balance < funds:
            raise InsufficientTokens(self._account, token, balance=balance, needed=funds)
        while allowed < needed:
            allowance = max(needed, min(self._times(token, allowed) * needed, balance))
            facts = log_event("allowance-approved", token=token, amount=allowance)
            log.info("approving an allowance of %d of token %s for the factory", allowance, token, extra=facts)
            try:
                await tokens.approve(factory, allowance, token=token)
                self._approved[token] = allowance
            except Reverted as error:
                if error.reason != "OutOfGas":
                    raise
                # An order became a contract between estimate and block: setting a used-up allowance costs more gas.
                facts = log_event("allowance-retried", token=token, amount=allowance)
                log.info("approving the allowance again: %s", error, extra=facts)
            allowed = await tokens.allowance(self._account, factory, token=token)

    def _times(self, token: str, allowed: int) -> int:
        """How many times what is needed is approved: more and more, when contracts have used up what was approved.

        A transaction for each order would cost more than the order.
        """
        if allowed < self._approved.get(token, 0):
            self._ahead[token] = min(max(LEAST_AHEAD, 2 * self._ahead.get(token, 0)), MOST_AHEAD)
        return self._ahead.get(token, 1)


def _sum(orders: Iterable[Mapping[str, int]], token: str) -> int:
    return sum(costs.get(token, 0) for costs in orders)
