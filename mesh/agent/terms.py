"""Writing orders: the terms of an account's demands and offers, their nonces and deadlines."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace

from mesh.flood import BoundedDict
from mesh.market.versions import lasting_hash
from schemas import ZERO_ADDRESS, Demand, Offer

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.agent.components import AgentComponents
    from mesh.agent.orders import TradedOrder
    from mesh.chain import Chain

    Terms = Mapping[str, Any]

REPEATED: Final = ("model", "objective", "token", "cost", "lighthouse", "validator", "sender")
"""The fields that are the same when an order is posted again; its nonce and perhaps its deadline are new."""
SIGNED_KEPT: Final = 256
"""Orders of generation 5 that a new one must differ from in more than its nonce."""
LIFETIME: Final = 600.0
"""Seconds for which an order is valid by default."""
FEWEST_BLOCKS, MOST_BLOCKS = 50, 20_000
"""The bounds of the default lifetime, whatever block time was measured."""
MEASURED_BLOCKS: Final = 100
"""The latest blocks, whose times give the block time."""


class TermsWriter:
    """Fills in and signs the orders of one account, in the generation of its settings. `known` has its others."""

    def __init__(self, parts: AgentComponents, known: Mapping[str, TradedOrder]) -> None:
        self._settings, self._signer, self._known = parts.settings, parts.signer, known
        self._signed: BoundedDict[str, None] = BoundedDict(SIGNED_KEPT)
        """The lasting hashes of the latest orders of generation 5."""
        self._chain, self._chain_head = parts.chain, parts.chain_head

    async def terms(
        self, *, model: str, objective: str, cost: int | str, token: str, validator: str, lifetime: int | None
    ) -> Terms:
        """The fields that a demand and an offer share, with names resolved, valid for `lifetime` blocks.

        By default they are valid for about `LIFETIME` seconds. Raises `InvalidAmount`, `NotAToken`.
        """
        settings, names = self._settings, self._chain.names
        if not isinstance(cost, int):
            cost = (await self._chain.tokens.unit(token or settings.erc20_token)).amount(cost)
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
        """The terms of a stranger's order, for one that answers it; its deadline counts up to `deadline_limit`."""
        latest = self._chain_head.head + self._settings.deadline_limit
        return {**self._repeated(order), "deadline": min(order.deadline, latest)}

    def _repeated(self, order: Demand | Offer) -> Terms:
        sender = None if order.generation == 3 else self._signer.address
        return {field: getattr(order, field) for field in (*REPEATED, "deadline")} | {"sender": sender}

    async def sign(self, kind: type[Demand | Offer], terms: Terms, **fee: Any) -> Demand | Offer:
        """An order with these terms and a fresh nonce, signed. Raises `UnsafeValidator`."""
        order = await self._complete(kind, terms, **fee)
        if order.generation == 5:  # else it would be a version of another order
            known = {lasting_hash(one.signed) for one in self._known.values()} | self._signed.keys()
            while lasting_hash(order) in known:
                order = replace(order, deadline=order.deadline - 1)
            self._signed[lasting_hash(order)] = None
        return self._signer.sign(order)

    async def sign_again(self, order: Demand | Offer) -> Demand | Offer:
        """An order like this one, with a fresh nonce."""
        terms = self._repeated(order)
        if isinstance(order, Demand):
            return self._signer.sign(await self._complete(Demand, terms, validator_fee=order.validator_fee))
        return self._signer.sign(await self._complete(Offer, terms, lighthouse_fee=order.lighthouse_fee))

    async def _complete(self, kind: type[Demand | Offer], terms: Terms, **fee: Any) -> Demand | Offer:
        is_counted = terms["sender"] is not None
        nonce = await self._chain.liabilities.next_nonce(self._signer.address) if is_counted else secrets.token_hex(32)
        order = kind(**terms, nonce=nonce, **fee)
        await self._chain.validators.check(order)
        return order


def is_repeated(demand: Demand, terms: Terms, *, validator_fee: int) -> bool:
    """Whether a demand differs from these terms in nonce and deadline only."""
    return demand.validator_fee == validator_fee and all(getattr(demand, field) == terms[field] for field in REPEATED)


async def default_lifetime(chain: Chain) -> int:
    """How many blocks an order is valid by default: about `LIFETIME`, by the time between the latest blocks."""
    block_time = await chain.node.heads.block_time(MEASURED_BLOCKS)
    return round(LIFETIME) if block_time is None else min(max(round(LIFETIME / block_time), FEWEST_BLOCKS), MOST_BLOCKS)
