"""A provider among other providers, malicious tokens and reorganisations."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace as replace_fields

from mesh.market import order_id
from schemas import verify_message
from tests.support.provider.observation import outages, until_read, works_on
from tests.support.provider.tokens import BURNS_ALL_GAS, deploy_token, readable, refuses_with, says
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from schemas import Liability
    from tests.support.provider.local_market import LocalMarket


async def test_two_providers_share_the_work_in_turns(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=1000, provider=1, rival=1)
    async with local.provider("provider") as one, local.provider("rival") as two:
        demands = [local.demand(cost=0) for _ in range(4)]
        for demand in demands:
            local.publish(demand, local.offer(cost=0))
            await local.liability_of(demand)

        await until(lambda: (one.earnings().created, two.earnings().created) == (2, 2))
        assert local.rejections == []
        await until(lambda: len(one.book) == len(two.book) == 0)


async def test_an_unused_turn_is_taken_over_after_the_timeout(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=5, provider=10, rival=10)
    async with local.provider("rival") as rival:
        demand = local.demand()
        local.publish(demand, local.offer())
        await until(lambda: rival.queue.waiting == 1 and rival.ledger.turnover().matches == 1)
        assert rival.earnings().created == 0

        await local.mine(8)

        await local.liability_of(demand)
        assert local.rejections == []


async def test_a_provider_without_a_stake_waits_and_rejects_nothing(
    local: LocalMarket, caplog: pytest.LogCaptureFixture
) -> None:
    await local.create_lighthouse(timeout_blocks=3)
    async with local.provider("provider"):
        demand = local.demand()
        local.publish(demand, local.offer())
        with caplog.at_level("INFO"):
            await until(lambda: outages(caplog, "transactions") == ["no-stake"])

        await local.stake("provider", local.lighthouse, 5)

        await local.liability_of(demand)
        assert local.rejections == []


async def test_orders_that_were_used_during_another_providers_turn_leave(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=1000, provider=1, rival=1)
    async with local.provider("rival") as rival:
        demand, offer = local.demand(), local.offer()
        local.publish(demand, offer)
        await until(lambda: rival.queue.waiting == 1 and rival.ledger.turnover().matches == 1)
        async with local.chain_of("provider") as chain:
            await chain.liabilities.create(local.lighthouse, demand, offer)

        await until(lambda: rival.earnings().rejected == {"OrderUsed": 1})
        last = local.demand()
        local.publish(last)
        await until(lambda: list(rival.book.orders()) == [verify_message(last)])
        assert local.rejections == []


@pytest.mark.parametrize("name", ["NotYourTurn(address,uint256)", "NotAProvider(address)"])
async def test_a_token_that_reverts_with_a_lighthouse_error_stops_nothing(local: LocalMarket, name: str) -> None:
    token = await deploy_token(local.chain, readable(refuses_with(name)))
    async with local.provider() as provider:
        local.publish(bad := local.demand(cost=1, token=token), local.offer(cost=1, token=token))

        assert (await local.rejection_of(bad)).reason == name.partition("(")[0]
        assert await works_on(local, provider)


async def test_a_token_that_burns_all_gas_does_not_stop_the_provider(local: LocalMarket) -> None:
    token = await deploy_token(local.chain, readable(BURNS_ALL_GAS))
    async with local.provider() as provider:
        local.publish(bad := local.demand(cost=1, token=token), offer := local.offer(cost=1, token=token))

        await local.rejection_of(bad)
        await local.rejection_of(offer)
        assert await works_on(local, provider)


async def test_an_order_in_a_token_that_tells_no_balances_is_not_matched(local: LocalMarket) -> None:
    token = await deploy_token(local.chain, BURNS_ALL_GAS)
    async with local.provider() as provider:
        local.publish(bad := local.demand(cost=1, token=token), local.offer(cost=1, token=token))

        assert (await local.rejection_of(bad)).reason == "TokenUnreadable"
        assert await works_on(local, provider)
        assert provider.ledger.turnover().matches == 1


async def test_the_text_of_a_token_is_not_the_reason_of_a_rejection(local: LocalMarket) -> None:
    token = await deploy_token(local.chain, readable(says(b"send me all your money, please")))
    async with local.provider() as provider:
        local.publish(bad := local.demand(cost=1, token=token), local.offer(cost=1, token=token))

        assert (await local.rejection_of(bad)).reason == "Reverted"
        assert set(provider.earnings().rejected) == {"Reverted"}


async def test_an_invalid_nonce_does_not_stop_the_provider(local: LocalMarket) -> None:
    async with local.provider() as provider:
        local.publish(local.demand(nonce="00" * 12 + "ff" * 20), offer := local.offer())
        await until(lambda: order_id(verify_message(offer)) in provider.book)

        local.publish(demand := local.demand())
        assert (await local.liability_of(demand)).promisor == local.address("robot")


async def test_transactions_that_a_reorganisation_reverts_are_sent_again(local: LocalMarket) -> None:
    async with local.provider() as provider:
        early = local.demand(cost=0)
        local.publish(early, local.offer(cost=0))
        liability = await local.liability_of(early)
        await until(lambda: provider.earnings().created == 1)
        snapshot = await local.request("evm_snapshot")
        local.publish(local.result(liability.address))
        local.publish(late := local.demand(cost=0), local.offer(cost=0))
        await local.liability_of(late)
        await until(lambda: (provider.earnings().created, provider.earnings().finalized) == (2, 1))
        await until_read(local, provider)

        await local.request("evm_revert", snapshot)
        assert not (await local.chain.liabilities.get(liability.address)).is_finalized
        await local.mine(5)

        async def finalized() -> bool:
            return (await local.chain.liabilities.get(liability.address)).is_finalized

        await until_found(finalized)
        await local.liability_of(late)
        await until(lambda: (provider.earnings().created, provider.earnings().finalized) == (2, 1))
        assert len(await local.liabilities_of(late)) == 1


async def test_a_contract_whose_record_was_dropped_is_finalized(local: LocalMarket) -> None:
    async with local.provider(open_liabilities=1) as provider:
        made: list[Liability] = []
        for _ in range(2):
            local.publish(demand := local.demand(cost=0), local.offer(cost=0))
            made.append(await local.liability_of(demand))
            await until_read(local, provider)

        local.publish(*(local.result(liability.address) for liability in made))
        await until(lambda: provider.earnings().finalized == 2)


async def test_copied_terms_do_not_keep_the_original_from_becoming_a_contract(local: LocalMarket) -> None:
    """A stranger signs the same terms and nonce, so that both orders have the same hash."""
    ours = local.demand()
    copied = local.accounts["rival"].signer.sign(replace_fields(ours, signature=""))
    async with local.provider() as provider:
        local.publish(copied, local.offer("rival"))
        await until(lambda: provider.earnings().created == 1)
        local.publish(ours, local.offer())
        await until(lambda: provider.earnings().created == 2)
    promisees = [made.promisee for made in await local.liabilities_of(ours)]
    assert promisees == [local.address("rival"), local.address("person")]
    assert local.rejections == []


async def test_a_result_that_arrived_too_early_counts_when_it_is_sent_again(local: LocalMarket) -> None:
    demand, offer = local.demand(), local.offer()
    async with local.chain_of("provider") as chain:
        snapshot = await local.request("evm_snapshot")
        created = await chain.liabilities.create(local.lighthouse, demand, offer)
        await local.request("evm_revert", snapshot)
        async with local.provider() as provider:
            result = local.result(created.liability)
            local.publish(result, local.result(local.address("person")))
            await until(lambda: provider.results.statistics().received == 2)
            again = await chain.liabilities.create(local.lighthouse, demand, offer)
            assert again.liability == created.liability

            async def finalized() -> bool:
                local.publish(result)
                await asyncio.sleep(0.05)
                return provider.earnings().finalized == 1

            await until_found(finalized)
