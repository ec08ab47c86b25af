"""The terms of orders: filling them in, signing them, and the allowance that they need."""

from __future__ import annotations

import asyncio
import logging
import secrets
from typing import TYPE_CHECKING, Any, Final

from mesh.chain import InsufficientTokens, Reverted
from mesh.log_context import log_event
from schemas import ZERO_ADDRESS, Demand, Offer

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Mapping

    from mesh.agent.components import AgentComponents
    from mesh.chain import Chain

    Terms = Mapping[str, Any]

log = logging.getLogger(__name__)

REPEATED: Final = ("model", "objective", "token", "cost", "lighthouse", "validator", "sender")
"""The fields that are the same when an order is posted again; its nonce and perhaps its deadline are new."""
LIFETIME: Final = 600.0
"""Seconds for which an order is valid by default."""
FEWEST_BLOCKS: Final = 50
MOST_BLOCKS: Final = 20_000
"""The bounds of that in blocks, whatever time was measured between two blocks."""
MEASURED_BLOCKS: Final = 100
"""The latest blocks, from which the time between two blocks is measured."""
LEAST_AHEAD: Final = 4
MOST_AHEAD: Final = 16
"""An allowance that contracts have used up is approved for so many times what the open orders need, growing."""


class TermsWriter:
    """Fills in and signs the orders of one account, in the generation of its settings."""

    def __init__(self, parts: AgentComponents) -> None:
        self._settings = parts.settings
        self._chain = parts.chain
        self._signer = parts.signer
        self._chain_head = parts.chain_head

    async def terms(
        self, *, model: str, objective: str, cost: int, token: str, validator: str, lifetime: int | None
    ) -> Terms:
        """The fields that a demand and an offer share, with names resolved, valid for `lifetime` blocks.

        By default they are valid for about `LIFETIME` seconds.
        """
        settings, names = self._settings, self._chain.names
        blocks = await default_lifetime(self._chain) if lifetime is None else lifetime
        return {
            "model": await names.model(model),
            "objective": objective,
            "token": await names.address(token or settings.erc20_token),
            "cost": cost,
            "lighthouse": await names.address(settings.lighthouse_contract),
            "validator": await names.address(validator) if validator else ZERO_ADDRESS,
            "deadline": (await self._chain.node.heads.recent()).number + blocks,
            "sender": None if settings.generation == 3 else self._signer.address,
        }

    def terms_of(self, order: Demand | Offer) -> Terms:
        """The terms of `order`, for an order of this account in the same generation that answers it.

        The deadline is a stranger's: it counts up to the setting `deadline_limit`.
        """
        latest = self._chain_head.head + self._settings.deadline_limit
        return {**self._repeated(order), "deadline": min(order.deadline, latest)}

    def _repeated(self, order: Demand | Offer) -> Terms:
        terms = {field: getattr(order, field) for field in (*REPEATED, "deadline")}
        return {**terms, "sender": None if order.generation == 3 else self._signer.address}

    async def sign(self, kind: type[Demand | Offer], terms: Terms, **fee: Any) -> Demand | Offer:
        """An order with these terms and a fresh nonce, signed. Raises `UnsafeValidator`."""
        is_counted = terms["sender"] is not None
        nonce = await self._chain.liabilities.next_nonce(self._signer.address) if is_counted else secrets.token_hex(32)
        order = kind(**terms, nonce=nonce, **fee)
        await self._chain.validators.check(order)
        return self._signer.sign(order)

    async def sign_again(self, order: Demand | Offer) -> Demand | Offer:
        """An order like this one, with a fresh nonce."""
        if isinstance(order, Demand):
            return await self.sign(Demand, self._repeated(order), validator_fee=order.validator_fee)
        return await self.sign(Offer, self._repeated(order), lighthouse_fee=order.lighthouse_fee)


def is_repeated(demand: Demand, terms: Terms, *, validator_fee: int) -> bool:
    """Whether a demand differs from these terms in nonce and deadline only."""
    return demand.validator_fee == validator_fee and all(getattr(demand, field) == terms[field] for field in REPEATED)


async def default_lifetime(chain: Chain) -> int:
    """How many blocks an order is valid by default: about `LIFETIME`, by the time between the latest blocks."""
    block_time = await chain.node.heads.block_time(MEASURED_BLOCKS)
    return round(LIFETIME) if block_time is None else min(max(round(LIFETIME / block_time), FEWEST_BLOCKS), MOST_BLOCKS)


class Allowances:
    """The allowance of the factory: what the orders of `account` may cost, by order and token (smallest unit)."""

    def __init__(self, chain: Chain, account: str) -> None:
        self._chain = chain
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
        factory, tokens = self._chain.factory, self._chain.tokens
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
