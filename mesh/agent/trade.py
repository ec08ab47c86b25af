"""Trading: orders made, signed and posted; the contract that comes of a demand, and its result."""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from mesh.agent.contract import Contract, Outcome
from mesh.agent.errors import ContractTakenBack, OrderExpired, OrderRejected
from mesh.agent.purse import Allowances
from mesh.agent.rejections import Rejections
from mesh.chain import NodeUnreachable, RequestRefused
from mesh.errors import AiraError, ClosedError
from mesh.market.book import Refusal
from mesh.telemetry.context import liability_context, log_event
from schemas import ZERO_ADDRESS, Demand, Offer, message_hash

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.agent.components import AgentComponents
    from mesh.chain import Chain
    from schemas import Liability
    from schemas.signing import Rejection

    Terms = Mapping[str, Any]

log = logging.getLogger(__name__)

AnOrder = TypeVar("AnOrder", Demand, Offer)


class _Overtaken(Exception):
    """Generation 5 counts an account's orders: another one was taken before this one, which has to be signed anew."""


class Trader:
    """Makes the orders of one account and waits for what comes of them, until `close`."""

    def __init__(self, parts: AgentComponents, chain: Chain) -> None:
        self._parts = parts
        self._chain = chain
        self._address = parts.signer.address
        self._purse = Allowances(chain, self._address)
        self._rejections = Rejections(
            parts.network.session,
            chain,
            market=parts.channel.lighthouse,
            lighthouse=parts.settings.lighthouse_contract,
        )
        self._matches: dict[str, asyncio.Future[Contract]] = {}
        self._nonces: dict[str, int] = {}
        self._deadlines: dict[str, int] = {}
        self._counted: dict[str, tuple[Terms, int]] = {}
        self._endings: dict[str, asyncio.Future[Outcome]] = {}
        self._contracts: dict[str, Contract] = {}
        self._unmade: dict[str, int] = {}
        self._closed = False
        self._progress = asyncio.Event()

    async def close(self) -> None:
        """Nothing is heard of any more: who waits for a contract, or for its end, gets `ClosedError`."""
        self._closed = True
        waiters: list[asyncio.Future[Any]] = [*self._matches.values(), *self._endings.values()]
        for waiting in waiters:
            if not waiting.done():
                waiting.set_exception(ClosedError("the agent has ended", hint="run it again and ask for the contract"))
                waiting.exception()  # taken note of: perhaps nobody waits for it
        for identity in list(self._matches):
            await self._parts.outbox.settle(identity)

    async def terms(self, *, model: str, objective: str, cost: int, token: str, validator: str, lifetime: int) -> Terms:
        """The fields that a demand and an offer share, names looked up, with a deadline."""
        settings, chain = self._parts.settings, self._chain
        return {
            "model": await chain.names.model(model),
            "objective": objective,
            "token": await chain.names.address(token or settings.erc20_token),
            "cost": cost,
            "lighthouse": await chain.names.address(settings.lighthouse_contract),
            "validator": await chain.names.address(validator) if validator else ZERO_ADDRESS,
            "deadline": await chain.block_number() + lifetime,
            "sender": None if settings.generation == 3 else self._address,
        }

    def mirrored(self, order: Demand | Offer) -> Terms:
        """The terms of the counterpart of `order`, in its generation."""
        kept = ("model", "objective", "token", "cost", "lighthouse", "validator", "deadline")
        terms = {field: getattr(order, field) for field in kept}
        return {**terms, "sender": None if order.generation == 3 else self._address}

    async def demand(self, terms: Terms, *, validator_fee: int) -> Contract:
        """Sign and post a demand, and wait for the contract that it becomes.

        The factory is given the allowance that the demand needs. Raises `ShortOfFunds`, `OrderRejected`,
        `OrderExpired`. Cancelling stops the waiting and the resending; what was sent may still be matched.
        """
        costs = Counter({terms["token"]: terms["cost"]})
        costs[self._chain.xrt] += validator_fee
        while True:
            signed = await self._signed(Demand, terms, validator_fee=validator_fee)
            try:
                return await self._contract_of(signed, costs)
            except _Overtaken:
                order = message_hash(signed).hex()
                log.info(
                    "demand %s is signed anew: its nonce was used meanwhile",
                    order,
                    extra=log_event("unnamed", order=order),
                )

    async def offer(self, terms: Terms, *, lighthouse_fee: int) -> str:
        """Sign and post an offer; returns its hash (hex). It is sent again until it is taken or its deadline passes.

        Raises `ShortOfFunds`.
        """
        signed = await self._signed(Offer, terms, lighthouse_fee=lighthouse_fee)
        identity = message_hash(signed).hex()
        await self._purse.promise(identity, {self._chain.xrt: lighthouse_fee})
        self._deadlines[identity] = signed.deadline
        if signed.generation == 5:
            self._counted[identity] = terms, lighthouse_fee
        await self._parts.outbox.post(signed)
        return identity

    async def matched(self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes) -> None:
        """A contract was made of these orders; ours among them need not be sent again.

        In generation 3 others may have signed the terms of ours, which then has the same hash and is still open.
        """
        is_ours = {demand_hash: liability.promisee == self._address, offer_hash: liability.promisor == self._address}
        for identity in (order.hex() for order, ours in is_ours.items() if ours):
            self._forget(identity)
            await self._parts.outbox.spend(identity, liability.address)
        if is_ours[demand_hash]:
            self._made(demand_hash.hex(), liability)
        for identity in list(self._counted):
            await self._offer_anew(identity)
        used = self._nonces.get(demand_hash.hex())
        for identity, nonce in self._nonces.items():
            if used is not None and nonce <= used and not self._matches[identity].done():
                self._matches[identity].set_exception(_Overtaken())

    async def unmade(self, address: str) -> None:
        """There is no contract at `address` after all; its orders are sent again, until their deadline."""
        deadline = await self._parts.outbox.unspend(address)
        if deadline is not None and address in self._endings:
            self._unmade[address] = deadline

    async def contract(self, address: str) -> Contract:
        """The contract at `address`, to be waited for. Raises `NotALiability`."""
        address = await self._chain.names.address(address)
        known = address in self._endings
        self._ending(address)  # before it is read: it may end in between
        try:
            return self._contract(await self._chain.liabilities.get(address))
        except BaseException:
            if not known:
                self._endings.pop(address, None)
            raise

    def finalized(self, address: str, outcome: Outcome) -> None:
        """The contract at `address` has ended."""
        ended = self._endings.pop(address, None)
        self._contracts = {demand: made for demand, made in self._contracts.items() if made.address != address}
        if ended is not None and not ended.done():
            with liability_context(address):
                log.info("it has ended, %s", "paid" if outcome.success else "refunded")
            ended.set_result(outcome)

    def passed(self, block: int) -> None:
        """Block `block` is there: orders whose deadline it reaches have expired."""
        self._progress.set()
        self._progress = asyncio.Event()
        for identity, deadline in list(self._deadlines.items()):
            if deadline <= block:
                self._forget(identity)
                matched = self._matches.get(identity)
                if matched is not None and not matched.done():
                    matched.set_exception(OrderExpired(identity, deadline))
        for address, deadline in list(self._unmade.items()):
            if deadline <= block:
                self._lose(address, deadline)

    def _lose(self, address: str, deadline: int) -> None:
        """There will be no contract at `address` any more: its orders have expired."""
        del self._unmade[address]
        self._contracts = {demand: made for demand, made in self._contracts.items() if made.address != address}
        ended = self._endings.pop(address, None)
        if ended is not None and not ended.done():
            ended.set_exception(ContractTakenBack(address, deadline))
            ended.exception()  # taken note of: perhaps nobody waits for it

    async def _signed(self, kind: type[AnOrder], terms: Terms, **fee: Any) -> AnOrder:
        counted = terms["sender"] is not None
        nonce = await self._chain.liabilities.next_nonce(self._address) if counted else secrets.token_hex(32)
        return self._parts.signer.sign(kind(**terms, nonce=nonce, **fee))

    async def _contract_of(self, signed: Demand, costs: Mapping[str, int]) -> Contract:
        """Post a signed demand and wait for its contract."""
        identity = message_hash(signed).hex()
        matched: asyncio.Future[Contract] = asyncio.get_running_loop().create_future()
        self._matches[identity] = matched
        if signed.generation == 5:
            self._nonces[identity] = int(signed.nonce)
        try:
            async with self._rejections.heard(identity, partial(self._rejected, identity)):
                await self._purse.promise(identity, costs)
                self._deadlines[identity] = signed.deadline
                await self._parts.outbox.post(signed)
                return await matched
        finally:
            del self._matches[identity]
            self._nonces.pop(identity, None)
            self._forget(identity)
            if not self._closed:
                await self._parts.outbox.settle(identity)

    def _made(self, demand: str, liability: Liability) -> None:
        """A demand has become a contract; perhaps once more, at another address, after a reorganisation."""
        contract, matched = self._contracts.get(demand), self._matches.get(demand)
        self._unmade.pop(liability.address if contract is None else contract.address, None)
        if contract is not None and contract.address in self._endings:
            self._endings[liability.address] = self._endings.pop(contract.address)
            contract.liability = liability
        elif matched is not None and not matched.done():
            log.info("made of the demand %s", demand, extra=log_event("unnamed", order=demand))
            self._contracts[demand] = self._contract(liability)
            matched.set_result(self._contracts[demand])

    def _contract(self, liability: Liability) -> Contract:
        ended = self._ending(liability.address)
        if liability.is_finalized:
            self.finalized(liability.address, Outcome(success=liability.is_success, result=liability.result))
        return Contract(liability, ended, self._parts)

    def _ending(self, address: str) -> asyncio.Future[Outcome]:
        return self._endings.setdefault(address, asyncio.get_running_loop().create_future())

    async def _offer_anew(self, identity: str) -> None:
        """Sign an offer of generation 5 again: that counts an account's orders, and another one was taken first.

        Raises `NodeUnreachable` and `RequestRefused`, and may then be tried again.
        """
        terms, fee = counted = self._counted[identity]
        self._forget(identity)
        try:
            await self.offer(terms, lighthouse_fee=fee)
        except (NodeUnreachable, RequestRefused):
            self._counted[identity] = counted
            raise
        except AiraError as error:
            log.warning("the offer %s is given up: %s", identity, error, extra=log_event("unnamed", order=identity))
        await self._parts.outbox.settle(identity)

    def _forget(self, identity: str) -> None:
        self._purse.forget(identity)
        self._deadlines.pop(identity, None)
        self._counted.pop(identity, None)

    async def _rejected(self, identity: str, rejection: Rejection) -> None:
        """A provider rejects an order; it means nothing where the order has become a contract, by whatever provider.

        That is known when the chain has been read as far as it went when the nonce was asked for.
        """
        if rejection.reason == Refusal.FULL:
            known = log_event("unnamed", order=identity, reason=rejection.reason)
            log.warning("provider %s has no room for the order %s now", rejection.provider, identity, extra=known)
            return
        nonce = self._nonces.get(identity)
        overtaken = nonce is not None and nonce < await self._chain.liabilities.next_nonce(self._address)
        head = await self._chain.block_number()
        while self._parts.clock.head < head:
            await self._progress.wait()
        matched = self._matches.get(identity)
        if matched is not None and not matched.done():
            matched.set_exception(_Overtaken() if overtaken else OrderRejected(rejection))
