"""What a provider publishes: open orders and withdrawals, and its status, health and metrics."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import zenoh
from msgspec.structs import asdict

import mesh
from mesh.base.background import call_in_loop
from mesh.base.flood import Rate, RateLimiter
from mesh.errors import public_text
from mesh.market.book import Match
from mesh.network import message_key
from mesh.network.channel import message_families
from mesh.telemetry.metrics import MetricFamily, by_label, counter, drop_family, gauge, labelled, public_parts
from mesh.telemetry.serving import CachedMetrics
from schemas import InvalidMessage, encode, lighthouse_selector
from schemas.keys import ORDER
from schemas.rpc import PairTaken, PermitFee
from schemas.signing import Refusal
from schemas.status import ALIVE, MarketStatus, Status

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence
    from concurrent.futures import Future

    from mesh.base.flood import Drops
    from mesh.market._settlement import Settlement, SettlementParts
    from mesh.market.book import Order, OrderBook
    from mesh.market.store import Withdrawals
    from mesh.network import Subscription
    from schemas import Permit, Withdrawal
    from schemas.rpc import Nothing, OrderPair, PermitFeeRequest


class ReplyLimits(NamedTuple):
    """What queries for open orders may take."""

    replies: Rate = Rate(10_000, 500_000)
    """Orders that are sent, a second and in a burst: a tenth of a core. A query counts as many as the book has, and is
    dropped when that is too many. Zenoh does not say who asks, so that strangers share this with all others, who get
    orders also when these are sent again."""
    pending: int = 64
    """Queries that may be pending, each with a copy of the list of orders; further ones are dropped."""
    threads: int = 2
    """Threads that answer: a book can be large, and a client may take the answers slowly."""


REPLY_LIMITS: Final = ReplyLimits()


class OrderBookService:
    """Answers queries for open orders, withdrawals and permits, which a client sends after it has subscribed.

    Inside `async with` it answers on the keys of `lighthouse` (ENS name) from `book`, `withdrawals` and `permits`,
    within `limits`. Leaving `async with` aborts the answers.
    """

    def __init__(
        self,
        session: zenoh.Session,
        lighthouse: str,
        book: OrderBook,
        withdrawals: Withdrawals,
        *,
        permits: Collection[Permit] = (),
        limits: ReplyLimits = REPLY_LIMITS,
        drops: Drops | None = None,
    ) -> None:
        self._session = session
        self._lighthouse = lighthouse
        self._book = book
        self._withdrawals = withdrawals
        self._permits = permits
        self._limits = limits
        self._drops = drops
        self._rate = RateLimiter(per_sender=limits.replies)
        self._threads = ThreadPoolExecutor(limits.threads, thread_name_prefix="order book")
        self._answers: set[Future[None]] = set()
        self._open = True

    @property
    def pending(self) -> int:
        """The number of queries that are being answered or wait for it."""
        return len(self._answers)

    def _has_room(self) -> bool:
        return len(self._answers) < self._limits.pending

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        self._queryable: Any = self._session.declare_queryable(
            lighthouse_selector(self._lighthouse), lambda query: self._received(loop, query), complete=True
        )
        return self

    def _received(self, loop: asyncio.AbstractEventLoop, query: zenoh.Query) -> None:
        """Refuse what is too much on Zenoh's thread, so that the event loop is not kept busy."""
        order = query.parameters.get(ORDER)
        replies = (
            len(self._withdrawals.of(order)) if order else len(self._withdrawals) + len(self._permits) + len(self._book)
        )
        if self._has_room() and self._rate.allow("", min(replies + 1, self._limits.replies.burst)):
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
        if self._open and self._has_room():
            answer = self._threads.submit(self._reply, query, self._answer(query.parameters.get(ORDER)))
            self._answers.add(answer)
            answer.add_done_callback(self._answers.discard)
        else:
            query.drop()  # type: ignore[no-untyped-call]

    def _answer(self, order: str | None) -> list[Order | Withdrawal | Permit]:
        """The withdrawals of an order, if its hash is given; else all that is open."""
        if order:
            return [withdrawal.message for withdrawal in self._withdrawals.of(order)]
        withdrawals = (withdrawal.message for withdrawal in self._withdrawals)
        return [*withdrawals, *self._permits, *self._book.messages()]

    def _reply(self, query: zenoh.Query, messages: Sequence[Order | Withdrawal | Permit]) -> None:
        with query:  # leaving it ends the answer
            for message in messages:
                key = message_key(self._lighthouse, message)
                if not self._open:
                    return
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, encode(message), encoding="application/json")


class PairService:
    """The service `pair`: creates the contract of a demand with the offer that its maker chose."""

    def __init__(self, parts: SettlementParts, settlement: Settlement) -> None:
        self._parts = parts
        self._settlement = settlement

    async def pair(self, request: OrderPair) -> PairTaken:
        """Check a pair as strangers' messages are, and settle it."""
        try:
            if not request.is_signed:
                raise InvalidMessage("signature", "the pair is not signed by its maker")
            demand = await self._parts.channel.verified(request.demand.message())
            offer = await self._parts.channel.verified(request.offer.message())
            request.check(demand, offer)
            if request.permit is not None:
                self._settlement.note_permit(await self._parts.channel.verified(request.permit.message()))
        except InvalidMessage as error:
            return PairTaken(error.reason, public_text(error))
        if not self._parts.queue.has_room_for(self._parts.chain.funds.worth(demand.message)):
            return PairTaken(Refusal.FULL, "too many transactions wait; try again later")
        pair = Match(demand, offer)
        for signer, shortage in zip((demand.signer, offer.signer), await self._settlement.shortages(pair), strict=True):
            if shortage:
                return PairTaken(shortage, f"{signer} lacks the money, or the factory may not take it")
        refusal = self._settlement.pair(pair)
        return PairTaken() if refusal is None else PairTaken(refusal, f"the provider refuses it: {refusal}")


async def permit_fee(parts: SettlementParts, wanted: PermitFeeRequest) -> PermitFee:
    """The service `permit-fee`: what the provider wants now for an order with a permit. Raises as reading the chain."""
    data_gas = await parts.chain.liabilities.usual_data_gas()
    return PermitFee(parts.free.permit_fee(wanted, data_gas=data_gas))


class ProviderStatus:
    """The status, health and metrics of the provider with these `parts`."""

    def __init__(
        self, session: zenoh.Session, parts: SettlementParts, *, subscriptions: Sequence[Subscription[Any]]
    ) -> None:
        self._session = session
        self._parts = parts
        self._subscriptions = subscriptions
        self._stake = CachedMetrics(self._ask_stake, max_age=parts.chain.node.timing.metrics_age)
        self._began = time.monotonic()

    async def status(self, _request: Nothing) -> Status:
        """The status now, without asking chain or network."""
        parts = self._parts
        return Status(
            role="provider",
            address=parts.account.address,
            version=mesh.__version__,
            zenoh_id=str(self._session.zid()),
            lighthouse=parts.channel.lighthouse,
            parts=public_parts(self.health()),
            head=parts.head.head,
            chain_id=parts.chain.chain_id,
            xrt=parts.chain.xrt,
            uptime=round(time.monotonic() - self._began, 3),
            market=MarketStatus(
                open_orders=len(parts.orders.book),
                free_a_day=parts.free.a_day,
                free_left=parts.free.left(),
                free_created=parts.free.created,
                **asdict(parts.earnings.earnings()),
            ),
            dropped=parts.drops.totals(),
            heaviest=parts.drops.senders(),
        )

    def health(self) -> dict[str, str]:
        """The state of each part: sending transactions, and following the chain."""
        transactions = "wait" if self._parts.queue.is_down else ALIVE
        return {
            "transactions": "wait for the node" if self._parts.lookups.is_down else transactions,
            "listener": "waits for the node" if self._parts.outages.is_down else ALIVE,
        }

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics now, labelled with the lighthouse; without those of chain, session and account."""
        parts, (matches, entered, reverted) = self._parts, self._parts.earnings.turnover()
        contracts = {"created": reverted.created, "finalized": reverted.finalized}
        amounts, rejected = {"fees": reverted.fees, "minted": reverted.minted}, parts.earnings.earnings().rejected
        free = parts.free
        families = (
            *message_families(self._subscriptions),
            drop_family(parts.drops),
            gauge("aira_orders_open", "Orders in the book", len(parts.orders.book)),
            counter("aira_matches_total", "Matches of a demand and an offer", matches),
            counter("aira_contracts_created_total", "Contracts that this provider created", entered.created),
            counter("aira_contracts_finalized_total", "Contracts that it finalized", entered.finalized),
            by_label(
                "aira_contracts_taken_back_total", "counter", "Of these, reverted by reorganisations", "step", contracts
            ),
            counter("aira_free_contracts_total", "Contracts it created that don't cover its gas", free.created),
            gauge("aira_free_contracts_left", "Such contracts that it may create now for strangers", free.left()),
            by_label("aira_rejections_total", "counter", "Orders and results that it rejected", "reason", rejected),
            gauge("aira_transactions_waiting", "Transactions that wait to be sent", parts.queue.waiting),
            counter("aira_fees_earned_wn_total", "Fees of the created contracts, wn", entered.fees),
            counter("aira_minted_wn_total", "XRT minted for the gas of finalizing, wn", entered.minted),
            by_label(
                "aira_earnings_taken_back_wn_total",
                "counter",
                "Of these, reverted by reorganisations, wn",
                "of",
                amounts,
            ),
            *parts.head.families(),
            *await self._stake.measure(),
        )
        return labelled(families, lighthouse=parts.channel.lighthouse)

    async def _ask_stake(self) -> Iterable[MetricFamily]:
        own, state = self._parts.account.address, await self._parts.chain.lighthouses.get(self._parts.lighthouse)
        return (
            gauge("aira_stake_wn", "This provider's stake at the lighthouse, wn", state.stakes.get(own, 0)),
            gauge("aira_turn", "1 while it is this provider's turn, 0 otherwise", float(state.current == own)),
            gauge("aira_lighthouse_providers", "Providers with a stake at the lighthouse", len(state.stakes)),
        )
