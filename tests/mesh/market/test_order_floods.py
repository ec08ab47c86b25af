"""Floods of orders: makers without money, a full book, deadlines far away."""

from __future__ import annotations

import asyncio
import secrets
from typing import TYPE_CHECKING, Any

from mesh.base.background import Background
from mesh.base.flood import Drops, KnownSenders
from mesh.market import Added, OrderBook, order_id
from mesh.market.provider import ARRIVAL_LIMITS, Arrivals
from schemas import Demand, Signer, verify_message
from schemas.signing import Refusal
from tests.support.orders import LIGHTHOUSE, PERSON, ROBOT, STRANGER, verified_demand, verified_offer
from tests.support.provider.held_node import HeldNode
from tests.support.provider.observation import until_read
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from mesh.market.book import Order
    from schemas import Verified
    from tests.support.provider.local_market import LocalMarket


def stranger() -> Signer:
    return Signer(secrets.token_bytes(32))


def filled(limit: int, *orders: Verified[Order], **options: Any) -> OrderBook:
    book = OrderBook(LIGHTHOUSE, limit=limit, **options)
    for order in orders:
        assert isinstance(book.add(order), Added)
    return book


def test_in_a_full_book_the_signer_with_the_most_orders_loses_its_newest() -> None:
    flood: list[Verified[Order]] = [verified_demand(signer=STRANGER) for _ in range(4)]
    book = filled(4, *flood)
    honest = verified_demand(signer=PERSON)
    assert book.add(honest) == Added(honest, evicted=(flood[-1],))
    assert book.add(verified_demand(signer=STRANGER)) is Refusal.FULL
    assert list(book.orders()) == [*flood[:3], honest]
    for order in flood[:2]:
        other = verified_demand(signer=stranger())
        outcome = book.add(other)
        assert isinstance(outcome, Added)
        assert outcome.evicted[0].signer == order.signer
    assert len(book) == 4


def test_in_a_full_book_of_fresh_keys_the_oldest_that_pays_nothing_leaves() -> None:
    paid = verified_demand(signer=stranger(), cost=5)
    free: list[Verified[Order]] = [
        verified_demand(signer=stranger(), cost=0),
        verified_offer(signer=stranger(), cost=7),
    ]
    book = filled(3, paid, *free)
    newest = [verified_demand(signer=stranger(), cost=9) for _ in range(3)]
    assert book.add(newest[0]) == Added(newest[0], evicted=(free[0],))
    assert book.add(newest[1]) == Added(newest[1], evicted=(free[1],))
    assert book.add(newest[2]) is Refusal.FULL
    assert set(book.orders()) == {paid, *newest[:2]}


def test_in_a_full_book_of_fresh_keys_the_orders_of_known_signers_stay() -> None:
    """Although these have several, and those only one each."""
    book = OrderBook(LIGHTHOUSE, limit=6)
    book.known.add(PERSON.address)
    book.known.add(ROBOT.address)
    honest: list[Verified[Order]] = [verified_demand(signer=PERSON, cost=cost) for cost in (4, 5)]
    honest += [verified_offer(signer=ROBOT, cost=cost) for cost in (7, 8)]
    flood = [verified_offer(signer=stranger(), cost=9) for _ in range(20)]
    for order in (flood[0], *honest, *flood[1:]):
        assert isinstance(book.add(order), Added)
    assert set(book.orders()) == {*honest, *flood[-2:]}
    later = verified_offer(signer=ROBOT, cost=10)
    assert book.add(later) == Added(later, evicted=(flood[-2],))


def test_an_order_leaves_the_book_at_its_limit_of_blocks() -> None:
    far, near = verified_demand(deadline=10**9), verified_demand(deadline=103)
    book = OrderBook(LIGHTHOUSE, deadline_limit=10)
    book.expire(100)
    for order in (far, near):
        assert isinstance(book.add(order), Added)
    assert book.expire(103) == [near]
    assert book.expire(109) == []
    assert book.expire(110) == [far]
    assert isinstance(book.add(far), Added), "its maker may send it again"
    assert book.expire(120) == [far]


def copies(local: LocalMarket, count: int, **terms: Any) -> list[Demand]:
    """Demands with these terms of accounts that have nothing."""
    demand = local.demand(**terms)
    fields = {field: getattr(demand, field) for field in demand.__struct_fields__}
    return [stranger().sign(Demand(**(fields | {"nonce": secrets.token_hex(32)}))) for _ in range(count)]


class Market:
    """A subscription to orders, what settles them, and a queue with room for what is worth more than `full`."""

    def __init__(self, *orders: Verified[Order], full: int = -1) -> None:
        self._orders = orders
        self._full = full
        self.checked: list[Verified[Order]] = []
        self.room = asyncio.Event()

    async def recall(self) -> None:
        pass

    async def __aiter__(self) -> AsyncIterator[Verified[Order]]:
        for order in self._orders:
            yield order

    async def shortages(self, orders: Sequence[Verified[Order]]) -> list[str]:
        self.checked += orders
        return len(orders) * [""]

    def add(self, order: Verified[Order]) -> None:
        pass

    async def has_room(self) -> None:
        await self.room.wait()

    def has_room_for(self, priority: int) -> bool:
        return priority > self._full


def arrivals_of(market: Market, known: KnownSenders) -> Arrivals:
    return Arrivals(market, market, worth=worth, known=known, drops=Drops())  # type: ignore[arg-type]


def worth(order: Order) -> int:
    return order.cost.bit_length()


async def test_known_signers_are_checked_before_strangers_that_promise_more() -> None:
    promised = [verified_demand(signer=stranger(), cost=10**18) for _ in range(2 * ARRIVAL_LIMITS.orders_at_once)]
    honest = verified_demand(signer=PERSON, cost=1)
    market, known = Market(*promised, honest), KnownSenders()
    known.add(PERSON.address)
    arrivals = arrivals_of(market, known)
    await arrivals.take_orders(market)  # type: ignore[arg-type]
    async with Background() as tasks:
        tasks.start(arrivals.run(), "arrivals")
        await until(lambda: market.checked)
    assert market.checked[0] == honest


async def test_while_transactions_wait_for_free_contracts_orders_that_pay_more_are_settled() -> None:
    free = [verified_demand(signer=stranger(), cost=0) for _ in range(2 * ARRIVAL_LIMITS.orders_at_once)]
    paid = verified_demand(signer=PERSON, cost=1)
    market = Market(*free, paid, full=0)
    arrivals = arrivals_of(market, KnownSenders())
    await arrivals.take_orders(market)  # type: ignore[arg-type]
    async with Background() as tasks:
        tasks.start(arrivals.run(), "arrivals")
        await until(lambda: market.checked)
        assert market.checked == [paid]
        market.room.set()
        await until(lambda: len(market.checked) == len(free) + 1)


async def test_results_of_unknown_contracts_hold_up_no_others(local: LocalMarket) -> None:
    async with HeldNode(local.node) as node, local.provider(endpoint=node) as provider:
        demand = local.demand()
        local.publish(demand, local.offer())
        liability = await local.liability_of(demand)
        await until(lambda: liability.address in provider.settlement.events.open)
        honest = local.result(liability.address)
        with node.back("eth_call"):
            local.publish(*(local.result(stranger().address, "rival") for _ in range(50)))
            await until(lambda: node.waiting["eth_call"])
            local.publish(honest)
            await until(lambda: provider.orders.settling(order_id(verify_message(honest))))
        await until(lambda: provider.earnings().finalized == 1)


async def test_unfunded_demands_with_the_same_terms_take_no_offer(local: LocalMarket) -> None:
    await local.chain.tokens.approve(local.chain.factory, 5)
    async with local.provider() as provider:
        for number in range(6):
            local.publish(*copies(local, 50, cost=5))
            await until(lambda: provider.drops.totals().get("unfunded") == 50 * (number + 1))  # noqa: B023
        honest = local.demand(cost=5)
        async with asyncio.timeout(30):
            local.publish(local.offer(cost=5), honest)
            await local.liability_of(honest)
        assert provider.ledger.turnover().matches == 1


async def test_a_far_deadline_holds_a_place_for_some_blocks_only(local: LocalMarket) -> None:
    async with local.provider(deadline_limit=5) as provider:
        await until_read(local, provider)  # it begins some blocks before the latest
        demand = local.demand(deadline=10**9)
        local.publish(demand)
        await until(lambda: len(provider.book) == 1)
        await local.mine(6)
        await until(lambda: len(provider.book) == 0)
        local.publish(demand)
        await until(lambda: list(provider.book.orders()) == [verify_message(demand)])


async def test_an_evicted_order_is_accepted_again_when_there_is_room(local: LocalMarket) -> None:
    async with local.provider(limit=2) as provider:
        first, evicted, other = local.demand(), local.demand(), local.demand("robot", cost=0)
        local.publish(first, evicted)
        await until(lambda: len(provider.book) == 2)
        local.publish(other)
        await until(lambda: set(provider.book.orders()) == {verify_message(first), verify_message(other)})
        assert provider.drops.totals() == {"book-full": 1}
        local.publish(local.withdrawal(first))
        await until(lambda: len(provider.book) == 1)

        async def is_back() -> bool:
            local.publish(evicted)  # as its sender does: copies that come soon after it was evicted are not looked at
            await asyncio.sleep(0.05)
            return len(provider.book) == 2

        await until_found(is_back)
