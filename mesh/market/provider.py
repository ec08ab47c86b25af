"""The provider: brings demands and offers together, and pays out when the work is done.

A provider keeps nothing on disk. Orders and Results are sent again by those who made them until their effect is on the
chain, and the chain refuses to make a contract twice, so a provider that was killed starts empty and catches up.
"""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING, Any

from mesh.chain import NotALiability, RequestRefused
from mesh.market.book import LIMIT, Match, OrderBook, Refusal
from mesh.market.contracting import Contracting
from mesh.market.earnings import Earnings, EarningsLedger
from mesh.market.faults import USED
from mesh.market.metrics import MarketMetrics
from mesh.market.order_book_service import OrderBookService
from mesh.market.sending import Sending
from mesh.market.settled import SettledMessages
from mesh.market.telling import StatusService
from mesh.market.watching import Watching
from mesh.network.channel import Channel
from mesh.network.services import Services
from mesh.role import Role
from mesh.telemetry.context import LogSource, liability_context, log_event, source_context
from mesh.telemetry.logs import LogService
from schemas import ZERO_ADDRESS, Demand, Offer, RejectKey, Result, Verified
from schemas.signing import Rejection

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from contextlib import AsyncExitStack

    import zenoh

    from mesh.chain import Chain
    from mesh.market.book import Order
    from mesh.network import Subscription
    from mesh.telemetry.metrics import MetricFamily
    from schemas import Liability

log = logging.getLogger(__name__)

__all__ = ["Earnings", "Provider"]


class Provider(Role):
    """A provider of one lighthouse: `async with Provider(session, chain, lighthouse) as provider`, then `run`.

    `lighthouse` is the ENS name; the chain's account must have its stake there. `matched` is told of each pair before
    its contract is made. Session and chain stay the caller's to close. When `run` is cancelled, a transaction that is
    on its way may still go through.
    """

    title = "provider"

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
        self._signer = chain.account.signer
        self._session = session
        self._chain = chain
        self._lighthouse = lighthouse.lower()
        self._limit = limit
        self._matched = matched
        self._books = EarningsLedger()
        self._speaker = LogSource("provider", self.address, self._lighthouse)

    async def _open(self, stack: AsyncExitStack) -> None:
        market, head = await self._chain.names.address(self._lighthouse), await self._chain.block_number()
        self.book = OrderBook(market, limit=self._limit)
        self.book.expire(head)
        self._prepare(market, head)
        self.channel = await stack.enter_async_context(
            Channel(
                self._session,
                self._lighthouse,
                address=market,
                resolver=self._chain.names.address,
                head=lambda: self._watching.head,
            )
        )
        self._demands = await stack.enter_async_context(self.channel.subscribe(Demand))
        self._offers = await stack.enter_async_context(self.channel.subscribe(Offer))
        self._results = await stack.enter_async_context(self.channel.subscribe(Result))
        await stack.enter_async_context(OrderBookService(self._session, self._lighthouse, self.book))
        self._figures = MarketMetrics(
            self.channel,
            self._chain,
            subscriptions=(self._demands, self._offers, self._results),
            book=self.book,
            books=self._books,
            sending=self._sending,
            watching=self._watching,
        )
        services = await stack.enter_async_context(Services(self._session, self.address))
        with source_context(self._speaker):
            services.offer("status", self._telling.status)
            services.offer("logs", LogService("provider", self.address).logs)
        self.channel.announce("provider", self.address)

    def _prepare(self, market: str, head: int) -> None:
        """What works on the chain, for the lighthouse at the address `market`."""
        used = SettledMessages()
        self._sending = Sending(self._chain, market, provider=self.address, head=lambda: self._watching.head)
        self._contracting = Contracting(self._chain, market, self, sending=self._sending, books=self._books, used=used)
        self._watching = Watching(
            self._chain,
            market,
            self,
            head=head,
            book=self.book,
            contracting=self._contracting,
            books=self._books,
            used=used,
        )
        self._telling = StatusService(
            self._session,
            self._chain,
            self._lighthouse,
            book=self.book,
            books=self._books,
            sending=self._sending,
            watching=self._watching,
        )

    async def _work(self) -> None:
        with source_context(self._speaker):
            await self._serve()

    async def _serve(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._take(self._demands), name="provider demands")
            tasks.create_task(self._take(self._offers), name="provider offers")
            tasks.create_task(self._take_results(), name="provider results")
            tasks.create_task(self._watching.run(), name="provider chain")
            tasks.create_task(self._sending.run(), name="provider transactions")

    def earnings(self) -> Earnings:
        """What was done, earned and spent so far."""
        return self._books.earnings()

    async def measure(self) -> Iterable[MetricFamily]:
        """Its figures, with its lighthouse as a label; those of its chain and its session are not among them."""
        return await self._figures.measure()

    def health(self) -> Mapping[str, str]:
        """The state of each of its parts, as `aira status` shows it."""
        return self._telling.parts()

    def put_back(self, order: Verified[Order]) -> None:
        """Take an order into the market again that was matched before."""
        self._add(order)

    def reject(self, message: Verified[Any], reason: str, detail: str) -> None:
        """Tell the sender why. That an order was used already is no news to whom it made a contract."""
        self._books.rejected(reason)
        order = message.hash.hex()
        known = log_event("unnamed", order=order, signer=message.signer, reason=reason)
        log.warning("rejected %s of %s: %s", order, message.signer, detail, extra=known)
        if reason != USED:
            rejection = Rejection(order=order, reason=reason, detail=detail, provider=self.address)
            key = str(RejectKey(self._lighthouse, order, self.address))
            self.channel.put(key, rejection.signed_by(self._signer).encode())

    def forget(self, result: Verified[Result]) -> None:
        """Hear a Result once more when it is sent again."""
        self._results.forget(result)

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
            demand, offer = outcome.demand.hash.hex(), outcome.offer.hash.hex()
            log.info(
                "matched demand %s and offer %s", demand, offer, extra=log_event("unnamed", demand=demand, offer=offer)
            )
            self._books.matched()
            self._matched(outcome)
            self._contracting.make(outcome)
        elif isinstance(outcome, Refusal):
            if outcome is not Refusal.DUPLICATE:
                self.reject(order, outcome.value, f"the order book refuses it: {outcome.value}")
            return outcome
        return None

    async def _take_results(self) -> None:
        async for result in self._results:
            await self._sending.room()
            with liability_context(result.message.liability):
                await self._take_result(result)

    async def _take_result(self, result: Verified[Result]) -> None:
        liability = await self._sending.ask(partial(self._liability, result.message.liability))
        if liability is None:
            # An answer without a contract; or the node has not heard of the contract yet.
            self._results.forget(result)
        elif result.signer != liability.promisor and liability.validator == ZERO_ADDRESS:
            self.reject(result, "WrongSigner", f"signed by {result.signer}, not by the promisor")
        elif not liability.is_finalized:
            self._contracting.end(result)

    async def _liability(self, address: str) -> Liability | None:
        """The record of a liability; None for another address."""
        try:
            return await self._watching.liability(address)
        except (NotALiability, RequestRefused) as error:
            log.debug("a Result waits to be sent again: %s", error)
            return None
