"""The provider of a lighthouse: matches demands and offers, creates their liabilities, finalizes them by results.

A provider keeps on disk only withdrawals, and the orders whose transactions may still be mined. Orders and results are
sent again until their effect is on the chain, and the chain refuses an order that was used before; so a provider that
was killed starts with an empty book and catches up. It asks the others for open orders and withdrawals.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

from mesh.base.flood import Drops, FairQueue
from mesh.base.fresh_file import CHECK_INTERVAL, Blocklist, blocklist_at
from mesh.base.lifecycle import Role
from mesh.base.log_context import LogSource, source_context
from mesh.base.outage_log import OutageLog
from mesh.chain import InsufficientFunds
from mesh.chain.transactions import TransactionSender
from mesh.market._earnings import FREE_LIMITS, Earnings, EarningsLedger, FreeContracts
from mesh.market._orders import OrderLimits, Orders
from mesh.market._services import OrderBookService, PairService, ProviderStatus, permit_fee
from mesh.market._settlement import SETTLEMENT_LIMITS, Settlement, SettlementParts
from mesh.market.store import MarketStore, Withdrawals
from mesh.market.transactions import QUEUE_LIMITS, RETRY, NoStake, TransactionQueue, least_cost
from mesh.network import MarketRules
from mesh.network.channel import Channel
from mesh.network.services import Services
from mesh.role.composition import state_folder
from mesh.role.following import ChainHead
from mesh.settings.groups import DEADLINE_LIMIT, OPEN_ORDERS_LIMIT
from mesh.telemetry.logs import LogService
from schemas import Demand, Offer, Permit, Result, Withdrawal

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Container, Mapping, Sequence
    from contextlib import AsyncExitStack
    from pathlib import Path

    import zenoh

    from mesh.base.flood import KnownSenders
    from mesh.base.retry import RetryPolicy
    from mesh.chain import Chain
    from mesh.market.book import Match, Order, OrderBook
    from mesh.network import Network, Subscription
    from mesh.settings import Settings
    from mesh.settings.groups import StorageSettings
    from mesh.telemetry.metrics import MetricFamily
    from schemas import Verified

    _Waiting: TypeAlias = FairQueue[tuple[Verified[Any], Subscription[Any]]]
    """Messages that wait, with the subscriptions that they came from."""


log = logging.getLogger(__name__)

PERMIT_SECONDS: Final = 1.0
"""How long a provider waits for the permit of a new demand before it says that the demand can't be paid."""


class ArrivalLimits(NamedTuple):
    """How many orders and results may wait for the chain, and about how many it is asked at once."""

    orders: int = 32_768
    """Orders that wait until their makers' funds were asked for."""
    orders_at_once: int = 512
    """Orders whose makers' funds are asked for at once."""
    results: int = 4096
    """Results that wait until their contracts were looked up."""
    results_of_signer: int = 64
    """Those of one signer."""
    results_at_once: int = 100
    """Results whose contracts are looked up in one call."""


ARRIVAL_LIMITS: Final = ArrivalLimits()


class Arrivals:
    """Takes orders and results from subscriptions, and passes them to `settlement` (`run`); `known` signers go first.

    What an order says that it pays (`worth`, a priority) counts only when its maker can pay it. While `queue` is full
    of transactions that are worth as much, an order is held. Results of open contracts that are known go on at once.
    The others wait until the chain was asked for their contracts, for many in one call: a stranger can sign any number.
    """

    def __init__(
        self,
        settlement: Settlement,
        queue: TransactionQueue,
        *,
        worth: Callable[[Order], int],
        known: KnownSenders,
        drops: Drops,
    ) -> None:
        self._settlement = settlement
        self._transactions = queue
        self._worth = worth
        self._known = known
        self._drops = drops
        self._orders: _Waiting = FairQueue(per_sender=ARRIVAL_LIMITS.orders, total=ARRIVAL_LIMITS.orders)
        self._held: _Waiting = FairQueue(per_sender=ARRIVAL_LIMITS.orders, total=ARRIVAL_LIMITS.orders)
        self._results: _Waiting = FairQueue(per_sender=ARRIVAL_LIMITS.results_of_signer, total=ARRIVAL_LIMITS.results)

    async def take_orders(self, orders: Subscription[Any]) -> None:
        """Take the open orders of other providers, then those that are published, until cancelled."""
        await orders.recall()
        async for order in orders:
            self._put(self._orders, order, orders)

    async def take_results(self, results: Subscription[Result]) -> None:
        """Take the results that are published, until cancelled."""
        async for result in results:
            if (liability := self._settlement.events.open.get(result.message.liability)) is not None:
                await self._settlement.results.settle(result, liability)
            else:
                self._put(self._results, result, results)

    async def run(self) -> None:
        """Pass on what was taken, until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._pass_arrived(), name="arrived orders")
            tasks.create_task(self._pass_held(), name="held orders")
            tasks.create_task(self._look_up_results(), name="results of unknown contracts")

    def _put(self, waiting: _Waiting, message: Verified[Any], source: Subscription[Any]) -> None:
        """Let a message wait; what is dropped for it is counted, and taken when it is sent again."""
        is_known = message.signer in self._known
        for dropped, subscription in waiting.put(message.signer, (message, source), priority=int(is_known)):
            self._drops.count("queue-full", dropped.signer)
            subscription.forget(dropped)

    async def _pass_arrived(self) -> None:
        while True:
            batch = await self._orders.get_batch(ARRIVAL_LIMITS.orders_at_once)
            await asyncio.sleep(0)  # the transactions of the batch before enter the queue
            settled = []
            for order, orders in batch:
                if self._transactions.has_room_for(self._worth(order.message)):
                    settled.append(order)
                else:
                    self._put(self._held, order, orders)
            await self._pass(settled)

    async def _pass_held(self) -> None:
        while True:
            batch = await self._held.get_batch(ARRIVAL_LIMITS.orders_at_once)
            await self._transactions.has_room()
            await self._pass([order for order, _ in batch])

    async def _pass(self, orders: Sequence[Verified[Order]]) -> None:
        for order, shortage in zip(orders, await self._settlement.shortages(orders), strict=True):
            if shortage:
                self._drops.count("unfunded", order.signer)
                self._settlement.set_aside(order, shortage, patience=PERMIT_SECONDS)
            else:
                self._settlement.add(order)

    async def _look_up_results(self) -> None:
        while True:
            batch = [result for result, _ in await self._results.get_batch(ARRIVAL_LIMITS.results_at_once)]
            found = await self._settlement.events.liabilities([result.message.liability for result in batch])
            for result in batch:
                await self._settlement.results.settle(result, found.get(result.message.liability))


__all__ = ["Earnings", "Provider", "ProviderOptions", "ProviderProcess", "check_account"]


@dataclass(frozen=True, kw_only=True)
class ProviderOptions:
    """What a provider does, and how much of it. `customers` are addresses; see `aira provider --help` for the others.

    `store` is the file for what must outlive a crash; without it nothing is kept. `retry` is for transactions that
    fail, `unmined_limit` the most of them that wait to be mined, `open_liabilities` the most records in memory.
    """

    limit: int = OPEN_ORDERS_LIMIT
    retry: RetryPolicy = RETRY
    unmined_limit: int = QUEUE_LIMITS.under_way
    open_liabilities: int = SETTLEMENT_LIMITS.liabilities
    store: Path | None = None
    deadline_limit: int = DEADLINE_LIMIT
    free_contracts: int = FREE_LIMITS.a_day
    customers: Collection[str] = ()
    blocked: Container[str] = frozenset()


DEFAULTS: Final = ProviderOptions()


class Provider(Role):
    """A provider of one lighthouse: `async with Provider(session, chain, lighthouse) as provider`, then `run`.

    `lighthouse` is the ENS name; its chain account must have a stake there. `matched` is called with each match before
    its liability is created. The caller closes session and chain. When `run` is cancelled, a transaction that was sent
    may still be mined.
    """

    title = "provider"

    def __init__(
        self,
        session: zenoh.Session,
        chain: Chain,
        lighthouse: str,
        options: ProviderOptions = DEFAULTS,
        *,
        matched: Callable[[Match], None] = lambda match: None,
    ) -> None:
        if chain.account is None:
            raise ValueError("a provider needs a chain with an account")
        self.address = chain.account.address
        self._session = session
        self._chain = chain
        self._lighthouse = lighthouse.lower()
        self._options = options
        self._matched = matched
        self._store = MarketStore(options.store)
        self.withdrawals = Withdrawals(self._store, deadline_limit=options.deadline_limit)
        self.ledger = EarningsLedger()
        self.drops = Drops()
        """What it dropped because of floods."""
        self._source = LogSource("provider", self.address, self._lighthouse)

    async def _open(self, stack: AsyncExitStack) -> None:
        timing, options = self._chain.node.timing, self._options
        address, latest = await self._chain.names.address(self._lighthouse), await self._chain.block_number()
        start = max(latest - timing.reorg_depth, 0)  # blocks that may be replaced are read again
        head = self.head = await ChainHead.at(self._chain, start)
        stack.enter_context(self._store)
        stack.enter_context(self.withdrawals)
        self.withdrawals.expire(head.contract_block)
        self.orders = Orders(
            address,
            depth=timing.reorg_depth,
            withdrawn=self.withdrawals,
            limits=OrderLimits(open=options.limit, deadline=options.deadline_limit),
        )
        self.book.expire(head.contract_block)
        await self._restore(latest)
        emission, is_ours = 100, await self._chain.has_mesh_contracts()
        if is_ours:
            node = self._chain.node
            emission = await node.read(node.contract("Factory", self._chain.factory).wnFor100Gas())
        self.free = FreeContracts(
            self.address,
            self._chain.xrt,
            a_day=options.free_contracts,
            customers=options.customers,
            always_minted=not is_ours,
            emission=emission,
            store=self._store,
        )
        outages, lookups = OutageLog(log, "chain"), OutageLog(log, "node")
        self.queue = TransactionQueue(
            self._chain,
            address,
            head=lambda: head.contract_block,
            earnings=self.ledger,
            lookups=lookups,
            retry=options.retry,
            limits=QUEUE_LIMITS._replace(under_way=options.unmined_limit),
        )
        self.channel = await stack.enter_async_context(
            Channel(
                self._session,
                MarketRules(
                    self._lighthouse,
                    address=address,
                    resolver=self._chain.names.address,
                    validators=self._chain.validators.settled,
                    head=lambda: head.contract_block,
                    blocked=options.blocked,
                ),
                drops=self.drops,
            )
        )
        self._demands = await stack.enter_async_context(self.channel.subscribe(Demand))
        self._offers = await stack.enter_async_context(self.channel.subscribe(Offer))
        self._withdrawn = await stack.enter_async_context(self.channel.subscribe(Withdrawal))
        self._permits = await stack.enter_async_context(self.channel.subscribe(Permit))
        self.results = await stack.enter_async_context(self.channel.subscribe(Result))
        parts = SettlementParts(
            chain=self._chain,
            head=head,
            outages=outages,
            lookups=lookups,
            channel=self.channel,
            orders=self.orders,
            withdrawals=self.withdrawals,
            store=self._store,
            queue=self.queue,
            earnings=self.ledger,
            free=self.free,
            drops=self.drops,
            forget=self._forget,
        )
        self.settlement = Settlement(parts, matched=self._matched, open_limit=options.open_liabilities)
        await stack.enter_async_context(
            OrderBookService(
                self._session,
                self._lighthouse,
                self.book,
                self.withdrawals,
                permits=self._chain.permits,
                drops=self.drops,
            )
        )
        self._subscriptions = (self._demands, self._offers, self._withdrawn, self._permits, self.results)
        self.status = ProviderStatus(self._session, parts, subscriptions=self._subscriptions)
        services = await stack.enter_async_context(Services(self._session, self.address, drops=self.drops))
        self._services, self._pairs = services, PairService(parts, self.settlement)
        with source_context(self._source):
            services.offer("status", self.status.status)
            services.offer("logs", LogService("provider", self.address).logs)
            if is_ours:  # others take no permits
                services.offer("permit-fee", partial(permit_fee, parts))
        self.channel.announce("provider", self.address)

    @property
    def book(self) -> OrderBook:
        return self.orders.book

    async def _restore(self, head: int) -> None:
        """Take over the orders that an earlier process has left on disk."""
        assert self._chain.account is not None
        sent, contracts = self._store.sent_orders(), self._store.sent_orders(contracts=True)
        if sent or contracts:
            nonce = await TransactionSender(self._chain.node, self._chain.account).last_nonce()
            self.orders.versions.restore(sent, contracts=contracts, nonce=nonce, head=head)

    async def _work(self) -> None:
        with source_context(self._source):
            async with asyncio.TaskGroup() as tasks:
                self.settlement.start(tasks)
                tasks.create_task(self.drops.run(), name="provider drops")
                if isinstance(self._options.blocked, Blocklist):
                    tasks.create_task(self._follow_blocklist(self._options.blocked), name="provider blocklist")
                # Before the orders that they concern; one that comes later still stops what was not sent.
                await self._withdrawn.recall()
                tasks.create_task(self._take_withdrawals(), name="provider withdrawals")
                await self._permits.recall()
                tasks.create_task(self._take_permits(), name="provider permits")
                arrivals = Arrivals(
                    self.settlement, self.queue, worth=self._chain.funds.worth, known=self.book.known, drops=self.drops
                )
                tasks.create_task(arrivals.take_orders(self._demands), name="provider demands")
                tasks.create_task(arrivals.take_orders(self._offers), name="provider offers")
                tasks.create_task(arrivals.take_results(self.results), name="provider results")
                tasks.create_task(arrivals.run(), name="provider arrivals")
                self._services.offer("pair", self._pairs.pair)

    def earnings(self) -> Earnings:
        """What was done, earned and spent so far."""
        return self.ledger.earnings()

    def _forget(self, verified: Verified[Any], *, after: float = 0.0) -> None:
        """Let the next copy of a message through: it is not handled, or its effect was not confirmed."""
        for subscription in self._subscriptions:
            if subscription.kind == verified.message.kind:
                subscription.forget(verified, after=after)

    async def _follow_blocklist(self, blocked: Blocklist) -> None:
        while True:
            self.settlement.block(await asyncio.to_thread(lambda: blocked.entries))
            await asyncio.sleep(CHECK_INTERVAL)

    async def _take_permits(self) -> None:
        async for permit in self._permits:
            self.settlement.note_permit(permit)

    async def _take_withdrawals(self) -> None:
        async for withdrawal in self._withdrawn:
            self.settlement.withdraw(withdrawal)


class ProviderProcess:
    """A process with the open `providers` of one account on `chain`, in `network`: one, or one for each lighthouse."""

    def __init__(self, network: Network, chain: Chain, providers: Sequence[Provider]) -> None:
        self._network = network
        self._chain = chain
        self._providers = providers

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics of session, chain and account, and those of each provider with its lighthouse."""
        families = [*self._network.families(), *await self._chain.measure()]
        for provider in self._providers:
            families += await provider.status.measure()
        return tuple(families)

    def health(self) -> Mapping[str, str]:
        """The state of each part; with several providers, their parts name the lighthouse."""
        parts = {"channel": self._network.state}
        for provider in self._providers:
            of = f" of {provider.channel.lighthouse}" if len(self._providers) > 1 else ""
            parts |= {f"{part}{of}": state for part, state in provider.status.health().items()}
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
    balance, needed = await chain.tokens.eth_balance(), await least_cost(chain.node)
    if balance < needed:
        raise InsufficientFunds(address, balance=balance, needed=needed)


async def provider_file(settings: StorageSettings, chain: Chain, address: str, lighthouse: str) -> Path:
    """The file of an account's provider on a chain, for a lighthouse (ENS name)."""
    return await state_folder(settings, chain, address) / f"provider-{lighthouse.lower()}.sqlite"


async def provider_of(settings: Settings, session: zenoh.Session, chain: Chain) -> Provider:
    """The provider that the settings name, not yet opened, with the account of an open chain.

    Raises `ConfigurationError` for a node with which it could not follow the contracts that it makes.
    """
    assert chain.account is not None
    await chain.node.check_calls(chain.account.address)
    lighthouse = settings.lighthouse_contract
    options = ProviderOptions(
        limit=settings.open_orders_limit,
        unmined_limit=settings.unmined_limit,
        store=await provider_file(settings, chain, chain.account.address, lighthouse),
        deadline_limit=settings.deadline_limit,
        free_contracts=settings.free_contracts,
        customers=[await chain.names.address(customer) for customer in settings.customers],
        blocked=blocklist_at(settings.blocked_signers),
    )
    return Provider(session, chain, lighthouse, options)
