"""The provider of a lighthouse: matches demands and offers, creates their liabilities, finalizes them by results.

A provider keeps on disk only withdrawals, and the orders whose transactions may still be mined. Orders and results are
sent again until their effect is on the chain, and the chain refuses an order that was used before; so a provider that
was killed starts with an empty book and catches up. It asks the others for open orders and withdrawals.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from mesh.blocklist import Blocklist
from mesh.chain import InsufficientFunds
from mesh.chain.transactions import TransactionSender
from mesh.flood import Drops
from mesh.fresh_file import CHECK_INTERVAL
from mesh.log_context import LogSource, source_context
from mesh.market.arrivals import OrderArrivals, ResultArrivals
from mesh.market.book import LIMIT, Match, OrderBook
from mesh.market.earnings import Earnings, EarningsLedger
from mesh.market.liability_events import OPEN_LIABILITIES
from mesh.market.sent_orders import SentOrders
from mesh.market.services import OrderBookService, ProviderStatusService
from mesh.market.settlement import Settlement
from mesh.market.transaction_queue import LEAST_GAS, RETRY, UNDER_WAY, TransactionQueue
from mesh.market.turns import NoStake
from mesh.market.versions import OrderVersions
from mesh.market.withdrawals import Withdrawals
from mesh.network.channel import Channel
from mesh.network.metrics import link_state, network_families
from mesh.network.services import Services
from mesh.role import Role
from mesh.settings.groups import DEADLINE_LIMIT
from mesh.telemetry.logs import LogService
from schemas import Demand, Offer, Result, Withdrawal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from contextlib import AsyncExitStack
    from pathlib import Path

    import zenoh

    from mesh.blocklist import BlockedSigners
    from mesh.chain import Chain
    from mesh.network import Network
    from mesh.retry import RetryPolicy
    from mesh.telemetry.metrics import MetricFamily
    from schemas import Verified

__all__ = ["Earnings", "Provider", "ProviderProcess", "check_account"]


class Provider(Role):
    """A provider of one lighthouse: `async with Provider(session, chain, lighthouse) as provider`, then `run`.

    `lighthouse` is the ENS name; its chain account must have a stake there. `limit` is the most open orders, `matched`
    is called with each match before its liability is created, `retry` is the policy for transactions that fail,
    `unmined_limit` the most of them that wait to be mined, and `open_liabilities` the most records of open liabilities
    in memory. Withdrawals are kept in the file `withdrawals`, if given, and what may still be mined in `sent_orders`.
    Orders leave the book after `deadline_limit` blocks. Messages of `blocked` signers are rejected, and their orders
    leave the book; what is dropped is counted in `drops`. The caller closes session and chain. When `run` is cancelled,
    a transaction that was sent may still be mined.
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
        retry: RetryPolicy = RETRY,
        unmined_limit: int = UNDER_WAY,
        open_liabilities: int = OPEN_LIABILITIES,
        withdrawals: Path | None = None,
        sent_orders: Path | None = None,
        deadline_limit: int = DEADLINE_LIMIT,
        blocked: BlockedSigners = frozenset(),
        drops: Drops | None = None,
    ) -> None:
        if chain.account is None:
            raise ValueError("a provider needs a chain with an account")
        self.address = chain.account.address
        self._session = session
        self._chain = chain
        self._lighthouse = lighthouse.lower()
        self._limit = limit
        self._matched = matched
        self._retry = retry
        self._unmined_limit = unmined_limit
        self._open_liabilities = open_liabilities
        self._deadline_limit = deadline_limit
        self._blocked = blocked
        self.withdrawals = Withdrawals(withdrawals, deadline_limit=deadline_limit)
        self._sent_orders = SentOrders(sent_orders)
        self.ledger = EarningsLedger()
        self.drops = Drops() if drops is None else drops
        """What it dropped because of floods."""
        self._source = LogSource("provider", self.address, self._lighthouse)

    async def _open(self, stack: AsyncExitStack) -> None:
        address, head = await self._chain.names.address(self._lighthouse), await self._chain.block_number()
        head = max(head - self._chain.node.timing.reorg_depth, 0)  # blocks that may be replaced are read again
        self.book = OrderBook(address, limit=self._limit, deadline_limit=self._deadline_limit)
        self.book.expire(head)
        stack.enter_context(self.withdrawals)
        self.withdrawals.expire(head)
        await self.withdrawals.sync()  # those of the earlier process
        versions = await self._restore(stack)
        self.queue = TransactionQueue(
            self._chain,
            address,
            head=lambda: self.settlement.events.head,
            earnings=self.ledger,
            retry=self._retry,
            under_way=self._unmined_limit,
        )
        self.channel = await stack.enter_async_context(
            Channel(
                self._session,
                self._lighthouse,
                address=address,
                resolver=self._chain.names.address,
                validators=self._chain.validators,
                head=lambda: self.settlement.events.head,
                blocked=self._blocked,
                drops=self.drops,
            )
        )
        self._demands = await stack.enter_async_context(self.channel.subscribe(Demand))
        self._offers = await stack.enter_async_context(self.channel.subscribe(Offer))
        self._withdrawn = await stack.enter_async_context(self.channel.subscribe(Withdrawal))
        self.results = await stack.enter_async_context(self.channel.subscribe(Result))
        self._wire(head, versions)
        await stack.enter_async_context(
            OrderBookService(self._session, self._lighthouse, self.book, self.withdrawals, drops=self.drops)
        )
        services = await stack.enter_async_context(Services(self._session, self.address, drops=self.drops))
        with source_context(self._source):
            services.offer("status", self._status.status)
            services.offer("logs", LogService("provider", self.address).logs)
        self.channel.announce("provider", self.address)

    async def _restore(self, stack: AsyncExitStack) -> OrderVersions:
        """The versions of orders that an earlier process has left on disk."""
        assert self._chain.account is not None
        await stack.enter_async_context(self._sent_orders)
        versions = OrderVersions(self._chain.node.timing.reorg_depth, self._sent_orders)
        if self._sent_orders.left or self._sent_orders.contracts:
            nonce = await TransactionSender(self._chain.node, self._chain.account).last_nonce()
            versions.restore(nonce, await self._chain.block_number())
        return versions

    def _wire(self, head: int, versions: OrderVersions) -> None:
        """Connect book, queue, channel and chain, which has been read up to block `head`."""
        self.settlement = Settlement(
            self._chain,
            self.channel,
            book=self.book,
            queue=self.queue,
            earnings=self.ledger,
            head=head,
            matched=self._matched,
            forget=self._forget,
            withdrawals=self.withdrawals,
            versions=versions,
            drops=self.drops,
            open_limit=self._open_liabilities,
        )
        self._status = ProviderStatusService(
            self._session,
            self._chain,
            self.channel,
            subscriptions=(self._demands, self._offers, self._withdrawn, self.results),
            book=self.book,
            queue=self.queue,
            settlement=self.settlement,
            earnings=self.ledger,
            drops=self.drops,
        )

    async def _work(self) -> None:
        with source_context(self._source):
            async with asyncio.TaskGroup() as tasks:
                self.settlement.start(tasks)
                tasks.create_task(self.drops.run(), name="provider drops")
                if isinstance(self._blocked, Blocklist):
                    tasks.create_task(self._follow_blocklist(self._blocked), name="provider blocklist")
                # Before the orders that they concern; one that comes later still stops what was not sent.
                await self._withdrawn.recall()
                tasks.create_task(self._take_withdrawals(), name="provider withdrawals")
                self._take_arrivals(tasks)

    def _take_arrivals(self, tasks: asyncio.TaskGroup) -> None:
        known, drops = self.book.known, self.drops
        orders = OrderArrivals(self.settlement, self.queue, worth=self._chain.costs.worth, known=known, drops=drops)
        tasks.create_task(orders.take(self._demands), name="provider demands")
        tasks.create_task(orders.take(self._offers), name="provider offers")
        tasks.create_task(orders.run(), name="provider orders")
        results = ResultArrivals(self.settlement, known=known, drops=drops)
        tasks.create_task(results.take(self.results), name="provider results")
        tasks.create_task(results.run(), name="provider unknown results")

    def earnings(self) -> Earnings:
        """What was done, earned and spent so far."""
        return self.ledger.earnings()

    async def measure(self) -> Iterable[MetricFamily]:
        """The provider's metrics, labelled with its lighthouse; without those of its chain and its session."""
        return await self._status.measure()

    def health(self) -> Mapping[str, str]:
        """The state of each part, as `aira status` shows it."""
        return self._status.health()

    def _forget(self, verified: Verified[Any], *, after: float = 0.0) -> None:
        """Let the next copy of a message through: it is not handled, or its effect was not confirmed."""
        for subscription in (self._demands, self._offers, self._withdrawn, self.results):
            if subscription.kind == verified.message.kind:
                subscription.forget(verified, after=after)

    async def _follow_blocklist(self, blocked: Blocklist) -> None:
        while True:
            self.settlement.block(await asyncio.to_thread(lambda: blocked.entries))
            await asyncio.sleep(CHECK_INTERVAL)

    async def _take_withdrawals(self) -> None:
        async for withdrawal in self._withdrawn:
            self.settlement.withdrawn.add(withdrawal)


class ProviderProcess:
    """A process with the open `providers` of one account on `chain`, in `network`: one, or one for each lighthouse."""

    def __init__(self, network: Network, chain: Chain, providers: Sequence[Provider]) -> None:
        self._network = network
        self._chain = chain
        self._providers = providers

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics of session, chain and account, and those of each provider with its lighthouse."""
        families = [*network_families(self._network), *await self._chain.measure()]
        for provider in self._providers:
            families += await provider.measure()
        return tuple(families)

    def health(self) -> Mapping[str, str]:
        """The state of each part; with several providers, their parts name the lighthouse."""
        parts = {"channel": link_state(self._network)}
        for provider in self._providers:
            of = f" of {provider.channel.lighthouse}" if len(self._providers) > 1 else ""
            parts |= {f"{part}{of}": state for part, state in provider.health().items()}
        return parts


async def check_account(chain: Chain, lighthouse: str) -> None:
    """Check before the start that the chain's account can be a provider; one that is at work waits instead.

    Raises `NoStake` without a stake at the lighthouse, `InsufficientFunds` without the ETH for one transaction, and
    the errors of reading the chain.
    """
    assert chain.account is not None
    address = chain.account.address
    state = await chain.lighthouses.get(lighthouse)
    if address not in state.stakes:
        raise NoStake(address, lighthouse, minimal_stake=state.minimal_stake)
    balance, price = await chain.tokens.eth_balance(), await chain.node.gas_price()
    if balance < LEAST_GAS * price:
        raise InsufficientFunds(address, balance=balance, needed=LEAST_GAS * price)
