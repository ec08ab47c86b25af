"""The calls that the original contracts want, made to ours, which have the functions of both generations.

What only the originals do (their markers, their gas counts at creation, their silence about reasons) is not tested:
their code was not at hand.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import XRT, Finalized, NotALiability, NotOffered
from mesh.errors import ConfigurationError, InvalidMessage
from tests.mesh.chain.conftest import cid, events_of, read_to
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")

FINALIZE_BY = {3: "af0bdb38", 5: "563e52d5"}
"""Selectors of to(address,bytes) and finalizeLiability(address,bytes,bool,bytes)."""


async def _orders(market: DeployedMarket, generation: int, **fields: Any) -> tuple[Any, Any]:
    if generation == 3:
        return market.demand(**fields), market.offer(**fields)
    async with market.chain() as chain:
        nonces = [await chain.liabilities.next_nonce(who.address) for who in (market.promisee, market.promisor)]
    demand = market.demand(**fields, sender=market.promisee.address, nonce=nonces[0])
    return demand, market.offer(**fields, sender=market.promisor.address, nonce=nonces[1])


@pytest.mark.parametrize("generation", [3, 5])
async def test_a_job_uses_the_calls_of_the_generation(market: DeployedMarket, generation: int) -> None:
    options: dict[str, Any] = {"kind": "original", "generation": generation}
    async with market.chain(market.provider, **options) as chain:
        start = await chain.block_number()
        created = await chain.liabilities.create("airalab", *await _orders(market, generation, cost=XRT))
        settled = await chain.liabilities.finalize("airalab", market.result(created.liability))
        sent = await chain.node.request("eth_getTransactionByHash", settled.tx)
        record = await chain.liabilities.get(created.liability)
        events = events_of(await read_to(chain, start + 1, await chain.block_number()))
    assert sent["input"][2:10] == FINALIZE_BY[generation]
    assert (record.is_finalized, record.is_success, record.result) == (True, True, cid(3))
    assert Finalized(created.liability, True, cid(3), settled.tx) in events


async def test_generation_3s_result_of_a_failed_job_pays_the_promisee_back(market: DeployedMarket) -> None:
    async with market.chain(market.provider, kind="original", generation=3) as chain:
        before = await chain.tokens.balance(market.promisee.address)
        created = await chain.liabilities.create("airalab", *await _orders(market, 3, cost=XRT))
        await chain.liabilities.finalize("airalab", market.result(created.liability, success=False))
        assert await chain.tokens.balance(market.promisee.address) == before


@pytest.mark.parametrize("generation", [3, 5])
async def test_liabilities_are_recognised_by_event_or_by_gas(market: DeployedMarket, generation: int) -> None:
    options: dict[str, Any] = {"kind": "original", "generation": generation}
    async with market.chain(market.provider) as chain:
        start = await chain.block_number()
        created = await chain.liabilities.create("airalab", market.demand(cost=1), market.offer(cost=1))
        head = await chain.block_number()
        async with market.chain(**options) as reader:
            with pytest.raises(NotALiability):
                await reader.liabilities.get(created.liability)
            await read_to(reader, start + 1, head)
            assert (await reader.liabilities.get(created.liability)).cost == 1
        await chain.liabilities.finalize("airalab", market.result(created.liability))
        async with market.chain(**options) as reader:
            assert await reader.liabilities.exists(created.liability)
            assert not await reader.liabilities.exists(market.deployment.xrt)


@pytest.mark.parametrize("generation", [3, 5])
async def test_a_lighthouse_is_read_with_the_getters_of_the_generation(market: DeployedMarket, generation: int) -> None:
    options: dict[str, Any] = {"kind": "original", "generation": generation}
    async with market.chain(market.provider) as ours, market.chain(market.provider, **options) as chain:
        assert await chain.lighthouses.get("airalab") == await ours.lighthouses.get("airalab")
        assert await chain.lighthouses.is_turn("airalab")
        assert not await chain.lighthouses.is_turn("airalab", market.stranger.address)


async def test_names_are_those_of_the_generations_root(market: DeployedMarket) -> None:
    async with market.chain(generation=5) as chain:
        assert (chain.factory, chain.xrt) == (market.deployment.factory, market.deployment.xrt)
        assert await chain.names.lighthouse("airalab") == await chain.names.address(
            "airalab.lighthouse.5.robonomics.eth"
        )


async def test_functions_that_the_originals_lack_raise_not_offered(market: DeployedMarket) -> None:
    result = market.result(market.stranger.address)
    async with market.chain(market.provider, kind="original", generation=3) as chain:
        with raises_with(NotOffered, what="nonceOf", generation=3) as caught:
            await chain.liabilities.next_nonce()
        assert caught.value.hint
        with raises_with(NotOffered, what="refund"):
            await chain.liabilities.refund(market.stranger.address)
        with raises_with(InvalidMessage, reason="generation"):
            await chain.liabilities.create("airalab", *await _orders(market, 5))
    async with market.chain(market.provider, kind="original", generation=5) as chain:
        with raises_with(NotOffered, what="finalization by a validator's own account", generation=5):
            await chain.liabilities.validate(result, agree=True)
        with raises_with(NotOffered, what="refund"):
            await chain.liabilities.refundable_from(market.stranger.address)
        with raises_with(InvalidMessage, reason="generation"):
            await chain.liabilities.create("airalab", *await _orders(market, 3))


async def test_unknown_contract_versions_are_refused(market: DeployedMarket) -> None:
    for options in ({"kind": "original", "generation": 4}, {"kind": "other"}):
        with raises_with(ConfigurationError, code="unknown-contracts"):
            async with market.chain(factory=market.deployment.factory, xrt=market.deployment.xrt, **options):
                pass
