"""The provider: brings demands and offers together, and pays out when the work is done.

A provider keeps nothing on disk. Orders and Results are sent again by those who made them until their effect is on the
chain, and the chain refuses to make a contract twice, so a provider that was killed starts empty and catches up.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from contextlib import AsyncExitStack, aclosing
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import msgspec

from mesh.chain import (
    History,
    NoContracts,
    NodeUnreachable,
    NotALiability,
    Reorganised,
    RequestRefused,
    Reverted,
)
from mesh.chain.events import Finalized, NewLiability
from mesh.errors import AiraError, ClosedError, InputError
from mesh.market.blame import at_fault, word_for
from mesh.market.book import LIMIT, Match, OrderBook, Refusal
from mesh.market.memory import Memory
from mesh.market.sending import RETRY, Sending
from mesh.market.used import Used
from mesh.network.channel import Channel
from schemas import ZERO_ADDRESS, Demand, Offer, RejectKey, Result, Verified, address_bytes
from schemas.rejection import Rejection

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    import zenoh

    from mesh.chain import BlockEvents, Chain
    from mesh.market.book import Order
    from mesh.network import Subscription
    from schemas import Liability

log = logging.getLogger(__name__)


class Earnings(msgspec.Struct, frozen=True, kw_only=True):
    """What a provider did so far: contracts made and finalized, orders rejected by reason, gas spent, fees won (wn)."""

    created: int
    finalized: int
    rejected: dict[str, int]
    gas_used: int
    fees: int


class Provider:
    """A provider of one lighthouse: `async with Provider(session, chain, lighthouse) as provider`, then `run`.

    `lighthouse` is the ENS name; the chain's account must have its stake there. `matched` is told of each pair before
    its contract is made. Session and chain stay the caller's to close.
    """

    def __init__(
        self,
        session: zenoh.Session,
        chain: Chain,
        lighthouse: str,
        *,
        limit: int = LIMIT,
        matched: Callable[[Match], None] = lambda match: None,
    ) -> None:
        if chain.account is None:
            raise ValueError("a provider needs a chain with an account")
        self.address = chain.account.address
        self._session = session
        self._chain = chain
        self._lighthouse = lighthouse.lower()
        self._limit = limit
        self._matched = matched
        self._head = 0
        self._stack: AsyncExitStack | None = None
        self._history = History()
        self._liabilities: dict[str, Liability] = {}
        self._used = Used()
        self._rejected: Counter[str] = Counter()
        self._created = self._finalized = self._gas = self._fees = 0

    async def __aenter__(self) -> Self:
        self._head = await self._chain.block_number()
        self._market = await self._chain.resolve(self._lighthouse)
        self.book = OrderBook(self._market, limit=self._limit)
        self.book.expire(self._head)
        self._sending = Sending(self._chain, self._market)
        async with AsyncExitStack() as stack:
            self.channel = await stack.enter_async_context(
                Channel(
                    self._session,
                    self._lighthouse,
                    address=self._market,
                    resolver=self._chain.resolve,
                    head=lambda: self._head,
                )
            )
            self._demands = await stack.enter_async_context(self.channel.subscribe(Demand))
            self._offers = await stack.enter_async_context(self.channel.subscribe(Offer))
            self._results = await stack.enter_async_context(self.channel.subscribe(Result))
            await stack.enter_async_context(Memory(self._session, self._lighthouse, self.book))
            self.channel.announce("provider", self.address)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        stack, self._stack = self._stack, None
        if stack is not None:
            await stack.aclose()

    async def run(self) -> None:
        """Serve the lighthouse until cancelled. A transaction that is on its way then may still go through."""
        if self._stack is None:
            raise ClosedError("the provider is not open", hint="use it inside `async with`")
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._take(self._demands), name="provider demands")
            tasks.create_task(self._take(self._offers), name="provider offers")
            tasks.create_task(self._take_results(), name="provider results")
            tasks.create_task(self._follow_chain(), name="provider chain")
            tasks.create_task(self._sending.run(), name="provider transactions")

    def earnings(self) -> Earnings:
        """What was done and spent so far."""
        return Earnings(
            created=self._created,
            finalized=self._finalized,
            rejected=dict(self._rejected),
            gas_used=self._gas,
            fees=self._fees,
        )

    async def _take(self, orders: Subscription[Any]) -> None:
        await orders.recall()
        async for order in orders:
            await self._sending.room()
            if self._add(order) is Refusal.FULL:
                orders.forget(order)

    def _add(self, order: Verified[Order]) -> Refusal | None:
        """Take an order into the book, or to the chain with its counterpart; or say why not."""
        outcome = self.book.add(order)
        if isinstance(outcome, Match):
            log.info("matched demand %s and offer %s", outcome.demand.hash.hex(), outcome.offer.hash.hex())
            self._matched(outcome)
            self._sending.put(partial(self._create, outcome))
        elif isinstance(outcome, Refusal):
            if outcome is not Refusal.DUPLICATE:
                self._reject(order, outcome.value, f"the order book refuses it: {outcome.value}")
            return outcome
        return None

    async def _create(self, match: Match) -> None:
        """Make the contract of a match; what can't become one leaves the market, the other order stays."""
        demand, offer = match
        try:
            created = await self._sending.send(
                lambda: self._chain.create_liability(self._market, demand.message, offer.message)
            )
        except Reverted as error:
            await self._part(match, gone=at_fault(match, error.reason, error.arguments), error=error)
        except (NodeUnreachable, RequestRefused, InputError) as error:
            await self._part(match, gone=match, error=error)
        else:
            self._created += 1
            self._gas += created.gas_used
            self._fees += offer.message.lighthouse_fee
            self._used.add(created.liability, demand, offer)
            log.info("%s: created, gas %d", created.liability, created.gas_used)

    async def _part(self, match: Match, *, gone: tuple[Verified[Order], ...], error: AiraError) -> None:
        """Reject the orders that are to blame, and put back the other one, unless it was used meanwhile."""
        for order in match:
            if order in gone:
                self._reject(order, _reason(error), str(error))
            elif not await self._sending.ask(partial(self._is_used, order)):
                self._add(order)

    async def _is_used(self, order: Verified[Order]) -> bool:
        try:
            if order.message.generation == 3:
                return await self._chain.is_order_used(order.hash)
            return await self._chain.nonce_of(order.signer) > int(order.message.nonce)
        except RequestRefused:
            return False  # the contracts will say so when it is matched

    async def _take_results(self) -> None:
        async for result in self._results:
            await self._sending.room()
            liability = await self._sending.ask(partial(self._liability, result.message.liability))
            if liability is None:
                # An answer without a contract; or the node has not heard of the contract yet.
                self._results.forget(result)
            elif result.signer != liability.promisor and liability.validator == ZERO_ADDRESS:
                self._reject(result, "WrongSigner", f"signed by {result.signer}, not by the promisor")
            elif not liability.is_finalized:
                self._sending.put(partial(self._finalize, result))

    async def _liability(self, address: str) -> Liability | None:
        """The record of a liability; None for another address."""
        try:
            return self._liabilities.get(address) or await self._chain.liability(address)
        except (NotALiability, RequestRefused) as error:
            log.info("a Result waits to be sent again: %s", error)
            return None

    async def _finalize(self, result: Verified[Result]) -> None:
        message = result.message
        try:
            settled = await self._sending.send(lambda: self._chain.finalize(self._market, message))
        except (NodeUnreachable, RequestRefused, Reverted) as error:
            if _reason(error) != "AlreadyFinalized":
                self._reject(result, _reason(error), str(error))
        else:
            self._finalized += 1
            self._gas += settled.gas_used
            self._used.add(message.liability, result)
            log.info("%s: finalized, success %s, gas %d", message.liability, message.success, settled.gas_used)

    async def _follow_chain(self) -> None:
        """Orders that others made into contracts, and those whose time has passed, leave the book."""
        while True:
            try:
                async with aclosing(self._chain.events(self._head + 1, history=self._history)) as blocks:
                    async for block in blocks:
                        if isinstance(block, Reorganised):
                            self._take_back(block)
                        else:
                            await self._take_block(block)
            except (NodeUnreachable, RequestRefused, NotALiability, NoContracts) as error:
                # The latter two of a contract in a block that the chain has replaced meanwhile: that is told next.
                log.warning("the chain can't be read on from block %d: %s", self._head + 1, error)
                await asyncio.sleep(RETRY)

    async def _take_block(self, block: BlockEvents) -> None:
        for event in block.events:
            if isinstance(event, NewLiability):
                await self._forget_orders(event.liability)
            elif isinstance(event, Finalized):
                self._liabilities.pop(event.liability, None)
        self._head = block.block_number
        for order in self.book.expire(self._head):
            log.info("expired order %s of %s", order.hash.hex(), order.signer)

    def _take_back(self, block: Reorganised) -> None:
        """What the chain has undone is done again, unless it comes again by itself: then the contracts say so."""
        self._head = block.back_to
        created = [event.liability for event in block.events_taken_back if isinstance(event, NewLiability)]
        finalized = [event.liability for event in block.events_taken_back if isinstance(event, Finalized)]
        log.warning("the chain took back %d contracts and %d endings", len(created), len(finalized))
        for address in created:
            self._liabilities.pop(address, None)
            for order in self._used.pop(address, Demand, Offer):
                self._add(order)
        for address in finalized:
            for result in self._used.pop(address, Result):
                self._sending.put(partial(self._finalize, result))

    async def _forget_orders(self, address: str) -> None:
        liability = await self._chain.liability(address)
        if liability.lighthouse != self._market:
            return
        demand_hash, offer_hash = await self._chain.order_hashes(address)
        demand = self.book.remove(demand_hash + address_bytes(liability.promisee))
        offer = self.book.remove(offer_hash + address_bytes(liability.promisor))
        self._used.add(address, demand, offer)
        if not liability.is_finalized:
            self._liabilities[address] = liability

    def _reject(self, message: Verified[Any], reason: str, detail: str) -> None:
        """Tell the sender why. That an order was used already is no news to whom it made a contract."""
        self._rejected[reason] += 1
        order = message.hash.hex()
        log.warning("rejected %s of %s: %s", order, message.signer, detail)
        if reason != "OrderUsed":
            rejection = Rejection(order=order, reason=reason, detail=detail, provider=self.address)
            self.channel.put(str(RejectKey(self._lighthouse, order, self.address)), rejection.encode())


def _reason(error: AiraError) -> str:
    """The machine-readable word for why something was refused."""
    return word_for(error.reason if isinstance(error, Reverted) else type(error).__name__)
