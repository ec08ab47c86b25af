"""The open orders of a provider, and its restart."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from schemas import Demand, Offer, message_hash, verify_message
from tests.support.waiting import until

if TYPE_CHECKING:
    from mesh.market.provider import Provider
    from tests.support.provider.local_market import LocalMarket


async def test_a_recall_returns_the_open_orders_only(local: LocalMarket) -> None:
    async with local.provider() as provider:
        open_demand, open_offer, taken = local.demand(cost=1), local.offer(cost=2), local.demand()
        local.publish(open_demand, open_offer, taken, local.offer())
        await until(lambda: provider.earnings().created == 1)
        await until(lambda: len(provider.book) == 2)

        for kind, expected in ((Demand, open_demand), (Offer, open_offer)):
            async with local.channel.subscribe(kind) as orders:
                await orders.recall()
                assert (await anext(orders)).message == expected
                assert orders.statistics().received == 1


def missing_in(provider: Provider, posted: list[Demand]) -> list[Demand]:
    known = {order.hash for order in provider.book.orders()}
    return [demand for demand in posted if message_hash(demand) not in known]


async def test_a_recall_returns_the_whole_book(local: LocalMarket) -> None:
    posted = [local.demand(cost=number) for number in range(2000)]
    async with local.provider() as provider:
        async with asyncio.timeout(60):
            while missing := missing_in(provider, posted):
                local.publish(*missing[:100])  # again what a busy machine lost
                await asyncio.sleep(0.1)

        async with local.channel.subscribe(Demand) as demands:
            await demands.recall()
            received = {(await anext(demands)).hash for _ in posted}

        assert received == {verify_message(demand).hash for demand in posted}


async def test_a_provider_that_starts_later_gets_the_open_orders(local: LocalMarket) -> None:
    async with local.provider() as first:
        demand = local.demand()
        local.publish(demand)
        await until(lambda: len(first.book) == 1)

        async with local.provider("rival") as second:
            await until(lambda: list(second.book.orders()) == [verify_message(demand)])


async def test_orders_leave_the_book_at_their_deadline(local: LocalMarket) -> None:
    async with local.provider() as provider:
        head = await local.chain.block_number()
        short, long = local.demand(deadline=head + 3), local.demand(deadline=head + 1000)
        local.publish(short, long)
        await until(lambda: len(provider.book) == 2)

        await local.mine(3)

        await until(lambda: list(provider.book.orders()) == [verify_message(long)])


async def test_orders_that_another_provider_used_leave_the_book(local: LocalMarket) -> None:
    async with local.provider() as provider:
        demand, offer, other = local.demand(cost=0), local.offer(cost=0), local.demand(cost=1)
        local.publish(demand, other)
        await until(lambda: len(provider.book) == 2)
        async with local.chain_of("provider") as chain:
            await chain.liabilities.create(local.lighthouse, demand, offer)

        await until(lambda: list(provider.book.orders()) == [verify_message(other)])


async def test_an_order_of_another_person_with_the_same_terms_stays(local: LocalMarket) -> None:
    demand = local.demand()
    fields = {field: getattr(demand, field) for field in demand.__struct_fields__}
    copy = local.accounts["rival"].signer.sign(Demand(**fields))
    async with local.provider() as provider:
        local.publish(demand, copy)
        await until(lambda: len(provider.book) == 2)
        async with local.chain_of("provider") as chain:
            await chain.liabilities.create(local.lighthouse, demand, local.offer())

        await until(lambda: list(provider.book.orders()) == [verify_message(copy)])


async def test_a_restarted_provider_accepts_orders_that_are_sent_again(local: LocalMarket) -> None:
    demand = local.demand()
    async with local.provider() as provider:
        local.publish(demand)
        await until(lambda: len(provider.book) == 1)

    async with local.provider() as provider:
        assert len(provider.book) == 0
        local.publish(demand, local.offer())

        await local.liability_of(demand)


async def test_a_contract_from_before_the_start_is_finalized(local: LocalMarket) -> None:
    demand = local.demand()
    async with local.chain_of("provider") as chain:
        created = await chain.liabilities.create(local.lighthouse, demand, local.offer())
    async with local.provider() as provider:
        local.publish(local.result(created.liability, success=False))

        await until(lambda: provider.earnings().finalized == 1)
        assert not (await local.chain.liabilities.get(created.liability)).is_success


async def test_a_full_book_rejects_an_order_and_accepts_it_when_there_is_room(local: LocalMarket) -> None:
    async with local.provider(limit=1) as provider:
        first, second = local.demand(), local.demand()
        local.publish(first, second)
        assert (await local.rejection_of(second)).reason == "full"

        local.publish(local.offer(cost=0))
        await until(lambda: provider.earnings().created == 1)

        def is_accepted() -> bool:
            local.publish(second)  # again and again, as agents do: copies are refused for a moment after the rejection
            return list(provider.book.orders()) == [verify_message(second)]

        await until(is_accepted, pause=0.1)
