"""The order book service: its answers, its limit, and its end."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING

import zenoh

from mesh.base.flood import Drops, Rate
from mesh.market import OrderBook
from mesh.market._services import REPLY_LIMITS, OrderBookService
from mesh.market.store import Withdrawals
from mesh.network import Channel, Endpoints, Network, message_key
from schemas import Demand, Withdrawal, decode, market_selector, verify_message
from schemas.keys import withdrawal_selector
from tests.support.orders import LIGHTHOUSE, MARKET, MODEL, OTHER_MODEL, PERSON, verified_demand, verified_offer
from tests.support.waiting import at_most, until, until_answered

if TYPE_CHECKING:
    from schemas import Verified
    from tests.support.routers import EmbeddedRouter


def network(router: EmbeddedRouter) -> Network:
    return Network(Endpoints(connect=(router.endpoint,)))


def holding(*orders: Verified[object]) -> OrderBook:  # type: ignore[type-var]
    book = OrderBook(LIGHTHOUSE)
    for order in orders:
        book.add(order)  # type: ignore[arg-type]
    return book


def ask(session: zenoh.Session, selector: str) -> list[str]:
    """The keys of the answers."""
    return [str(reply.ok.key_expr) for reply in session.get(selector, timeout=60) if reply.ok is not None]


async def test_it_answers_with_the_orders_that_match_the_query(router: EmbeddedRouter) -> None:
    mine, other, offer = verified_demand(model=MODEL), verified_demand(model=OTHER_MODEL), verified_offer(cost=1)
    keys = {name: message_key(MARKET, order.message) for name, order in (("d", mine), ("e", other), ("o", offer))}
    async with (
        network(router) as one,
        network(router) as two,
        OrderBookService(one.session, MARKET, holding(mine, other, offer), Withdrawals()),
    ):
        await until_answered(two.session, f"aira/{MARKET}/**")

        for selector, expected in (
            (f"aira/{MARKET}/**", {keys["d"], keys["e"], keys["o"]}),
            (f"aira/{MARKET}/demand/*", {keys["d"], keys["e"]}),
            (f"aira/{MARKET}/demand/{MODEL}", {keys["d"]}),
            (keys["o"], {keys["o"]}),
            (f"aira/{MARKET}/result", set()),
            (f"aira/{MARKET}/demand/{MODEL[:-1]}", set()),
        ):
            assert set(await asyncio.to_thread(ask, two.session, selector)) == expected


async def test_it_answers_with_the_withdrawals_of_one_order(router: EmbeddedRouter) -> None:
    withdrawals, digests = Withdrawals(), ("ab" * 32, "cd" * 32)
    for digest in digests:
        withdrawal = Withdrawal(order=digest, lighthouse=LIGHTHOUSE, deadline=10)
        withdrawals.add(verify_message(PERSON.sign(withdrawal)))
    async with (
        network(router) as one,
        network(router) as two,
        OrderBookService(one.session, MARKET, holding(verified_demand()), withdrawals),
    ):
        await until_answered(two.session, f"aira/{MARKET}/**")

        def orders(selector: str) -> list[str]:
            replies = two.session.get(selector, timeout=60, consolidation=zenoh.ConsolidationMode.NONE)
            withdrawn = [decode(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]
            return sorted(message.order for message in withdrawn if isinstance(message, Withdrawal))

        assert await asyncio.to_thread(orders, market_selector(MARKET, "withdrawal")) == sorted(digests)
        assert await asyncio.to_thread(orders, withdrawal_selector(MARKET, digests[1])) == [digests[1]]


async def test_it_answers_with_all_orders_of_a_model(router: EmbeddedRouter) -> None:
    """They have one key."""
    book = holding(*(verified_demand(model=MODEL) for _ in range(20)))
    async with (
        network(router) as one,
        network(router) as two,
        OrderBookService(one.session, MARKET, book, Withdrawals()),
        Channel(two.session, MARKET) as channel,
        channel.subscribe(Demand, model=MODEL) as demands,
    ):
        await until_answered(two.session, f"aira/{MARKET}/**")

        await demands.recall()

        async with asyncio.timeout(60):
            recalled = {(await anext(demands)).hash for _ in range(20)}
        assert recalled == {order.hash for order in book.orders()}


async def test_it_answers_with_the_book_at_the_time_of_the_query(router: EmbeddedRouter) -> None:
    book = holding(verified_demand())
    async with (
        network(router) as one,
        network(router) as two,
        OrderBookService(one.session, MARKET, book, Withdrawals()),
    ):
        await until_answered(two.session, f"aira/{MARKET}/**")
        book.add(verified_offer())

        assert await asyncio.to_thread(ask, two.session, f"aira/{MARKET}/**") == []


async def test_leaving_aborts_long_answers_and_those_that_wait(router: EmbeddedRouter) -> None:
    book = holding(*(verified_demand() for _ in range(3000)))
    async with network(router) as one, network(router) as two:
        service = await OrderBookService(one.session, MARKET, book, Withdrawals()).__aenter__()
        await until_answered(two.session, f"aira/{MARKET}/**")
        asking = [asyncio.create_task(asyncio.to_thread(ask, two.session, f"aira/{MARKET}/**")) for _ in range(5)]
        await until(lambda: service.pending > REPLY_LIMITS.threads)

        with at_most(3):
            await service.__aexit__(None, None, None)
            answers = await asyncio.gather(*asking)

        assert min(len(answer) for answer in answers) < 3000


async def test_a_query_that_arrives_after_leaving_is_dropped(router: EmbeddedRouter) -> None:
    asked: list[zenoh.Query] = []
    async with network(router) as one, network(router) as two:
        async with OrderBookService(one.session, MARKET, holding(), Withdrawals()) as service:
            pass
        with one.session.declare_queryable("test", asked.append):
            await until_answered(two.session, "test")
            asking = asyncio.create_task(asyncio.to_thread(ask, two.session, "test"))
            await until(lambda: asked)

            service.answer(asked.pop())

            with at_most(2):
                assert await asking == []


async def test_queries_above_the_limit_are_dropped(router: EmbeddedRouter) -> None:
    """Each pending query has a list of the whole book; without a limit a client could exhaust the memory."""
    order, may_answer = verified_demand(), threading.Event()
    limits = REPLY_LIMITS._replace(pending=1, threads=1)
    async with (
        network(router) as one,
        network(router) as two,
        OrderBookService(one.session, MARKET, holding(order), Withdrawals(), limits=limits) as service,
    ):
        await until_answered(two.session, f"aira/{MARKET}/**")
        await until(lambda: service.pending == 0)
        service._threads.submit(may_answer.wait)
        first = asyncio.create_task(asyncio.to_thread(ask, two.session, f"aira/{MARKET}/**"))
        await until(lambda: service.pending == 1)

        with at_most(3):
            assert await asyncio.to_thread(ask, two.session, f"aira/{MARKET}/**") == []

        assert not first.done()
        may_answer.set()
        assert await first == [message_key(MARKET, order.message)]
        await until_answered(two.session, f"aira/{MARKET}/**")


async def test_leaving_after_the_session_was_closed_does_not_hang(router: EmbeddedRouter) -> None:
    async with network(router) as one:
        with at_most(2):
            async with OrderBookService(one.session, MARKET, holding(), Withdrawals()):
                one.session.close()  # type: ignore[no-untyped-call]


async def test_queries_beyond_the_rate_are_dropped_and_counted(router: EmbeddedRouter) -> None:
    book, drops, withdrawals = holding(verified_demand()), Drops(), Withdrawals()
    withdrawals.add(verify_message(PERSON.sign(Withdrawal(order="ab" * 32, lighthouse=LIGHTHOUSE, deadline=10))))
    async with (
        network(router) as one,
        network(router) as two,
        OrderBookService(
            one.session, MARKET, book, withdrawals, limits=REPLY_LIMITS._replace(replies=Rate(1e-9, 5)), drops=drops
        ),
    ):
        await until_answered(two.session, f"aira/{MARKET}/**")

        answers = [len(await asyncio.to_thread(ask, two.session, f"aira/{MARKET}/**")) for _ in range(2)]
        assert answers == [2, 0], "a query counts as three"
        assert drops.totals() == {"recall": 1}
