"""Trading: signs and posts the orders of an account, and waits for their contracts and for how those end."""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from mesh.agent.contract import Contract, WatchedContracts, fail_future
from mesh.agent.errors import OrderExpired, OrderRejected
from mesh.agent.orders import Allowances, Rejections
from mesh.errors import AiraError, ClosedError
from mesh.log_context import log_event
from mesh.market.book import Refusal
from mesh.role import Lifecycle
from schemas import ZERO_ADDRESS, Demand, Offer, message_hash

if TYPE_CHECKING:
    from collections.abc import Mapping
    from contextlib import AsyncExitStack

    from mesh.agent.components import AgentComponents
    from schemas import Liability
    from schemas.signing import Rejection

    Terms = Mapping[str, Any]

log = logging.getLogger(__name__)

AnOrder = TypeVar("AnOrder", Demand, Offer)


class _Overtaken(Exception):
    """The nonce of an order of generation 5 was used by another one of the account: it must be signed again."""


@dataclass
class _OpenOrder:
    """A signed order of ours that can still become a contract."""

    signed: Demand | Offer
    created: asyncio.Future[Contract] | None = None
    """What the caller of `Trader.demand` waits for."""

    @property
    def nonce(self) -> int | None:
        """In generation 5, which counts an account's orders."""
        return int(self.signed.nonce) if self.signed.generation == 5 else None


class Trader(Lifecycle):
    """Trades for one account: `async with Trader(components) as trader`.

    Leaving fails everything that is waited for with `ClosedError`. The runtime reports what happens on the chain.
    """

    title = "trader"

    def __init__(self, parts: AgentComponents) -> None:
        self._parts = parts
        self._chain = parts.chain
        self._address = parts.signer.address
        self._allowances = Allowances(parts.chain, self._address)
        self._rejections = Rejections(parts)
        self._orders: dict[str, _OpenOrder] = {}
        self.contracts = WatchedContracts(parts)
        """The contracts whose end is waited for."""

    @property
    def open_orders(self) -> frozenset[str]:
        """The hashes (hexadecimal) of the open orders."""
        return frozenset(self._orders)

    async def _open(self, stack: AsyncExitStack) -> None:
        stack.push_async_callback(self._close)

    async def _close(self) -> None:
        ended = ClosedError("the agent has ended", hint="run it again and ask for the contract")
        demands = {identity: order.created for identity, order in self._orders.items() if order.created is not None}
        for created in demands.values():
            fail_future(created, ended)
        self.contracts.fail(ended)
        for identity in demands:
            await self._parts.outbox.settle(identity)

    async def terms(self, *, model: str, objective: str, cost: int, token: str, validator: str, lifetime: int) -> Terms:
        """The fields that a demand and an offer share, with names resolved, valid for `lifetime` blocks."""
        settings, names = self._parts.settings, self._chain.names
        return {
            "model": await names.model(model),
            "objective": objective,
            "token": await names.address(token or settings.erc20_token),
            "cost": cost,
            "lighthouse": await names.address(settings.lighthouse_contract),
            "validator": await names.address(validator) if validator else ZERO_ADDRESS,
            "deadline": await self._chain.block_number() + lifetime,
            "sender": None if settings.generation == 3 else self._address,
        }

    def terms_of(self, order: Demand | Offer) -> Terms:
        """The terms of `order`, for an order of this account in the same generation."""
        shared = ("model", "objective", "token", "cost", "lighthouse", "validator", "deadline")
        terms = {field: getattr(order, field) for field in shared}
        return {**terms, "sender": None if order.generation == 3 else self._address}

    async def sign(self, kind: type[AnOrder], terms: Terms, **fee: Any) -> AnOrder:
        """An order with these terms and a fresh nonce, signed and not posted. Raises `UnsafeValidator`."""
        is_counted = terms["sender"] is not None
        nonce = await self._chain.liabilities.next_nonce(self._address) if is_counted else secrets.token_hex(32)
        order = kind(**terms, nonce=nonce, **fee)
        await self._chain.validators.check(order)
        return self._parts.signer.sign(order)

    async def demand(self, terms: Terms, *, validator_fee: int) -> Contract:
        """Sign and post a demand, and wait for the contract that is created from it.

        Approves the allowance that it needs. Raises `InsufficientTokens`, `OrderRejected` and `OrderExpired`.
        Cancelling stops the waiting and the resending; a demand that was sent may still become a contract.
        """
        costs = Counter({terms["token"]: terms["cost"]})
        costs[self._chain.xrt] += validator_fee
        while True:
            signed = await self.sign(Demand, terms, validator_fee=validator_fee)
            try:
                return await self._contract_of(signed, costs)
            except _Overtaken:
                order = message_hash(signed).hex()
                facts = log_event("demand-overtaken", order=order)
                log.info("demand %s is signed again: its nonce was used by another order", order, extra=facts)

    async def offer(self, terms: Terms, *, lighthouse_fee: int) -> str:
        """Sign and post an offer; returns its hash (hexadecimal). It is resent until it is matched or expires.

        Raises `InsufficientTokens`.
        """
        signed = await self.sign(Offer, terms, lighthouse_fee=lighthouse_fee)
        identity = message_hash(signed).hex()
        await self._allowances.ensure(identity, {self._chain.xrt: lighthouse_fee})
        self._orders[identity] = _OpenOrder(signed)
        await self._parts.outbox.post(signed)
        return identity

    async def contract(self, address: str) -> Contract:
        """The contract at `address`, to be waited for. Raises `NotALiability`."""
        return await self.contracts.read(await self._chain.names.address(address))

    async def matched(self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes) -> None:
        """A contract was created from these orders: stop sending ours.

        In generation 3 somebody else may have signed the terms of ours; ours then has the same hash and is still open.
        """
        demand = demand_hash.hex() if liability.promisee == self._address else ""
        offer = offer_hash.hex() if liability.promisor == self._address else ""
        taken = self._orders.get(demand)
        for identity in filter(None, (demand, offer)):
            self._close_order(identity)
            await self._parts.outbox.spend(identity, liability.address)
        is_known = self.contracts.created(liability, demand)
        if not is_known and taken is not None and taken.created is not None and not taken.created.done():
            log.info("created from the demand %s", demand, extra=log_event("contract-created", order=demand))
            taken.created.set_result(self.contracts.watch(liability, demand=demand))
        for identity, order in list(self._orders.items()):
            if order.nonce is not None and isinstance(order.signed, Offer):
                await self._renew_offer(identity, order.signed)
        used = None if taken is None else taken.nonce
        for order in self._orders.values():
            if used is not None and order.nonce is not None and order.nonce <= used:
                fail_future(order.created, _Overtaken())

    async def liability_reverted(self, address: str) -> None:
        """A reorganisation reverted the contract at `address`: send its orders again, until their deadline."""
        deadline = await self._parts.outbox.unspend(address)
        if deadline is not None:
            self.contracts.reverted(address, deadline)

    def new_head(self, block: int) -> None:
        """The chain has block `block`: orders, and reverted contracts, with an earlier deadline have expired."""
        for identity, order in list(self._orders.items()):
            if order.signed.deadline <= block:
                self._close_order(identity)
                fail_future(order.created, OrderExpired(identity, order.signed.deadline))
        self.contracts.expire(block)

    async def _contract_of(self, signed: Demand, costs: Mapping[str, int]) -> Contract:
        """Post a signed demand and wait for its contract."""
        identity = message_hash(signed).hex()
        created: asyncio.Future[Contract] = asyncio.get_running_loop().create_future()
        self._orders[identity] = _OpenOrder(signed, created)
        try:
            async with self._rejections.received(identity, partial(self._rejected, identity)):
                await self._allowances.ensure(identity, costs)
                await self._parts.outbox.post(signed)
                return await created
        finally:
            self._close_order(identity)
            if self.is_open:
                await self._parts.outbox.settle(identity)

    async def _renew_offer(self, identity: str, offer: Offer) -> None:
        """Sign an offer of generation 5 again: another order of the account was taken first, and used the nonce."""
        self._close_order(identity)
        post = partial(self.offer, self.terms_of(offer), lighthouse_fee=offer.lighthouse_fee)
        try:
            await self._chain.retrying(post, outages=self._parts.outages)
        except AiraError as error:
            facts = log_event("offer-abandoned", order=identity, code=error.code)
            log.warning("the offer %s can't be signed again: %s", identity, error, extra=facts)
        if identity not in self._orders:
            await self._parts.outbox.settle(identity)

    def _close_order(self, identity: str) -> None:
        self._orders.pop(identity, None)
        self._allowances.release(identity)

    async def _rejected(self, identity: str, rejection: Rejection) -> None:
        """A provider rejects an order. That means nothing if the order has become a contract, by any provider.

        Whether it has is known once this agent has read the chain up to the block at which the nonce was read.
        """
        if rejection.reason == Refusal.FULL:
            facts = log_event("order-deferred", order=identity, provider=rejection.provider, reason=rejection.reason)
            log.warning("provider %s has no room for the order %s now", rejection.provider, identity, extra=facts)
            return
        order = self._orders.get(identity)
        if order is None:
            return
        is_overtaken = order.nonce is not None and order.nonce < await self._chain.liabilities.next_nonce(self._address)
        await self._parts.chain_head.reached(await self._chain.block_number())
        if identity in self._orders:
            fail_future(order.created, _Overtaken() if is_overtaken else OrderRejected(rejection))
