"""What a provider remembers: open orders, for who comes late, and contracts of before its start."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas import Demand, Offer, verify_message
from tests.support.waiting import until

if TYPE_CHECKING:
    from tests.mesh.market.floor import Floor


async def test_late_comers_are_told_of_the_open_orders_only(floor: Floor) -> None:
    async with floor.provider() as provider:
        open_demand, open_offer, taken = floor.demand(cost=1), floor.offer(cost=2), floor.demand()
        floor.publish(open_demand, open_offer, taken, floor.offer())
        await until(lambda: provider.earnings().created == 1)
        await until(lambda: len(provider.book) == 2)

        for kind, expected in ((Demand, open_demand), (Offer, open_offer)):
            async with floor.channel.subscribe(kind) as orders:
                await orders.recall()
                assert (await anext(orders)).message == expected
                assert orders.statistics().received == 1


async def test_a_whole_book_is_told(floor: Floor) -> None:
    posted = [floor.demand(cost=number) for number in range(2000)]
    async with floor.provider() as provider:
        for number in range(0, len(posted), 100):
            floor.publish(*posted[number : number + 100])
            await until(lambda: len(provider.book) == number + 100)  # noqa: B023

        async with floor.channel.subscribe(Demand) as demands:
            await demands.recall()
            told = {(await anext(demands)).hash for _ in posted}

        assert told == {verify_message(demand).hash for demand in posted}


async def test_a_provider_that_comes_later_takes_over_the_open_orders(floor: Floor) -> None:
    async with floor.provider() as first:
        demand = floor.demand()
        floor.publish(demand)
        await until(lambda: len(first.book) == 1)

        async with floor.provider("rival") as second:
            await until(lambda: list(second.book.orders()) == [verify_message(demand)])


async def test_orders_leave_the_book_when_their_block_has_come(floor: Floor) -> None:
    async with floor.provider() as provider:
        head = await floor.chain.block_number()
        short, long = floor.demand(deadline=head + 3), floor.demand(deadline=head + 1000)
        floor.publish(short, long)
        await until(lambda: len(provider.book) == 2)

        await floor.mine(3)

        await until(lambda: list(provider.book.orders()) == [verify_message(long)])


async def test_orders_that_somebody_else_made_into_a_contract_leave_the_book(floor: Floor) -> None:
    async with floor.provider() as provider:
        demand, offer, other = floor.demand(cost=0), floor.offer(cost=0), floor.demand(cost=1)
        floor.publish(demand, other)
        await until(lambda: len(provider.book) == 2)
        async with floor.chain_of("provider") as chain:
            await chain.liabilities.create(floor.lighthouse, demand, offer)

        await until(lambda: list(provider.book.orders()) == [verify_message(other)])


async def test_another_persons_order_with_the_same_terms_stays(floor: Floor) -> None:
    demand = floor.demand()
    fields = {field: getattr(demand, field) for field in demand.__struct_fields__}
    copy = floor.accounts["rival"].signer.sign(Demand(**fields))
    async with floor.provider() as provider:
        floor.publish(demand, copy)
        await until(lambda: len(provider.book) == 2)
        async with floor.chain_of("provider") as chain:
            await chain.liabilities.create(floor.lighthouse, demand, floor.offer())

        await until(lambda: list(provider.book.orders()) == [verify_message(copy)])


async def test_a_provider_that_was_restarted_takes_up_orders_that_are_sent_again(floor: Floor) -> None:
    demand = floor.demand()
    async with floor.provider() as provider:
        floor.publish(demand)
        await until(lambda: len(provider.book) == 1)

    async with floor.provider() as provider:
        assert len(provider.book) == 0
        floor.publish(demand, floor.offer())

        await floor.liability_of(demand)


async def test_a_contract_of_before_the_start_is_ended_too(floor: Floor) -> None:
    demand = floor.demand()
    async with floor.chain_of("provider") as chain:
        created = await chain.liabilities.create(floor.lighthouse, demand, floor.offer())
    async with floor.provider() as provider:
        floor.publish(floor.result(created.liability, success=False))

        await until(lambda: provider.earnings().finalized == 1)
        assert not (await floor.chain.liabilities.get(created.liability)).is_success


async def test_a_full_book_says_so_and_takes_the_order_when_there_is_room(floor: Floor) -> None:
    async with floor.provider(limit=1) as provider:
        first, second = floor.demand(cost=0), floor.demand(cost=1)
        floor.publish(first, second)
        assert (await floor.rejection_of(second)).reason == "full"

        floor.publish(floor.offer(cost=0))
        await until(lambda: provider.earnings().created == 1)
        floor.publish(second)

        await until(lambda: list(provider.book.orders()) == [verify_message(second)])
