"""A provider on a real chain and a real router: what it matches, refuses and pays out."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from mesh.chain import XRT, Chain
from mesh.errors import ClosedError
from mesh.market import Match, order_id
from mesh.market.provider import Earnings, Provider
from mesh.network import message_key
from schemas import Demand, PresenceKey, encode, verify_message
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from tests.mesh.market.floor import Floor


async def test_a_demand_and_an_offer_become_a_contract(floor: Floor) -> None:
    matched: list[Match] = []
    async with floor.provider(matched=matched.append) as provider:
        demand, offer = floor.demand(), floor.offer()
        floor.publish(demand, offer)

        liability = await floor.liability_of(demand)

        assert (liability.promisee, liability.promisor) == (floor.address("person"), floor.address("robot"))
        assert (liability.model, liability.objective, liability.lighthouse) == (
            demand.model,
            demand.objective,
            floor.lighthouse,
        )
        await until(lambda: provider.earnings().created == 1)
        assert matched == [Match(verify_message(demand), verify_message(offer))]
        assert len(provider.book) == 0
        assert provider.earnings().gas_used > 100_000


async def test_a_result_ends_the_contract_and_pays(floor: Floor) -> None:
    await floor.chain.tokens.approve(floor.chain.factory, 2 * XRT)
    before = await floor.chain.tokens.balance(floor.address("robot"))
    async with floor.provider() as provider:
        demand = floor.demand(cost=2 * XRT)
        floor.publish(demand, floor.offer(cost=2 * XRT))
        liability = await floor.liability_of(demand)
        floor.publish(floor.result(liability.address))

        await until(lambda: provider.earnings().finalized == 1)

        ended = await floor.chain.liabilities.get(liability.address)
        assert (ended.is_finalized, ended.is_success) == (True, True)
        assert await floor.chain.tokens.balance(floor.address("robot")) == before + 2 * XRT


async def test_the_provider_wins_the_lighthouse_fee(floor: Floor) -> None:
    async with floor.chain_of("robot") as robots:
        await robots.tokens.approve(robots.factory, 5)
    before = await floor.chain.tokens.balance(floor.address("provider"))
    async with floor.provider() as provider:
        demand = floor.demand()
        floor.publish(demand, floor.offer(lighthouse_fee=5))
        await until(lambda: provider.earnings().created == 1)

        assert provider.earnings().fees == 5
        assert await floor.chain.tokens.balance(floor.address("provider")) == before + 5


async def test_orders_of_generation_5_become_a_contract(floor: Floor) -> None:
    person, robot = floor.address("person"), floor.address("robot")
    async with floor.provider():
        demand = floor.demand(sender=person, nonce=await floor.chain.liabilities.next_nonce(person))
        floor.publish(demand, floor.offer(sender=robot, nonce=await floor.chain.liabilities.next_nonce(robot)))

        assert (await floor.liability_of(demand)).promisee == person


async def test_orders_of_different_generations_do_not_match(floor: Floor) -> None:
    robot = floor.address("robot")
    async with floor.provider() as provider:
        fifth = floor.offer(sender=robot, nonce=await floor.chain.liabilities.next_nonce(robot))
        demand, third = floor.demand(), floor.offer()
        floor.publish(fifth, demand)
        await until(lambda: len(provider.book) == 2)
        floor.publish(third)

        await floor.liability_of(demand)
        assert list(provider.book.orders()) == [verify_message(fifth)]
        assert provider.earnings().rejected == {}


async def test_names_in_orders_are_looked_up_on_the_chain(floor: Floor) -> None:
    async with floor.provider():
        demand = floor.demand()
        named = Demand(
            **{field: getattr(demand, field) for field in demand.__struct_fields__} | {"token": "xrt.3.robonomics.eth"}
        )
        floor.session.put(message_key(floor.market, demand), encode(named))
        floor.publish(floor.offer())

        assert (await floor.liability_of(demand)).token == floor.deployment.xrt


async def test_a_demand_without_money_is_rejected_and_the_offer_stays_for_the_next(floor: Floor) -> None:
    async with floor.chain_of("poor") as chain:
        await chain.tokens.approve(chain.factory, 7)
    await floor.chain.tokens.approve(floor.chain.factory, 7)
    async with floor.provider() as provider:
        guilty, innocent, offer = floor.demand("poor", cost=7), floor.demand(cost=7), floor.offer(cost=7)
        floor.publish(guilty, offer)

        rejection = await floor.rejection_of(guilty)
        assert (rejection.reason, rejection.provider) == ("ERC20InsufficientBalance", provider.address)
        await until(lambda: order_id(verify_message(offer)) in provider.book)
        floor.publish(innocent)

        assert (await floor.liability_of(offer)).promisee == floor.address("person")
        assert provider.earnings().rejected == {"ERC20InsufficientBalance": 1}


async def test_an_offer_that_does_not_allow_its_fee_is_rejected_and_the_demand_stays(floor: Floor) -> None:
    async with floor.provider() as provider:
        guilty, innocent, demand = floor.offer("poor", lighthouse_fee=9), floor.offer(), floor.demand()
        floor.publish(demand, guilty)

        assert (await floor.rejection_of(guilty)).reason == "ERC20InsufficientAllowance"
        await until(lambda: order_id(verify_message(demand)) in provider.book)
        floor.publish(innocent)

        assert (await floor.liability_of(demand)).promisor == floor.address("robot")


async def test_a_wrong_nonce_of_generation_5_is_its_senders_fault(floor: Floor) -> None:
    person, robot = floor.address("person"), floor.address("robot")
    async with floor.provider() as provider:
        guilty = floor.demand(sender=person, nonce=await floor.chain.liabilities.next_nonce(person) + 5)
        offer = floor.offer(sender=robot, nonce=await floor.chain.liabilities.next_nonce(robot))
        floor.publish(guilty, offer)

        assert (await floor.rejection_of(guilty)).reason == "WrongSigner"
        await until(lambda: list(provider.book.orders()) == [verify_message(offer)])


async def test_a_used_order_leaves_without_a_word_and_the_other_one_stays(floor: Floor) -> None:
    used, partner = floor.demand(), floor.offer()
    async with floor.chain_of("provider") as chain:
        await chain.liabilities.create(floor.lighthouse, used, partner)
    async with floor.provider() as provider:
        offer = floor.offer()
        floor.publish(used, offer)

        await until(lambda: provider.earnings().rejected == {"OrderUsed": 1})
        await until(lambda: list(provider.book.orders()) == [verify_message(offer)])
        assert floor.rejections == []


async def test_of_a_pair_that_was_used_elsewhere_neither_stays(floor: Floor) -> None:
    demand, offer = floor.demand(), floor.offer()
    async with floor.chain_of("provider") as chain:
        await chain.liabilities.create(floor.lighthouse, demand, offer)
    async with floor.provider() as provider:
        floor.publish(demand, offer)

        await until(lambda: provider.earnings().rejected == {"OrderUsed": 1})
        last = floor.demand(cost=1)
        floor.publish(last)
        await until(lambda: list(provider.book.orders()) == [verify_message(last)])


async def test_of_a_used_pair_of_generation_5_neither_stays(floor: Floor) -> None:
    person, robot = floor.address("person"), floor.address("robot")
    demand = floor.demand(sender=person, nonce=await floor.chain.liabilities.next_nonce(person))
    offer = floor.offer(sender=robot, nonce=await floor.chain.liabilities.next_nonce(robot))
    async with floor.chain_of("provider") as chain:
        await chain.liabilities.create(floor.lighthouse, demand, offer)
    async with floor.provider() as provider:
        floor.publish(demand, offer)

        await until(lambda: provider.earnings().rejected == {"WrongSigner": 1})
        last = floor.demand(cost=1)
        floor.publish(last)
        await until(lambda: list(provider.book.orders()) == [verify_message(last)])


async def test_a_result_of_somebody_else_is_rejected_and_the_promisors_own_counts(floor: Floor) -> None:
    async with floor.provider() as provider:
        demand = floor.demand()
        floor.publish(demand, floor.offer())
        liability = await floor.liability_of(demand)
        forged = floor.result(liability.address, "rival")
        floor.publish(forged)

        assert (await floor.rejection_of(forged)).reason == "WrongSigner"
        assert not (await floor.chain.liabilities.get(liability.address)).is_finalized
        floor.publish(floor.result(liability.address))
        await until(lambda: provider.earnings().finalized == 1)


async def test_a_result_for_a_finished_contract_and_one_without_a_contract_change_nothing(floor: Floor) -> None:
    async with floor.provider() as provider:
        demand = floor.demand()
        floor.publish(demand, floor.offer())
        liability = await floor.liability_of(demand)
        floor.publish(floor.result(liability.address))
        await until(lambda: provider.earnings().finalized == 1)

        floor.publish(
            floor.result(liability.address, success=False),
            floor.result(floor.address("person")),
            last := floor.demand(cost=1),
        )

        await until(lambda: verify_message(last) in provider.book.orders())
        assert provider.earnings().finalized == 1
        assert floor.rejections == []


async def test_a_provider_is_present_while_it_is_open(floor: Floor) -> None:
    expected = PresenceKey(floor.market, "provider", floor.address("provider"))
    async with floor.provider():
        await until_present(floor, [expected])
    await until_present(floor, [])


async def test_leaving_with_orders_under_way_does_not_hang(floor: Floor) -> None:
    async with asyncio.timeout(10):
        async with floor.provider() as provider:
            for _ in range(50):
                floor.publish(floor.demand(), floor.offer())
            await until(lambda: provider.earnings().created >= 1)

        assert provider.earnings().created < 50


async def test_a_provider_runs_inside_async_with_and_needs_an_account(floor: Floor) -> None:
    with pytest.raises(ValueError, match="account"):
        Provider(floor.session, Chain(floor.node), floor.market)
    async with floor.chain_of("provider") as chain:
        provider = Provider(floor.session, chain, floor.market)
        with pytest.raises(ClosedError):
            await provider.run()
        assert provider.earnings() == Earnings(
            created=0, finalized=0, rejected={}, gas_used=0, spent=0, fees=0, minted=0
        )
        async with provider:
            pass
        with pytest.raises(ClosedError):
            await provider.run()


async def until_present(floor: Floor, expected: list[PresenceKey]) -> None:
    async def search() -> bool:
        return await floor.channel.present() == expected

    await until_found(search, what=f"the presence of {expected}")
