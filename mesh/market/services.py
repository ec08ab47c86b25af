"""What a provider publishes: open orders and withdrawals, and its status, health and metrics."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh

import mesh
from mesh.background import call_in_loop
from mesh.chain.metrics import CachedMetrics, reading_families
from mesh.flood import Rate, RateLimiter
from mesh.network import message_key
from mesh.network.metrics import drop_family, message_families
from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge, labelled
from schemas import encode, lighthouse_selector
from schemas.selectors import ORDER
from schemas.status import ALIVE, MarketStatus, Status

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from concurrent.futures import Future

    from mesh.chain import Chain
    from mesh.flood import Drops
    from mesh.market.book import OrderBook
    from mesh.market.earnings import EarningsLedger
    from mesh.market.settlement import Settlement
    from mesh.market.transaction_queue import TransactionQueue
    from mesh.market.withdrawals import Withdrawals
    from mesh.network import Channel, Subscription
    from schemas import Verified
    from schemas.rpc import Nothing

THREADS: Final = 2
"""Threads that answer queries: a book can be large, and a client may take the answers slowly."""
REPLIES: Final = Rate(10_000, 500_000)
"""Orders that are sent in answers, a second and in a burst: a tenth of a core. A query counts as many as the book has,
and is dropped when that is too many. Zenoh does not say who asks, so that strangers share this with all others, who get
orders also when these are sent again."""
PENDING: Final = 64
"""Queries that may be pending, each with a copy of the list of orders; further ones are dropped."""


class OrderBookService:
    """Answers queries for open orders and withdrawals, which a client sends after it has subscribed.

    Inside `async with` it answers on the keys of `lighthouse` (ENS name) from `book` and `withdrawals`. At most `limit`
    queries are pending at a time, and at most `replies` orders are sent. Leaving `async with` aborts the answers.
    """

    def __init__(
        self,
        session: zenoh.Session,
        lighthouse: str,
        book: OrderBook,
        withdrawals: Withdrawals,
        *,
        limit: int = PENDING,
        replies: Rate = REPLIES,
        drops: Drops | None = None,
        threads: ThreadPoolExecutor | None = None,
    ) -> None:
        self._session = session
        self._lighthouse = lighthouse
        self._book = book
        self._withdrawals = withdrawals
        self._limit = limit
        self._drops = drops
        self._most = replies.burst
        self._rate = RateLimiter(per_sender=replies)
        self._threads = threads or ThreadPoolExecutor(THREADS, thread_name_prefix="order book")
        self._answers: set[Future[None]] = set()
        self._open = True

    @property
    def pending(self) -> int:
        """The number of queries that are being answered or wait for it."""
        return len(self._answers)

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        self._queryable: Any = self._session.declare_queryable(
            lighthouse_selector(self._lighthouse), lambda query: self._received(loop, query), complete=True
        )
        return self

    def _received(self, loop: asyncio.AbstractEventLoop, query: zenoh.Query) -> None:
        """Refuse what is too much on Zenoh's thread, so that the event loop is not kept busy."""
        order = query.parameters.get(ORDER)
        replies = len(self._withdrawals.of(order)) if order else len(self._withdrawals) + len(self._book)
        if len(self._answers) < self._limit and self._rate.allow("", min(replies + 1, self._most)):
            call_in_loop(loop, self.answer, query)
            return
        if self._drops is not None:
            self._drops.count("recall")
        query.drop()  # type: ignore[no-untyped-call]

    async def __aexit__(self, *exc_info: object) -> None:
        self._open = False
        if not self._session.is_closed():
            self._queryable.undeclare()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def answer(self, query: zenoh.Query) -> None:
        """Answer a query in a thread, or drop it. Call it in the event loop's thread, where the book changes."""
        if self._open and len(self._answers) < self._limit:
            answer = self._threads.submit(self._reply, query, self._answer(query.parameters.get(ORDER)))
            self._answers.add(answer)
            answer.add_done_callback(self._answers.discard)
        else:
            query.drop()  # type: ignore[no-untyped-call]

    def _answer(self, order: str | None) -> list[Verified[Any]]:
        """The withdrawals of an order, if its hash is given; else all that is open."""
        if order:
            return self._withdrawals.of(order)
        return [*self._withdrawals, *self._book.orders()]

    def _reply(self, query: zenoh.Query, messages: list[Verified[Any]]) -> None:
        with query:  # leaving it ends the answer
            for message in messages:
                key = message_key(self._lighthouse, message.message)
                if not self._open:
                    return
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, encode(message.message), encoding="application/json")


class ProviderStatusService:
    """The status, health and metrics of the provider of `channel`'s market."""

    def __init__(
        self,
        session: zenoh.Session,
        chain: Chain,
        channel: Channel,
        *,
        subscriptions: Sequence[Subscription[Any]],
        book: OrderBook,
        queue: TransactionQueue,
        settlement: Settlement,
        earnings: EarningsLedger,
        drops: Drops,
    ) -> None:
        assert chain.account is not None
        self._address = chain.account.address
        self._session = session
        self._chain = chain
        self._channel = channel
        self._subscriptions = subscriptions
        self._book = book
        self._queue = queue
        self._settlement = settlement
        self._earnings = earnings
        self._drops = drops
        self._stake = CachedMetrics(self._ask_stake, max_age=chain.node.timing.metrics_age)
        self._began = time.monotonic()

    async def status(self, _request: Nothing) -> Status:
        """The status now, without asking chain or network."""
        earned = self._earnings.earnings()
        return Status(
            role="provider",
            address=self._address,
            version=mesh.__version__,
            zenoh_id=str(self._session.zid()),
            lighthouse=self._channel.lighthouse,
            parts=self.health(),
            head=self._settlement.events.head,
            chain_id=self._chain.chain_id,
            xrt=self._chain.xrt,
            uptime=round(time.monotonic() - self._began, 3),
            market=MarketStatus(
                open_orders=len(self._book),
                created=earned.created,
                finalized=earned.finalized,
                rejected=earned.rejected,
                gas_used=earned.gas_used,
                spent=earned.spent,
                fees=earned.fees,
                minted=earned.minted,
            ),
            dropped=self._drops.totals(),
            heaviest=self._drops.senders(),
        )

    def health(self) -> dict[str, str]:
        """The state of each part: sending transactions, and following the chain."""
        transactions = ALIVE
        if self._settlement.events.lookups.is_down:
            transactions = "wait for the node"
        elif self._queue.is_down:
            transactions = "wait"
        return {
            "transactions": transactions,
            "listener": "waits for the node" if self._settlement.events.outages.is_down else ALIVE,
        }

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics now, labelled with the lighthouse; without those of the account."""
        families = (
            *message_families(self._subscriptions),
            drop_family(self._drops),
            *self._market_families(),
            *self._earnings_families(),
            *reading_families(head=self._settlement.events.head, read_at=self._settlement.events.read_at),
            *await self._stake.measure(),
        )
        return labelled(families, lighthouse=self._channel.lighthouse)

    def _market_families(self) -> Iterable[MetricFamily]:
        seen, rejected = self._earnings.turnover(), self._earnings.earnings().rejected
        reverted = {"created": seen.reverted.created, "finalized": seen.reverted.finalized}
        return (
            gauge("aira_orders_open", "Orders in the book", len(self._book)),
            counter("aira_matches_total", "Matches of a demand and an offer", seen.matches),
            counter("aira_contracts_created_total", "Contracts that this provider created", seen.entered.created),
            counter("aira_contracts_finalized_total", "Contracts that it finalized", seen.entered.finalized),
            by_label(
                "aira_contracts_taken_back_total", "counter", "Of these, reverted by reorganisations", "step", reverted
            ),
            by_label("aira_rejections_total", "counter", "Orders and results that it rejected", "reason", rejected),
            gauge("aira_transactions_waiting", "Transactions that wait to be sent", self._queue.waiting),
        )

    def _earnings_families(self) -> Iterable[MetricFamily]:
        seen = self._earnings.turnover()
        reverted = {"fees": seen.reverted.fees, "minted": seen.reverted.minted}
        return (
            counter("aira_fees_earned_wn_total", "Fees of the created contracts, wn", seen.entered.fees),
            counter("aira_minted_wn_total", "XRT minted for the gas of finalizing, wn", seen.entered.minted),
            by_label(
                "aira_earnings_taken_back_wn_total",
                "counter",
                "Of these, reverted by reorganisations, wn",
                "of",
                reverted,
            ),
        )

    async def _ask_stake(self) -> Iterable[MetricFamily]:
        assert self._channel.address is not None
        state = await self._chain.lighthouses.get(self._channel.address)
        stake, is_turn = state.stakes.get(self._address, 0), state.current == self._address
        return (
            gauge("aira_stake_wn", "This provider's stake at the lighthouse, wn", stake),
            gauge("aira_turn", "1 while it is this provider's turn, 0 otherwise", float(is_turn)),
            gauge("aira_lighthouse_providers", "Providers with a stake at the lighthouse", len(state.stakes)),
        )
