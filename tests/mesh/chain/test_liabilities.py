"""Listing, watching, cancelling and refunding liabilities."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import (
    XRT,
    Account,
    Chain,
    NotALiability,
    NotOffered,
    OrderAlreadyUsed,
    Reverted,
    new_private_key,
)
from mesh.dev import EmbeddedChain
from mesh.errors import InvalidMessage
from schemas import cancellation_hash, message_hash
from tests.mesh.chain.conftest import QUICK, Flaky, cid, prepare, reverted
from tests.support.raising import raises_with
from tests.support.tokens import block, deploy_blocking_token
from tests.support.waiting import until

if TYPE_CHECKING:
    from schemas import Demand, Offer
    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")


async def _made(market: DeployedMarket, **fields: Any) -> str:
    async with market.chain(market.provider) as chain:
        return (await chain.liabilities.create("airalab", market.demand(**fields), market.offer(**fields))).liability


def _signed(account: Account, liability: str) -> bytes:
    return account.signer.sign_hash(cancellation_hash(liability))


async def test_a_liability_cancelled_by_both_parties_is_refunded(market: DeployedMarket) -> None:
    async with market.chain(market.stranger) as chain:
        before = await chain.tokens.balance(market.promisee.address)
        liability = await _made(market, cost=XRT)
        promisee, promisor = (_signed(account, liability) for account in (market.promisee, market.promisor))
        await chain.liabilities.cancel(liability, promisee_signature=promisee, promisor_signature="0x" + promisor.hex())
        assert await chain.tokens.balance(market.promisee.address) == before
        record = await chain.liabilities.get(liability)
        assert (record.is_finalized, record.is_success, record.result) == (True, False, "")
        with reverted("AlreadyFinalized"):
            await chain.liabilities.cancel(liability, promisee_signature=promisee, promisor_signature=promisor)


async def test_one_party_alone_can_not_cancel(market: DeployedMarket) -> None:
    liability = await _made(market)
    promisee, stranger = (_signed(account, liability) for account in (market.promisee, market.stranger))
    async with market.chain(market.stranger) as chain:
        with reverted("WrongSigner") as caught:
            await chain.liabilities.cancel(liability, promisee_signature=promisee, promisor_signature=stranger)
        assert caught.value.arguments == (market.promisor.address, market.stranger.address)
        assert not (await chain.liabilities.get(liability)).is_finalized


async def test_an_invalid_signature_is_refused_before_the_contract_is_asked(market: DeployedMarket) -> None:
    liability = await _made(market)
    async with market.chain() as chain:
        for nonsense in ("", "0x12", "nonsense", bytes(65)):
            with raises_with(InvalidMessage, reason="signature"):
                await chain.liabilities.cancel(liability, promisee_signature=nonsense, promisor_signature=bytes(65))


async def test_a_signature_for_another_liability_is_refused(market: DeployedMarket) -> None:
    one, other = await _made(market), await _made(market)
    signatures = [_signed(account, other) for account in (market.promisee, market.promisor)]
    async with market.chain(market.stranger) as chain:
        with reverted("WrongSigner"):
            await chain.liabilities.cancel(one, promisee_signature=signatures[0], promisor_signature=signatures[1])


@pytest.mark.parametrize("success", [True, False])
async def test_anybody_finalizes_without_a_turn(market: DeployedMarket, success: bool) -> None:
    liability = await _made(market, cost=XRT)
    async with market.chain(market.stranger) as chain:
        before = await chain.tokens.balance(market.promisor.address)
        settled = await chain.liabilities.finalize_without_turn(market.result(liability, success=success))
        assert settled.minted == 0
        record = await chain.liabilities.get(liability)
        assert (record.is_finalized, record.is_success, record.result) == (True, success, cid(3))
        assert await chain.tokens.balance(market.promisor.address) == before + XRT * success


async def test_the_originals_need_a_turn_to_finalize(market: DeployedMarket) -> None:
    liability = await _made(market)
    async with market.chain(market.stranger, kind="original", generation=5) as chain:
        with raises_with(NotOffered, what="finalization without a turn", generation=5):
            await chain.liabilities.finalize_without_turn(market.result(liability))


async def test_only_liabilities_can_be_cancelled_and_watched(market: DeployedMarket) -> None:
    unused = Account(new_private_key()).address
    signature = _signed(market.promisee, unused)
    async with market.chain(market.stranger) as chain:
        with raises_with(NotALiability, address=unused):
            await chain.liabilities.cancel(unused, promisee_signature=signature, promisor_signature=signature)
        with raises_with(NotALiability, address=unused):
            await chain.liabilities.watch(unused)
        with raises_with(NotALiability, address=unused):
            await chain.liabilities.refund_state(unused)


@pytest.mark.sample("generation")
@pytest.mark.parametrize("generation", [3, 5])
async def test_liabilities_of_the_originals_can_not_be_cancelled(market: DeployedMarket, generation: int) -> None:
    liability = await _made(market)
    signature = _signed(market.promisee, liability)
    options: dict[str, Any] = {"kind": "original", "generation": generation}
    async with market.chain(market.provider, **options) as chain:
        assert liability in [found.address for found in await chain.liabilities.list()]  # recognised from now on
        with raises_with(NotOffered, what="cancellation", generation=generation) as caught:
            await chain.liabilities.cancel(liability, promisee_signature=signature, promisor_signature=signature)
        assert caught.value.hint
        with raises_with(NotOffered, what="refund", generation=generation):
            await chain.liabilities.refund_state(liability)


async def test_a_refund_is_possible_after_the_delay_and_before_the_end(market: DeployedMarket) -> None:
    liability = await _made(market, cost=1)
    async with market.chain(market.provider) as chain:
        state = await chain.liabilities.refund_state(liability)
        assert (state.liability, state.is_finalized, state.is_refundable) == (liability, False, False)
        assert state.refundable_from == await chain.liabilities.refundable_from(liability)
        while not (await chain.liabilities.refund_state(liability)).is_refundable:
            with reverted("RefundTooEarly"):
                await chain.liabilities.refund(liability)
            await chain.tokens.approve(market.stranger.address, 0)
        await chain.liabilities.refund(liability)
        state = await chain.liabilities.refund_state(liability)
    assert (state.is_finalized, state.is_refundable) == (True, False)


async def test_liabilities_are_listed_in_order_and_filtered_by_party(market: DeployedMarket) -> None:
    async with market.chain(market.provider) as chain:
        start = await chain.block_number() + 1
        # Each is the other's promisee: the accounts of the market change places.
        swapped = market.demand(market.promisor), market.offer(market.promisee)
        made = [
            await _made(market),
            (await chain.liabilities.create("airalab", *swapped)).liability,
            await _made(market),
        ]
        every = await chain.liabilities.list(from_block=start)
        assert [record.address for record in every] == made
        assert every[0] == await chain.liabilities.get(made[0])

        async def listed(**filters: Any) -> list[str]:
            return [record.address for record in await chain.liabilities.list(from_block=start, **filters)]

        assert await listed(promisee=market.promisee.address.lower()) == [made[0], made[2]]
        assert await listed(promisor=market.promisee.address) == [made[1]]
        assert await listed(promisee=market.promisee.address, promisor=market.promisee.address) == []
        assert await listed(lighthouse="airalab") == made
        assert await listed(lighthouse=market.stranger.address) == []
        assert len(await chain.liabilities.list()) >= len(made)


async def test_liabilities_of_the_originals_are_listed_from_the_factorys_events(market: DeployedMarket) -> None:
    liability = await _made(market)
    async with market.chain(kind="original", generation=3) as chain:
        assert liability in [record.address for record in await chain.liabilities.list()]


async def test_watching_waits_for_the_end_and_returns_the_record(market: DeployedMarket) -> None:
    liability = await _made(market, cost=1)
    async with market.chain() as reader, market.chain(market.provider) as chain, asyncio.timeout(30):
        watching = asyncio.create_task(reader.liabilities.watch(liability.lower()))
        await chain.tokens.approve(market.stranger.address, 0)
        assert not watching.done()
        await chain.liabilities.finalize("airalab", market.result(liability))
        ended = await watching
        assert (ended.address, ended.is_success, ended.result) == (liability, True, cid(3))
        assert ended == await chain.liabilities.get(liability)
        assert await reader.liabilities.watch(liability) == ended, "a liability that has ended is returned at once"


async def test_watching_waits_for_confirmations(market: DeployedMarket) -> None:
    liability = await _made(market)
    timing = replace(QUICK, confirmations=3)
    async with market.chain(timing=timing) as reader, market.chain(market.provider) as chain, asyncio.timeout(30):
        watching = asyncio.create_task(reader.liabilities.watch(liability))
        await chain.liabilities.finalize("airalab", market.result(liability))
        for _ in range(2):
            await asyncio.sleep(10 * QUICK.poll_interval)
            assert not watching.done()
            await chain.tokens.approve(market.stranger.address, 0)
        assert (await watching).is_finalized


async def test_watching_survives_an_outage() -> None:
    async with EmbeddedChain() as node, asyncio.timeout(60):
        market = await prepare(node.provider, node.funded_keys)
        liability = await _made(market)
        flaky = Flaky(node)
        async with market.chain(market.provider) as chain, Chain(flaky, timing=QUICK) as reader:
            asked = flaky.asked
            watching = asyncio.create_task(reader.liabilities.watch(liability))
            await until(lambda: flaky.asked > asked + 10, what="it looks again and again")
            flaky.is_lost = True
            await chain.liabilities.finalize("airalab", market.result(liability))
            await asyncio.sleep(5 * QUICK.poll_interval)
            assert not watching.done()
            flaky.is_lost = False
            assert (await watching).is_finalized


async def _counted(market: DeployedMarket, maker: Account, generation: int, ahead: int) -> dict[str, Any]:
    """What a generation-5 order has in place of a random nonce."""
    if generation == 3:
        return {}
    async with market.chain() as chain:
        return {"sender": maker.address, "nonce": await chain.liabilities.next_nonce(maker.address) + ahead}


async def _order(market: DeployedMarket, generation: int, *, ahead: int = 0, **fields: Any) -> Demand:
    return market.demand(**await _counted(market, market.promisee, generation, ahead), **fields)


async def _matching_offer(market: DeployedMarket, generation: int, **fields: Any) -> Offer:
    return market.offer(**await _counted(market, market.promisor, generation, 0), **fields)


@pytest.mark.sample("generation")
@pytest.mark.parametrize("generation", [3, 5])
async def test_a_withdrawn_order_makes_no_contract(market: DeployedMarket, generation: int) -> None:
    demand = await _order(market, generation, cost=XRT)
    offer = await _matching_offer(market, generation, cost=XRT)
    async with market.chain(market.promisee) as chain:
        withdrawn = await chain.liabilities.withdraw(demand)
        assert 0 < withdrawn.gas_used < 50_000
        assert withdrawn.wei > 0
        with raises_with(OrderAlreadyUsed, code="order-used", order=message_hash(demand).hex()):
            await chain.liabilities.withdraw(demand)
    async with market.chain(market.provider) as chain:
        with reverted({3: "OrderUsed", 5: "WrongSigner"}[generation]):
            await chain.liabilities.create("airalab", demand, offer)


@pytest.mark.sample("generation")
@pytest.mark.parametrize("generation", [3, 5])
async def test_an_order_that_is_a_contract_is_not_withdrawn(market: DeployedMarket, generation: int) -> None:
    demand = await _order(market, generation)
    offer = await _matching_offer(market, generation)
    async with market.chain(market.provider) as chain:
        await chain.liabilities.create("airalab", demand, offer)
    async with market.chain(market.promisee) as chain:
        with raises_with(OrderAlreadyUsed, order=message_hash(demand).hex()):
            await chain.liabilities.withdraw(demand)


async def test_only_the_next_order_of_the_own_account_is_withdrawn(market: DeployedMarket) -> None:
    demand = await _order(market, 5, ahead=1)
    async with market.chain(market.promisee) as chain:
        with reverted("WrongNonce"):
            await chain.liabilities.withdraw(demand)
    async with market.chain(market.stranger) as chain:
        with raises_with(InvalidMessage, reason="sender"):
            await chain.liabilities.withdraw(demand)


@pytest.mark.sample("generation")
@pytest.mark.parametrize("generation", [3, 5])
async def test_the_originals_withdraw_no_order(market: DeployedMarket, generation: int) -> None:
    demand = await _order(market, generation)
    async with market.chain(market.promisee, kind="original", generation=generation) as chain:
        with raises_with(NotOffered, what="withdrawal of orders", generation=generation):
            await chain.liabilities.withdraw(demand)


async def test_a_payment_that_the_token_refuses_is_claimed_later(market: DeployedMarket) -> None:
    promisee, stranger = market.promisee.address, market.stranger.address
    async with market.chain(market.promisee) as chain:
        token = await deploy_blocking_token(chain, 100)
        await block(chain, token, promisee)
    first, second = [await _made(market, token=token, cost=30) for _ in range(2)]
    async with market.chain(market.provider) as chain:
        await chain.liabilities.finalize("airalab", market.result(first, success=False))
        record = await chain.liabilities.get(first)
        assert (record.is_finalized, record.is_success) == (True, False)
        assert (await chain.liabilities.owed(token, promisee), await chain.liabilities.owed(token)) == (30, 0)
        assert await chain.liabilities.owed_after(record) == 30
        assert await chain.liabilities.owed_after(await chain.liabilities.get(second)) == 0
        with raises_with(Reverted, reason="NothingOwed"):
            await chain.liabilities.claim(token)
        with raises_with(Reverted, reason=""):
            await chain.liabilities.claim(token, promisee)
        with pytest.raises(ValueError, match="only an account itself"):
            await chain.liabilities.claim(token, promisee, to=stranger)
    async with market.chain(market.promisee) as chain:
        await chain.liabilities.claim(token, to=stranger)
        assert await chain.tokens.balance(stranger, token=token) == 30
        assert await chain.liabilities.owed(token) == 0
        await chain.liabilities.finalize_without_turn(market.result(second, success=False))
        await block(chain, token, promisee, is_blocked=False)
    async with market.chain(market.stranger) as chain:
        await chain.liabilities.claim(token, promisee)
        assert await chain.tokens.balance(promisee, token=token) == 70


async def test_xrt_is_never_owed_and_the_originals_owe_nothing(market: DeployedMarket) -> None:
    async with market.chain(market.promisee) as chain:
        assert await chain.liabilities.owed(chain.xrt) == await chain.liabilities.owed("xrt.3.robonomics.eth") == 0
    async with market.chain(market.promisee, kind="original", generation=5) as chain:
        assert await chain.liabilities.owed(market.stranger.address) == 0
        for to in (None, market.stranger.address):
            with raises_with(NotOffered, what="claims", generation=5):
                await chain.liabilities.claim(market.stranger.address, to=to)
