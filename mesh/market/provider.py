"""The provider: brings demands and offers together, and pays out when the work is done.

A provider keeps nothing on disk. Orders and Results are sent again by those who made them until their effect is on the
chain, and the chain refuses to make a contract twice, so a provider that was killed starts empty and catches up.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any, Final, Self

import msgspec
import zenoh

from mesh.chain import NodeUnreachable, NotALiability, Reverted, TransactionTimeout
from mesh.chain.events import Finalized, NewLiability
from mesh.market.blame import at_fault
from mesh.market.book import LIMIT, Match, OrderBook, Refusal
from mesh.network.channel import Channel, message_key
from schemas import ZERO_ADDRESS, Demand, Offer, Result, Verified, address_bytes, encode
from schemas.keys import RejectKey
from schemas.rejection import Rejection

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from types import TracebackType

    from mesh.chain import Chain, Created
    from mesh.market.book import Order
    from mesh.network.channel import Subscription
    from schemas import Liability

log = logging.getLogger(__name__)

RETRY: Final = 1.0
"""Seconds before a transaction is tried again that failed for a passing reason."""
PASSING: Final = frozenset({"NotYourTurn"})
"""Errors of the contracts that time heals."""


class Earnings(msgspec.Struct, frozen=True, kw_only=True):
    """What a provider did so far: contracts made and finalized, orders rejected by reason, gas spent, fees won (wn)."""

    created: int
    finalized: int
    rejected: dict[str, int]
    gas_used: int
    fees: int


class Provider:
    """A provider of one lighthouse: `async with Provider(session, chain, lighthouse) as provider`, then `run`.

    `lighthouse` is the ENS name; the chain's account must have its stake there. Session and chain stay the caller's
    to close.
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
        self._stack = AsyncExitStack()
        self._work: asyncio.Queue[Coroutine[Any, Any, None]] = asyncio.Queue()
        self._liabilities: dict[str, Liability] = {}
        self._rejected: Counter[str] = Counter()
        self._created = self._finalized = self._gas = self._fees = 0

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            self._head = await self._chain.block_number()
            address = await self._chain.resolve(self._lighthouse)
            self.book = OrderBook(address, limit=self._limit)
            self.book.expire(self._head)
            self.channel = await stack.enter_async_context(
                Channel(
                    self._session,
                    self._lighthouse,
                    address=address,
                    resolver=self._chain.resolve,
                    head=lambda: self._head,
                )
            )
            self._demands = await stack.enter_async_context(self.channel.subscribe(Demand))
            self._offers = await stack.enter_async_context(self.channel.subscribe(Offer))
            self._results = await stack.enter_async_context(self.channel.subscribe(Result))
            self._answer_queries(stack)
            self.channel.announce("provider", self.address)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()
        while not self._work.empty():
            self._work.get_nowait().close()

    async def run(self) -> None:
        """Serve the lighthouse until cancelled. A transaction that is on its way then may still go through."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._take(self._demands), name="provider demands")
            tasks.create_task(self._take(self._offers), name="provider offers")
            tasks.create_task(self._take_results(), name="provider results")
            tasks.create_task(self._follow_chain(), name="provider chain")
            tasks.create_task(self._send_transactions(), name="provider transactions")

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
            self._add(order)

    def _add(self, order: Verified[Order]) -> None:
        outcome = self.book.add(order)
        if isinstance(outcome, Match):
            log.info("matched demand %s and offer %s", outcome.demand.hash.hex(), outcome.offer.hash.hex())
            self._matched(outcome)
            self._work.put_nowait(self._create(outcome))
        elif isinstance(outcome, Refusal) and outcome is not Refusal.DUPLICATE:
            self._reject(order, outcome.value, f"the order book refuses it: {outcome.value}")

    async def _take_results(self) -> None:
        async for result in self._results:
            self._work.put_nowait(self._finalize(result))

    async def _send_transactions(self) -> None:
        """One after the other: the turn and the nonce are ours alone."""
        while True:
            await (await self._work.get())

    async def _create(self, match: Match) -> None:
        """Make the contract of a match; what can't become one leaves the market, the other order stays."""
        demand, offer = match
        if self._head >= min(demand.message.deadline, offer.message.deadline):
            self._put_back(match, gone=())
            return
        try:
            created = await self._chain.create_liability(self._lighthouse, demand.message, offer.message)
        except Reverted as error:
            if error.reason in PASSING:
                self._later(self._create(match))
                return
            gone = at_fault(match, error.reason, error.arguments)
            for order in gone:
                self._reject(order, error.reason, str(error))
            self._put_back(match, gone=gone)
        except (NodeUnreachable, TransactionTimeout) as error:
            log.warning("the contract of demand %s waits: %s", demand.hash.hex(), error)
            self._later(self._create(match))
        else:
            self._count(created, offer)

    def _count(self, created: Created, offer: Verified[Offer]) -> None:
        self._created += 1
        self._gas += created.gas_used
        self._fees += offer.message.lighthouse_fee
        log.info("%s: created, gas %d", created.liability, created.gas_used)

    def _put_back(self, match: Match, *, gone: tuple[Verified[Order], ...]) -> None:
        for order in match:
            if order not in gone:
                self._add(order)

    async def _finalize(self, result: Verified[Result]) -> None:
        message = result.message
        try:
            liability = await self._liability(message.liability)
            if liability is None or liability.is_finalized:
                return
            if result.signer != liability.promisor and liability.validator == ZERO_ADDRESS:
                self._reject(result, "WrongSigner", f"signed by {result.signer}, not by the promisor")
                return
            finalized = await self._chain.finalize(self._lighthouse, message)
        except Reverted as error:
            if error.reason in PASSING:
                self._later(self._finalize(result))
            elif error.reason != "AlreadyFinalized":
                self._reject(result, error.reason, str(error))
        except (NodeUnreachable, TransactionTimeout) as error:
            log.warning("%s: the Result waits: %s", message.liability, error)
            self._later(self._finalize(result))
        else:
            self._finalized += 1
            self._gas += finalized.gas_used
            self._liabilities.pop(message.liability, None)
            log.info("%s: finalized, success %s, gas %d", message.liability, message.success, finalized.gas_used)

    async def _liability(self, address: str) -> Liability | None:
        """The record of a liability of this lighthouse; None for another address (an answer without a contract)."""
        known = self._liabilities.get(address)
        if known is None:
            try:
                known = await self._chain.liability(address)
            except NotALiability:
                return None
        return known

    def _later(self, again: Coroutine[Any, Any, None]) -> None:
        asyncio.get_running_loop().call_later(RETRY, self._work.put_nowait, again)

    async def _follow_chain(self) -> None:
        """Orders that others made into contracts, and those whose time has passed, leave the book."""
        async for block in self._chain.events(self._head + 1):
            for event in block.events:
                if isinstance(event, NewLiability):
                    await self._forget_orders(event.liability)
                elif isinstance(event, Finalized):
                    self._liabilities.pop(event.liability, None)
            self._head = block.block_number
            for order in self.book.expire(self._head):
                log.info("expired order %s of %s", order.hash.hex(), order.signer)

    async def _forget_orders(self, address: str) -> None:
        liability = await self._chain.liability(address)
        demand_hash, offer_hash = await self._chain.order_hashes(address)
        self.book.remove(demand_hash + address_bytes(liability.promisee))
        self.book.remove(offer_hash + address_bytes(liability.promisor))
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

    def _answer_queries(self, stack: AsyncExitStack) -> None:
        """Be the market's memory: answer who asks for open orders."""
        loop = asyncio.get_running_loop()

        def asked(query: zenoh.Query) -> None:
            loop.call_soon_threadsafe(lambda: loop.run_in_executor(None, self._answer, query, list(self.book.orders())))

        queryable: Any = self._session.declare_queryable(f"aira/{self._lighthouse}/**", asked, complete=True)
        stack.callback(queryable.undeclare)

    def _answer(self, query: zenoh.Query, orders: list[Verified[Order]]) -> None:
        """On a thread of its own: a market can be large. Leaving `with` tells the asker that this was all."""
        with query:
            for order in orders:
                key = message_key(self._lighthouse, order.message)
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, encode(order.message), encoding="application/json")
