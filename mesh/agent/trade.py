"""Trading: orders made, signed and posted; the contract that comes of a demand, and its result."""

from __future__ import annotations

import asyncio
import logging
import secrets
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.errors import AiraError
from schemas import ZERO_ADDRESS, Demand, InvalidRecord, Offer, market_selector, message_hash
from schemas.rejection import Rejection

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import zenoh

    from mesh.agent.parts import Parts
    from mesh.chain import Chain
    from schemas import Liability

log = logging.getLogger(__name__)

LIFETIME: Final = 1000
"""Blocks for which an order is valid unless told otherwise."""


class OrderRejected(AiraError):
    """A provider says that an order can't be used; `rejection` holds its machine-readable reason."""

    def __init__(self, rejection: Rejection) -> None:
        super().__init__(
            f"provider {rejection.provider} rejects the order ({rejection.reason}): {rejection.detail}",
            hint="mend what the reason names and post a new order",
        )
        self.rejection = rejection


class OrderExpired(AiraError):
    """An order's deadline has passed and nobody took it."""

    def __init__(self, order: str, deadline: int) -> None:
        super().__init__(
            f"nobody took the order {order[:16]}… until block {deadline}",
            hint="offer more, or give it a longer lifetime",
        )
        self.deadline = deadline


class ShortOfFunds(AiraError):
    """The account can't pay what it wants to promise: units of the token that it has, and that it needs."""

    def __init__(self, account: str, token: str, *, balance: int, needed: int) -> None:
        super().__init__(
            f"account {account} has {balance} of token {token}, and {needed} are needed",
            hint="send it the missing tokens, or lower the cost",
        )
        self.balance = balance
        self.needed = needed


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """How a contract ended: `success` means that the promisor was paid; `result` is the recording's CID, or empty."""

    success: bool
    result: str


class Contract:
    """A liability, from the side of one who waits for its end."""

    def __init__(self, liability: Liability, ended: asyncio.Future[Outcome], parts: Parts) -> None:
        self.liability = liability
        self._ended = ended
        self._parts = parts

    @property
    def address(self) -> str:
        """The contract's address (EIP-55)."""
        return self.liability.address

    async def outcome(self) -> Outcome:
        """Wait until the chain has finalized the contract. Cancelling the wait changes nothing."""
        return await asyncio.shield(self._ended)

    async def recording(self) -> Path:
        """The result's file: waits for the outcome, fetches the recording by its CID and checks every block.

        Raises a `ContentError` when nobody holds it.
        """
        outcome = await self.outcome()
        settings = self._parts.settings
        return await self._parts.exchange.fetch(
            outcome.result, size_limit=settings.objective_expanded_limit, timeout=settings.fetch_timeout
        )


class Trader:
    """Makes the orders of one account and waits for what comes of them."""

    def __init__(self, parts: Parts, chain: Chain) -> None:
        self._parts = parts
        self._chain = chain
        self._factory = chain.factory
        self._matches: dict[str, asyncio.Future[Contract]] = {}
        self._deadlines: dict[str, int] = {}
        self._endings: dict[str, asyncio.Future[Outcome]] = {}
        self._reserved: dict[str, int] = {}
        self._approving = asyncio.Lock()

    async def terms(
        self, *, model: str, objective: str, cost: int, token: str, validator: str, lifetime: int
    ) -> Mapping[str, Any]:
        """The fields that a demand and an offer share, names looked up, with a fresh nonce and a deadline."""
        settings, chain = self._parts.settings, self._chain
        address = self._parts.signer.address
        return {
            "model": await chain.resolve_model(model),
            "objective": objective,
            "token": await chain.resolve(token or settings.erc20_token),
            "cost": cost,
            "lighthouse": await chain.resolve(settings.lighthouse_contract),
            "validator": await chain.resolve(validator) if validator else ZERO_ADDRESS,
            "deadline": await chain.block_number() + lifetime,
            "nonce": secrets.token_hex(32) if settings.generation == 3 else await chain.nonce_of(address),
            "sender": None if settings.generation == 3 else address,
        }

    async def mirrored(self, order: Demand | Offer) -> Mapping[str, Any]:
        """The fields of the counterpart of `order`, in its generation."""
        address = self._parts.signer.address
        kept = ("model", "objective", "token", "cost", "lighthouse", "validator", "deadline")
        return {
            **{field: getattr(order, field) for field in kept},
            "nonce": secrets.token_hex(32) if order.generation == 3 else await self._chain.nonce_of(address),
            "sender": None if order.generation == 3 else address,
        }

    async def demand(self, demand: Demand) -> Contract:
        """Sign and post a demand, and wait for the contract that it becomes.

        The factory is given the allowance that the demand needs. Raises `ShortOfFunds`, `OrderRejected`,
        `OrderExpired`. Cancelling stops the waiting and the resending; what was sent may still be matched.
        """
        await self._allow(demand.token, demand.cost)
        await self._allow(self._chain.xrt, demand.validator_fee)
        signed = self._parts.signer.sign(demand)
        identity = message_hash(signed).hex()
        matched: asyncio.Future[Contract] = asyncio.get_running_loop().create_future()
        self._matches[identity] = matched
        self._deadlines[identity] = signed.deadline
        listener = self._hear_rejections(identity)
        try:
            await self._parts.outbox.post(signed)
            contract = await matched
        finally:
            listener.undeclare()
            del self._matches[identity], self._deadlines[identity]
            self._release(demand.token, demand.cost)
            self._release(self._chain.xrt, demand.validator_fee)
            await self._parts.outbox.settle(identity)
        return contract

    async def offer(self, offer: Offer) -> str:
        """Sign and post an offer; returns its hash (hex). It is sent again until it is taken or its deadline passes."""
        await self._allow(self._chain.xrt, offer.lighthouse_fee)
        signed = self._parts.signer.sign(offer)
        await self._parts.outbox.post(signed)
        return message_hash(signed).hex()

    async def matched(self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes) -> None:
        """A contract was made of these orders; they need not be sent again."""
        await self._parts.outbox.settle(offer_hash.hex())
        matched = self._matches.get(demand_hash.hex())
        if matched is not None and not matched.done():
            matched.set_result(self.contract(liability))

    def contract(self, liability: Liability) -> Contract:
        """The contract of `liability`, to be waited for."""
        ended = self._endings.setdefault(liability.address, asyncio.get_running_loop().create_future())
        if liability.is_finalized and not ended.done():
            ended.set_result(Outcome(success=liability.is_success, result=liability.result))
        return Contract(liability, ended, self._parts)

    def finalized(self, address: str, outcome: Outcome) -> None:
        """The contract at `address` has ended."""
        ended = self._endings.pop(address, None)
        if ended is not None and not ended.done():
            ended.set_result(outcome)

    def passed(self, block: int) -> None:
        """Block `block` is there: demands whose deadline it reaches have expired."""
        for identity, deadline in self._deadlines.items():
            matched = self._matches[identity]
            if deadline <= block and not matched.done():
                matched.set_exception(OrderExpired(identity, deadline))

    async def _allow(self, token: str, amount: int) -> None:
        """Let the factory take `amount` more of `token` than what open demands will already take."""
        if not amount:
            return
        address = self._parts.signer.address
        async with self._approving:
            needed = self._reserved.get(token, 0) + amount
            balance = await self._chain.balance_of(address, token=token)
            if balance < needed:
                raise ShortOfFunds(address, token, balance=balance, needed=needed)
            if await self._chain.allowance(address, self._factory, token=token) < needed:
                log.info("allowing the factory %d of token %s", needed, token)
                await self._chain.approve(self._factory, needed, token=token)
            self._reserved[token] = needed

    def _release(self, token: str, amount: int) -> None:
        if amount:
            self._reserved[token] -= amount

    def _hear_rejections(self, identity: str) -> Any:
        """Listen for providers that reject the order."""
        loop = asyncio.get_running_loop()

        def heard(sample: zenoh.Sample) -> None:
            try:
                rejection = Rejection.decode(sample.payload.to_bytes())
            except InvalidRecord as error:
                log.info("an unreadable rejection: %s", error)
                return
            loop.call_soon_threadsafe(self._rejected, identity, rejection)

        selector = market_selector(self._parts.channel.lighthouse, "reject").replace("/*/*", f"/{identity}/*")
        return self._parts.network.session.declare_subscriber(selector, heard)

    def _rejected(self, identity: str, rejection: Rejection) -> None:
        matched = self._matches.get(identity)
        if matched is not None and not matched.done() and rejection.order == identity:
            matched.set_exception(OrderRejected(rejection))
