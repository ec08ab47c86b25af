"""A provider on a real chain and a real router: matches, rejections and payments."""

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
from tests.support.provider.held_node import HeldNode
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from tests.support.provider.local_market import LocalMarket


async def test_a_demand_and_an_offer_become_a_contract(local: LocalMarket) -> None:
    matched: list[Match] = []
    async with local.provider(matched=matched.append) as provider:
        demand, offer = local.demand(), local.offer()
        local.publish(demand, offer)

        liability = await local.liability_of(demand)

        assert (liability.promisee, liability.promisor) == (local.address("person"), local.address("robot"))
        assert (liability.model, liability.objective, liability.lighthouse) == (
            demand.model,
            demand.objective,
            local.lighthouse,
        )
        await until(lambda: provider.earnings().created == 1)
        assert matched == [Match(verify_message(demand), verify_message(offer))]
        assert len(provider.book) == 0
        assert provider.earnings().gas_used > 100_000


async def test_a_result_finalizes_the_contract_and_pays(local: LocalMarket) -> None:
    await local.chain.tokens.approve(local.chain.factory, 2 * XRT)
    before = await local.chain.tokens.balance(local.address("robot"))
    async with local.provider() as provider:
        demand = local.demand(cost=2 * XRT)
        local.publish(demand, local.offer(cost=2 * XRT))
        liability = await local.liability_of(demand)
        local.publish(local.result(liability.address))

        await until(lambda: provider.earnings().finalized == 1)

        ended = await local.chain.liabilities.get(liability.address)
        assert (ended.is_finalized, ended.is_success) == (True, True)
        assert await local.chain.tokens.balance(local.address("robot")) == before + 2 * XRT


async def test_the_provider_earns_the_lighthouse_fee(local: LocalMarket) -> None:
    async with local.chain_of("robot") as robots:
        await robots.tokens.approve(robots.factory, 5)
    before = await local.chain.tokens.balance(local.address("provider"))
    async with local.provider() as provider:
        demand = local.demand()
        local.publish(demand, local.offer(lighthouse_fee=5))
        await until(lambda: provider.earnings().created == 1)

        assert provider.earnings().fees == 5
        assert await local.chain.tokens.balance(local.address("provider")) == before + 5


async def test_orders_of_generation_5_become_a_contract(local: LocalMarket) -> None:
    person, robot = local.address("person"), local.address("robot")
    async with local.provider():
        demand = local.demand(sender=person, nonce=await local.chain.liabilities.next_nonce(person))
        local.publish(demand, local.offer(sender=robot, nonce=await local.chain.liabilities.next_nonce(robot)))

        assert (await local.liability_of(demand)).promisee == person


async def test_orders_of_different_generations_do_not_match(local: LocalMarket) -> None:
    robot = local.address("robot")
    async with local.provider() as provider:
        fifth = local.offer(sender=robot, nonce=await local.chain.liabilities.next_nonce(robot))
        demand, third = local.demand(), local.offer()
        local.publish(fifth, demand)
        await until(lambda: len(provider.book) == 2)
        local.publish(third)

        await local.liability_of(demand)
        assert list(provider.book.orders()) == [verify_message(fifth)]
        assert provider.earnings().rejected == {}


async def test_names_in_orders_are_looked_up_on_the_chain(local: LocalMarket) -> None:
    async with local.provider():
        demand = local.demand()
        named = Demand(
            **{field: getattr(demand, field) for field in demand.__struct_fields__} | {"token": "xrt.3.robonomics.eth"}
        )
        local.session.put(message_key(local.market, demand), encode(named))
        local.publish(local.offer())

        assert (await local.liability_of(demand)).token == local.deployment.xrt


async def test_a_demand_without_money_is_rejected_and_its_offer_stays(local: LocalMarket) -> None:
    async with local.chain_of("poor") as chain:
        await chain.tokens.approve(chain.factory, 7)
    await local.chain.tokens.approve(local.chain.factory, 7)
    async with local.provider() as provider:
        bad, good, offer = local.demand("poor", cost=7), local.demand(cost=7), local.offer(cost=7)
        local.publish(bad, offer)

        rejection = await local.rejection_of(bad)
        assert (rejection.reason, rejection.provider) == ("ERC20InsufficientBalance", provider.address)
        await until(lambda: order_id(verify_message(offer)) in provider.book)
        local.publish(good)

        assert (await local.liability_of(offer)).promisee == local.address("person")
        assert provider.earnings().rejected == {"ERC20InsufficientBalance": 1}


async def test_an_offer_without_allowance_for_its_fee_is_rejected_and_its_demand_stays(local: LocalMarket) -> None:
    async with local.provider() as provider:
        bad, good, demand = local.offer("poor", lighthouse_fee=9), local.offer(), local.demand()
        local.publish(demand, bad)

        assert (await local.rejection_of(bad)).reason == "ERC20InsufficientAllowance"
        await until(lambda: order_id(verify_message(demand)) in provider.book)
        local.publish(good)

        assert (await local.liability_of(demand)).promisor == local.address("robot")


async def test_a_demand_of_generation_5_with_a_wrong_nonce_is_rejected(local: LocalMarket) -> None:
    person, robot = local.address("person"), local.address("robot")
    async with local.provider() as provider:
        bad = local.demand(sender=person, nonce=await local.chain.liabilities.next_nonce(person) + 5)
        offer = local.offer(sender=robot, nonce=await local.chain.liabilities.next_nonce(robot))
        local.publish(bad, offer)

        assert (await local.rejection_of(bad)).reason == "WrongSigner"
        await until(lambda: list(provider.book.orders()) == [verify_message(offer)])


async def test_a_used_order_leaves_without_a_rejection_and_the_other_one_stays(local: LocalMarket) -> None:
    used, partner = local.demand(), local.offer()
    async with local.chain_of("provider") as chain:
        await chain.liabilities.create(local.lighthouse, used, partner)
    async with local.provider() as provider:
        offer = local.offer()
        local.publish(used, offer)

        await until(lambda: provider.earnings().rejected == {"OrderUsed": 1})
        await until(lambda: list(provider.book.orders()) == [verify_message(offer)])
        assert local.rejections == []


async def test_both_orders_of_a_match_that_was_used_elsewhere_leave(local: LocalMarket) -> None:
    demand, offer = local.demand(), local.offer()
    async with local.chain_of("provider") as chain:
        await chain.liabilities.create(local.lighthouse, demand, offer)
    async with local.provider() as provider:
        local.publish(demand, offer)

        await until(lambda: provider.earnings().rejected == {"OrderUsed": 1})
        last = local.demand(cost=1)
        local.publish(last)
        await until(lambda: list(provider.book.orders()) == [verify_message(last)])


async def test_both_orders_of_a_used_match_of_generation_5_leave(local: LocalMarket) -> None:
    person, robot = local.address("person"), local.address("robot")
    demand = local.demand(sender=person, nonce=await local.chain.liabilities.next_nonce(person))
    offer = local.offer(sender=robot, nonce=await local.chain.liabilities.next_nonce(robot))
    async with local.chain_of("provider") as chain:
        await chain.liabilities.create(local.lighthouse, demand, offer)
    async with local.provider() as provider:
        local.publish(demand, offer)

        await until(lambda: provider.earnings().rejected == {"WrongSigner": 1})
        last = local.demand(cost=1)
        local.publish(last)
        await until(lambda: list(provider.book.orders()) == [verify_message(last)])


async def test_a_forged_result_is_rejected_and_the_promisors_result_counts(local: LocalMarket) -> None:
    async with local.provider() as provider:
        demand = local.demand()
        local.publish(demand, local.offer())
        liability = await local.liability_of(demand)
        forged = local.result(liability.address, "rival")
        local.publish(forged)

        assert (await local.rejection_of(forged)).reason == "WrongSigner"
        assert not (await local.chain.liabilities.get(liability.address)).is_finalized
        local.publish(local.result(liability.address))
        await until(lambda: provider.earnings().finalized == 1)


async def test_results_for_a_finalized_or_unknown_contract_change_nothing(local: LocalMarket) -> None:
    async with local.provider() as provider:
        demand = local.demand()
        local.publish(demand, local.offer())
        liability = await local.liability_of(demand)
        local.publish(local.result(liability.address))
        await until(lambda: provider.earnings().finalized == 1)

        local.publish(
            local.result(liability.address, success=False),
            local.result(local.address("person")),
            last := local.demand(cost=0),
        )

        await until(lambda: verify_message(last) in provider.book.orders())
        assert provider.earnings().finalized == 1
        assert local.rejections == []


async def test_a_provider_is_present_while_it_is_open(local: LocalMarket) -> None:
    expected = PresenceKey(local.market, "provider", local.address("provider"))
    async with local.provider():
        await until_present(local, [expected])
    await until_present(local, [])


async def test_leaving_while_contracts_are_created_does_not_hang(local: LocalMarket) -> None:
    async with asyncio.timeout(60):
        async with local.provider() as provider:
            for _ in range(50):
                local.publish(local.demand(), local.offer())
            await until(lambda: provider.earnings().created >= 1)

        assert provider.earnings().created < 50


async def test_a_provider_runs_inside_async_with_and_needs_an_account(local: LocalMarket) -> None:
    with pytest.raises(ValueError, match="account"):
        Provider(local.session, Chain(local.node), local.market)
    async with local.chain_of("provider") as chain:
        provider = Provider(local.session, chain, local.market)
        with pytest.raises(ClosedError):
            await provider.run()
        assert provider.earnings() == Earnings(
            created=0, finalized=0, rejected={}, gas_used=0, spent=0, fees=0, minted=0
        )
        async with provider:
            pass
        with pytest.raises(ClosedError):
            await provider.run()


async def until_present(local: LocalMarket, expected: list[PresenceKey]) -> None:
    async def search() -> bool:
        return await local.channel.present() == expected

    await until_found(search, what=f"the presence of {expected}")


async def test_several_transactions_wait_to_be_mined_at_the_same_time(local: LocalMarket) -> None:
    async with HeldNode(local.node) as node, local.provider(endpoint=node) as provider:
        demands = [local.demand() for _ in range(3)]
        with node.back("eth_getTransactionReceipt"):
            for demand in demands:
                local.publish(demand, local.offer())
            for demand in demands:
                await local.liability_of(demand)
            assert not provider.queue.is_down, "none had to fail before the next was sent"
        await until(lambda: provider.earnings().created == 3)
        assert local.rejections == []


async def test_no_more_transactions_than_the_limit_wait_to_be_mined(local: LocalMarket) -> None:
    before = len(await local.chain.liabilities.list())
    async with HeldNode(local.node) as node, local.provider(endpoint=node, unmined_limit=2) as provider:
        with node.back("eth_getTransactionReceipt"):
            for _ in range(5):
                demand = local.demand()
                local.publish(demand, local.offer())
            await until(lambda: node.waiting["eth_getTransactionReceipt"] == 2)
            assert provider.queue.waiting == 3
            assert len(await local.chain.liabilities.list()) == before + 2
        await until(lambda: provider.earnings().created == 5)
