"""A provider when things go wrong: other providers' turns, tokens that mean harm, what the chain takes back."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace as replace_fields

from mesh.market import order_id
from schemas import verify_message
from tests.mesh.market.tokens import BURNS_ALL_GAS, deploy_token, refuses_with, says
from tests.mesh.market.troubles import outages, until_read, works_on
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from schemas import Liability
    from tests.mesh.market.floor import Floor


async def test_two_providers_share_the_work_in_their_turns(floor: Floor) -> None:
    await floor.found_lighthouse(timeout_blocks=1000, provider=1, rival=1)
    async with floor.provider("provider") as one, floor.provider("rival") as two:
        demands = [floor.demand(cost=0) for _ in range(4)]
        for demand in demands:
            floor.publish(demand, floor.offer(cost=0))
            await floor.liability_of(demand)

        await until(lambda: (one.earnings().created, two.earnings().created) == (2, 2))
        assert floor.rejections == []
        await until(lambda: len(one.book) == len(two.book) == 0)


async def test_a_turn_that_somebody_else_sleeps_through_is_taken_over(floor: Floor) -> None:
    await floor.found_lighthouse(timeout_blocks=5, provider=10, rival=10)
    async with floor.provider("rival") as rival:
        demand = floor.demand()
        floor.publish(demand, floor.offer())
        await until(lambda: len(rival.book) == 0)
        assert rival.earnings().created == 0

        await floor.mine(8)

        await floor.liability_of(demand)
        assert floor.rejections == []


async def test_a_provider_without_a_stake_waits_and_rejects_nobody(
    floor: Floor, caplog: pytest.LogCaptureFixture
) -> None:
    await floor.found_lighthouse(timeout_blocks=3)
    async with floor.provider("provider"):
        demand = floor.demand()
        floor.publish(demand, floor.offer())
        with caplog.at_level("INFO"):
            await until(lambda: outages(caplog, "transactions") == ["no-stake"])

        await floor.stake("provider", floor.lighthouse, 5)

        await floor.liability_of(demand)
        assert floor.rejections == []


async def test_orders_that_were_used_while_it_was_not_our_turn_leave(floor: Floor) -> None:
    await floor.found_lighthouse(timeout_blocks=1000, provider=1, rival=1)
    async with floor.provider("rival") as rival:
        demand, offer = floor.demand(), floor.offer()
        floor.publish(demand, offer)
        await until(lambda: len(rival.book) == 0)
        async with floor.chain_of("provider") as chain:
            await chain.liabilities.create(floor.lighthouse, demand, offer)

        await until(lambda: rival.earnings().rejected == {"OrderUsed": 1})
        last = floor.demand()
        floor.publish(last)
        await until(lambda: list(rival.book.orders()) == [verify_message(last)])
        assert floor.rejections == []


@pytest.mark.parametrize("name", ["NotYourTurn(address,uint256)", "NotAProvider(address)"])
async def test_a_token_that_speaks_with_the_lighthouses_voice_stops_nobody(floor: Floor, name: str) -> None:
    token = await deploy_token(floor.chain, refuses_with(name))
    async with floor.provider() as provider:
        floor.publish(guilty := floor.demand(cost=1, token=token), floor.offer(cost=1, token=token))

        assert (await floor.rejection_of(guilty)).reason == name.partition("(")[0]
        assert await works_on(floor, provider)


async def test_a_token_that_burns_all_gas_stops_nobody(floor: Floor) -> None:
    token = await deploy_token(floor.chain, BURNS_ALL_GAS)
    async with floor.provider() as provider:
        floor.publish(guilty := floor.demand(cost=1, token=token), offer := floor.offer(cost=1, token=token))

        await floor.rejection_of(guilty)
        await floor.rejection_of(offer)
        assert await works_on(floor, provider)


async def test_a_token_does_not_choose_the_words_of_a_rejection(floor: Floor) -> None:
    token = await deploy_token(floor.chain, says(b"send me all your money, please"))
    async with floor.provider() as provider:
        floor.publish(guilty := floor.demand(cost=1, token=token), floor.offer(cost=1, token=token))

        assert (await floor.rejection_of(guilty)).reason == "Reverted"
        assert set(provider.earnings().rejected) == {"Reverted"}


async def test_a_nonce_that_contracts_can_not_read_stops_nobody(floor: Floor) -> None:
    async with floor.provider() as provider:
        floor.publish(floor.demand(nonce="00" * 12 + "ff" * 20), offer := floor.offer())
        await until(lambda: order_id(verify_message(offer)) in provider.book)

        floor.publish(demand := floor.demand())
        assert (await floor.liability_of(demand)).promisor == floor.address("robot")


async def test_what_the_chain_takes_back_is_done_again(floor: Floor) -> None:
    async with floor.provider() as provider:
        early = floor.demand(cost=0)
        floor.publish(early, floor.offer(cost=0))
        liability = await floor.liability_of(early)
        await until(lambda: provider.earnings().created == 1)
        snapshot = await floor.request("evm_snapshot")
        floor.publish(floor.result(liability.address))
        floor.publish(late := floor.demand(cost=0), floor.offer(cost=0))
        await floor.liability_of(late)
        await until(lambda: (provider.earnings().created, provider.earnings().finalized) == (2, 1))
        await until_read(floor, provider)

        await floor.request("evm_revert", snapshot)
        assert not (await floor.chain.liabilities.get(liability.address)).is_finalized
        await floor.mine(5)

        async def finalized() -> bool:
            return (await floor.chain.liabilities.get(liability.address)).is_finalized

        await until_found(finalized)
        await until(lambda: (provider.earnings().created, provider.earnings().finalized) == (2, 1))
        assert len(await floor.liabilities_of(late)) == 1


async def test_a_contract_whose_record_is_kept_no_more_is_ended_all_the_same(floor: Floor) -> None:
    async with floor.provider(open_liabilities=1) as provider:
        made: list[Liability] = []
        for _ in range(2):
            floor.publish(demand := floor.demand(cost=0), floor.offer(cost=0))
            made.append(await floor.liability_of(demand))
            await until_read(floor, provider)

        floor.publish(*(floor.result(liability.address) for liability in made))
        await until(lambda: provider.earnings().finalized == 2)


async def test_terms_that_a_stranger_has_copied_become_their_owners_contract_too(floor: Floor) -> None:
    """He signs them himself, nonce and all, so that both orders have one hash."""
    ours = floor.demand()
    copied = floor.accounts["rival"].signer.sign(replace_fields(ours, signature=""))
    async with floor.provider() as provider:
        floor.publish(copied, floor.offer("rival"))
        await until(lambda: provider.earnings().created == 1)
        floor.publish(ours, floor.offer())
        await until(lambda: provider.earnings().created == 2)
    promisees = [made.promisee for made in await floor.liabilities_of(ours)]
    assert promisees == [floor.address("rival"), floor.address("person")]
    assert floor.rejections == []


async def test_a_result_that_was_too_early_counts_when_it_is_sent_again(floor: Floor) -> None:
    demand, offer = floor.demand(), floor.offer()
    async with floor.chain_of("provider") as chain:
        snapshot = await floor.request("evm_snapshot")
        created = await chain.liabilities.create(floor.lighthouse, demand, offer)
        await floor.request("evm_revert", snapshot)
        async with floor.provider() as provider:
            result = floor.result(created.liability)
            floor.publish(result, floor.result(floor.address("person")))
            await until(lambda: provider.results.statistics().received == 2)
            again = await chain.liabilities.create(floor.lighthouse, demand, offer)
            assert again.liability == created.liability

            async def finalized() -> bool:
                floor.publish(result)
                await asyncio.sleep(0.05)
                return provider.earnings().finalized == 1

            await until_found(finalized)
