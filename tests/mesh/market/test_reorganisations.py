"""A reorganisation at each moment of a settlement: what it undoes is done again, and no contract is paid twice."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from mesh.dev.development import deploy_market
from tests.support.provider.held_node import HeldNode
from tests.support.provider.local_market import QUICK, LocalMarket
from tests.support.provider.observation import until_read
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from mesh.market.provider import Provider
    from mesh.testing import MarketChain
    from schemas import Demand, Liability
    from tests.support.routers import EmbeddedRouter

    Reorganise = Callable[["Forking"], Awaitable[None]]

COST = 5
QUICK = replace(QUICK, replace_after=1.0)
BEFORE_THE_RECEIPT, BEFORE_THE_EVENT = "eth_getTransactionReceipt", "eth_getLogs"
REPAIR = "eth_sendRawTransaction"
MOMENTS = {"before the receipt": BEFORE_THE_RECEIPT, "before the event is read": BEFORE_THE_EVENT}


class Forking:
    """A local market with a node whose last block can be replaced, and a person who can pay."""

    def __init__(self, local: LocalMarket, node: HeldNode) -> None:
        self.local = local
        self.node = node

    async def replace_last(self) -> None:
        """Replace the last block by an empty one."""
        if isinstance(self.local.node, str):
            await self.local.request("anvil_reorg", 1, [])
        else:
            await self.drop_last()
            await self.local.mine(1)

    async def drop_last(self) -> None:
        """Take the last block away: the chain is one block shorter."""
        if isinstance(self.local.node, str):
            await self.local.request("anvil_rollback", 1)
        else:
            await self.local.request("evm_revert", hex(await self.local.chain.block_number() - 1))

    async def created(self, provider: Provider) -> tuple[Demand, Liability]:
        """A contract that the provider has created, and read."""
        demand = self.local.demand(cost=COST)
        self.local.publish(demand, self.local.offer(cost=COST))
        liability = await self.local.liability_of(demand)
        await until(lambda: provider.earnings().created == 1)
        await until_read(self.local, provider)
        return demand, liability

    async def is_finalized(self, liability: Liability) -> bool:
        return (await self.local.chain.liabilities.get(liability.address)).is_finalized

    async def balance(self, role: str) -> int:
        return await self.local.chain.tokens.balance(self.local.address(role))


@pytest.fixture(params=["embedded", "anvil"])
async def forking(
    request: pytest.FixtureRequest, market_chain: MarketChain, router: EmbeddedRouter
) -> AsyncIterator[Forking]:
    if request.param == "anvil":
        anvil = request.getfixturevalue("anvil")
        market, node, keys = await deploy_market(anvil.url, anvil.private_keys), anvil.url, anvil.private_keys
    else:
        market, node, keys = market_chain.market, market_chain.node.provider, market_chain.node.funded_keys
    async with LocalMarket(market, router.endpoint, node=node, keys=keys) as local:
        async with local.chain_of("person") as chain:
            await chain.tokens.approve(market.deployment.factory, 100 * COST)
        async with HeldNode(node) as held:
            yield Forking(local, held)


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("reorganise", [Forking.replace_last, Forking.drop_last], ids=["replaced", "shorter"])
async def test_a_contract_that_vanishes_before_it_is_confirmed_is_created_again(
    forking: Forking, moment: str, reorganise: Reorganise
) -> None:
    local, before = forking.local, await forking.balance("person")
    async with local.provider(endpoint=forking.node, timing=QUICK) as provider:
        demand, offer = local.demand(cost=COST), local.offer(cost=COST)
        with forking.node.back(MOMENTS[moment]):
            local.publish(demand, offer)
            await local.liability_of(demand)
            if MOMENTS[moment] is BEFORE_THE_EVENT:
                await until(lambda: provider.earnings().created == 1)
            with forking.node.back(REPAIR):
                await reorganise(forking)
                assert await local.liabilities_of(demand) == []

        await local.liability_of(demand)
        await until_read(local, provider)
        assert len(await local.liabilities_of(demand)) == 1
        await until(lambda: provider.earnings().created == 1)
        assert len(provider.book) == 0
        assert await forking.balance("person") == before - COST
    assert local.rejections == []


async def test_a_contract_that_vanishes_after_its_event_was_read_is_created_again(forking: Forking) -> None:
    local, before = forking.local, await forking.balance("person")
    async with local.provider(endpoint=forking.node, timing=QUICK) as provider:
        demand, _ = await forking.created(provider)
        await forking.replace_last()

        await local.liability_of(demand)
        await until_read(local, provider)
        assert len(await local.liabilities_of(demand)) == 1
        await until(lambda: provider.earnings().created == 1)
        assert await forking.balance("person") == before - COST
    assert local.rejections == []


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("reorganise", [Forking.replace_last, Forking.drop_last], ids=["replaced", "shorter"])
async def test_a_finalization_that_vanishes_before_it_is_confirmed_is_made_again(
    forking: Forking, moment: str, reorganise: Reorganise
) -> None:
    local, before = forking.local, await forking.balance("robot")
    async with local.provider(endpoint=forking.node, timing=QUICK) as provider:
        _, liability = await forking.created(provider)
        with forking.node.back(MOMENTS[moment]):
            local.publish(local.result(liability.address))
            await until_found(lambda: forking.is_finalized(liability))
            if MOMENTS[moment] is BEFORE_THE_EVENT:
                await until(lambda: provider.earnings().finalized == 1)
            with forking.node.back(REPAIR):
                await reorganise(forking)
                assert not await forking.is_finalized(liability)

        await until_found(lambda: forking.is_finalized(liability))
        await until_read(local, provider)
        await until(lambda: provider.earnings().finalized == 1)
        assert await forking.balance("robot") == before + COST
    assert local.rejections == []


async def test_a_finalization_that_vanishes_after_its_event_was_read_is_made_again(forking: Forking) -> None:
    local, before = forking.local, await forking.balance("robot")
    async with local.provider(endpoint=forking.node, timing=QUICK) as provider:
        _, liability = await forking.created(provider)
        local.publish(local.result(liability.address))
        await until_found(lambda: forking.is_finalized(liability))
        await until_read(local, provider)
        await forking.replace_last()

        await until_found(lambda: forking.is_finalized(liability))
        await until_read(local, provider)
        await until(lambda: provider.earnings().finalized == 1)
        assert await forking.balance("robot") == before + COST
    assert local.rejections == []


async def test_what_another_provider_settled_and_lost_passes_when_it_is_sent_again(forking: Forking) -> None:
    """The other one is gone. This one never read its transactions: it learned of them by refusals only."""
    local = forking.local
    async with local.provider(endpoint=forking.node, timing=QUICK) as provider, local.chain_of("provider") as other:
        await until_read(local, provider)
        demand, offer = local.demand(cost=COST), local.offer(cost=COST)
        with forking.node.back(BEFORE_THE_EVENT):
            await other.liabilities.create(local.lighthouse, demand, offer)
            local.publish(demand, offer)
            await until(lambda: provider.earnings().rejected == {"OrderUsed": 1})
            await forking.replace_last()
        local.publish(demand, offer)
        liability = await local.liability_of(demand)
        await until_read(local, provider)

        result = local.result(liability.address)
        with forking.node.back(BEFORE_THE_EVENT):
            await other.liabilities.finalize(local.lighthouse, result)
            received = provider.results.statistics().received
            local.publish(result)
            await until(lambda: provider.results.statistics().received > received)
            await asyncio.sleep(0.2)
            await forking.replace_last()
        local.publish(result)
        await until_found(lambda: forking.is_finalized(liability))
        await until(lambda: (provider.earnings().created, provider.earnings().finalized) == (1, 1))
    assert local.rejections == []


async def test_a_reorganisation_of_the_block_before_the_start_does_not_stop_the_provider(forking: Forking) -> None:
    local = forking.local
    async with local.chain_of("provider") as other:
        demand, offer = local.demand(cost=COST), local.offer(cost=COST)
        await other.liabilities.create(local.lighthouse, demand, offer)
    async with local.provider(endpoint=forking.node, timing=QUICK) as provider:
        await until_read(local, provider)
        local.publish(demand, offer)
        await forking.replace_last()
        local.publish(demand, offer)

        await local.liability_of(demand)
        await until(lambda: provider.earnings().created == 1)
    assert local.rejections == []


async def test_a_result_for_a_contract_that_a_reorganisation_took_does_not_stop_the_provider(forking: Forking) -> None:
    local = forking.local
    async with local.provider(endpoint=forking.node, timing=QUICK) as provider:
        demand, liability = await forking.created(provider)
        with forking.node.back("eth_estimateGas"):
            await forking.replace_last()
            await until(lambda: provider.earnings().created == 0)
            received = provider.results.statistics().received
            local.publish(local.result(liability.address))
            await until(lambda: provider.results.statistics().received > received)
            await asyncio.sleep(0.2)
            assert await local.liabilities_of(demand) == []

        again = await local.liability_of(demand)
        local.publish(local.result(again.address))
        await until_found(lambda: forking.is_finalized(again))
    assert local.rejections == []
