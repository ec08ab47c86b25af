"""What orders need: an allowance for what they cost, makers who can pay, and a validator that they may name.

A validator is no lighthouse, and nothing that could become one. An offer on lighthouse L with validator V is, with the
same signature, a demand on lighthouse V with validator L: the format has the two addresses in swapped places. So a
stranger whose demand names a lighthouse as validator could use the offer of a robot that agrees to it as that robot's
demand, and take the cost from the robot. Our contracts refuse such orders when the liability is created; the originals
don't.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from typing import TYPE_CHECKING, Final

from mesh.chain.contracts import OriginalContracts
from mesh.chain.errors import InsufficientTokens, Reverted
from mesh.chain.funds import NO_TOKEN, SHORT_POLLS, Holding
from mesh.chain.lighthouses import Lighthouses
from mesh.errors import InputError
from mesh.flood import BoundedDict
from mesh.log_context import log_event
from schemas.address import ZERO_ADDRESS
from schemas.messages import Offer

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence

    from mesh.chain.contracts import Contracts
    from mesh.chain.funds import Funding, Funds
    from mesh.chain.tokens import Tokens
    from schemas import Liability, Verified
    from schemas.messages import Order

log = logging.getLogger(__name__)

REMEMBERED: Final = 4096
"""Validators whose verdict is remembered, the latest ones."""
RECHECK: Final = 60.0
"""Seconds after which a verdict is asked for again that a transaction can change."""
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


class UnsafeValidator(InputError, code="validator-unsafe"):
    """An order names a validator that is a lighthouse, or could become one: it could be used as another order."""

    def __init__(self, validator: str) -> None:
        super().__init__(
            f"the validator {validator} is a lighthouse, or an account that is not known on the chain",
            hint="name another validator, or none; an account is known once it has sent a transaction",
        )
        self.validator = validator


class Validators:
    """Verdicts on validators, each asked from the chain once. A contract or a lighthouse stays what it is.

    With the originals, an address without code must have sent a transaction: else it may be that of a lighthouse which
    somebody is about to create.
    """

    def __init__(self, contracts: Contracts, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._contracts = contracts
        self._clock = clock
        self._verdicts: BoundedDict[str, tuple[bool, float]] = BoundedDict(REMEMBERED)

    def known(self, validator: str) -> bool | None:
        """Whether orders may name the validator (EIP-55 address); None if the chain has to be asked."""
        if validator == ZERO_ADDRESS:
            return True
        verdict, until = self._verdicts.get(validator, (None, 0.0))
        return verdict if self._clock() < until else None

    async def is_safe(self, validator: str) -> bool:
        """Whether orders may name the validator. Raises `ChainError` if the chain can't be asked."""
        verdict = self.known(validator)
        if verdict is None:
            verdict, is_final = await self._ask(validator)
            self._verdicts[validator] = (verdict, math.inf if is_final else self._clock() + RECHECK)
        return verdict

    async def check(self, order: Order) -> None:
        """Raise `UnsafeValidator` if the order names a validator that it must not name; `ChainError`."""
        if not await self.is_safe(order.validator):
            raise UnsafeValidator(order.validator)

    def check_known(self, order: Order) -> None:
        """Like `check`, without asking the chain: a validator that is not known raises, too."""
        if not self.known(order.validator):
            raise UnsafeValidator(order.validator)

    async def _ask(self, validator: str) -> tuple[bool, bool]:
        """The verdict, and whether it is final."""
        if await Lighthouses(self._contracts).exists(validator):
            return False, True
        node = self._contracts.node
        if await node.code(validator):
            return True, True
        if not isinstance(self._contracts.version, OriginalContracts):
            return True, False
        has_sent = await node.transaction_count(validator) > 0
        return has_sent, has_sent


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
