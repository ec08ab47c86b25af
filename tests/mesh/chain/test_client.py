"""`Chain` on the embedded chain and on anvil."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import (
    XRT,
    Account,
    InsufficientFunds,
    NotALiability,
    Reverted,
    UnknownName,
    new_private_key,
)
from mesh.errors import ClosedError, ConfigurationError, InputError, InvalidAddress
from schemas.address import ZERO_ADDRESS
from schemas.messages import message_hash
from tests.mesh.chain.conftest import no_contracts, reverted
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")


async def test_names_of_both_generations_lead_to_the_same_contracts(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        assert chain.factory == market.deployment.factory
        assert chain.xrt == market.deployment.xrt
        for generation in (3, 5):
            assert await chain.names.address(f"factory.{generation}.robonomics.eth") == chain.factory
            assert await chain.names.address(f"XRT.{generation}.Robonomics.eth") == chain.xrt
            name = f"airalab.lighthouse.{generation}.robonomics.eth"
            assert await chain.names.address(name) == market.deployment.lighthouse
        assert await chain.names.lighthouse("airalab") == market.deployment.lighthouse
        assert await chain.names.address(chain.xrt.lower()) == chain.xrt


async def test_invalid_and_unknown_names_raise_different_errors(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        with raises_with(UnknownName, name="none.lighthouse.3.robonomics.eth"):
            await chain.names.address("none.lighthouse.3.robonomics.eth")
        with pytest.raises(UnknownName):
            await chain.names.address("somebody.eth")
        for text in ("a..eth", "café.eth", "a b.eth", "x.com", "a" * 300 + ".eth"):
            with raises_with(InputError, code="invalid-name"):
                await chain.names.address(text)
        for text in ("", "eth", "0x12"):
            with pytest.raises(InvalidAddress):
                await chain.names.address(text)


async def test_a_chain_without_the_contracts_is_an_error(market: DeployedMarket) -> None:
    with no_contracts("ENS registry at") as caught:
        async with market.chain(ens="0x" + "12" * 20):
            pass
    assert caught.value.hint
    with no_contracts("none"):
        async with market.chain(factory="none.3.robonomics.eth"):
            pass
    with no_contracts("factory at"):
        async with market.chain(factory=market.stranger.address):
            pass


async def test_tokens_are_transferred_and_approved(market: DeployedMarket) -> None:
    owner, friend = market.promisee.address, Account(new_private_key()).address
    async with market.chain(market.promisee) as chain:
        before = await chain.tokens.balance()
        tx = await chain.tokens.transfer(friend, 5)
        assert len(tx) == 66
        assert (await chain.tokens.balance(friend), await chain.tokens.balance(owner)) == (5, before - 5)
        await chain.tokens.approve(market.stranger.address, 7)
        assert await chain.tokens.allowance(owner, market.stranger.address) == 7
    async with market.chain(market.stranger) as chain:
        await chain.tokens.transfer_from(owner, friend, 7)
        assert await chain.tokens.balance(friend, token=market.deployment.xrt) == 12
        assert await chain.tokens.balance(friend, token="xrt.5.robonomics.eth") == 12


async def test_ether_balances_and_transfers(market: DeployedMarket) -> None:
    friend = Account(new_private_key()).address
    async with market.chain(market.promisee) as chain:
        await chain.tokens.send_eth(friend, 10**15)
        assert await chain.tokens.eth_balance(friend) == 10**15
        assert await chain.tokens.eth_balance() > 10**15


async def test_a_transaction_without_funds_raises(market: DeployedMarket) -> None:
    poor = Account(new_private_key())
    async with market.chain(poor) as chain:
        with pytest.raises(InsufficientFunds) as caught:
            await chain.tokens.approve(market.stranger.address, 1)
        assert caught.value.balance == 0
        assert caught.value.needed > 21_000
        assert caught.value.hint
        with pytest.raises(InsufficientFunds) as caught:
            await chain.tokens.send_eth(market.stranger.address, 10**18)
        assert caught.value.needed >= 10**18


async def test_only_transactions_need_an_account(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        assert await chain.tokens.balance(market.promisee.address) > 0
        with raises_with(ConfigurationError, code="no-account"):
            await chain.tokens.transfer(market.promisee.address, 1)
        with raises_with(ConfigurationError, code="no-account"):
            await chain.tokens.balance()


async def test_a_revert_of_the_token_is_decoded(market: DeployedMarket) -> None:
    async with market.chain(market.stranger) as chain:
        before = await chain.tokens.eth_balance()
        with reverted("ERC20InsufficientBalance") as caught:
            await chain.tokens.transfer(market.promisee.address, 1)
        assert caught.value.reason == "ERC20InsufficientBalance"
        assert caught.value.arguments == (market.stranger.address, 0, 1)
        assert await chain.tokens.eth_balance() == before, "what the simulation refuses is not sent"


@pytest.mark.parametrize("generation", [3, 5])
async def test_a_job_goes_from_orders_to_payment(market: DeployedMarket, generation: int) -> None:
    cost, fee = 50 * XRT, 2 * XRT
    demand_fields: dict[str, Any] = {"cost": cost}
    offer_fields: dict[str, Any] = {"cost": cost, "lighthouse_fee": fee}
    async with market.chain(market.provider) as chain:
        if generation == 5:
            for fields, who in ((demand_fields, market.promisee), (offer_fields, market.promisor)):
                fields |= {"sender": who.address, "nonce": await chain.liabilities.next_nonce(who.address)}
        people = (market.promisee.address, market.promisor.address)
        before = [await chain.tokens.balance(address) for address in people]
        demand, offer = market.demand(**demand_fields), market.offer(**offer_fields)
        created = await chain.liabilities.create(market.deployment.lighthouse, demand, offer)
        assert await chain.liabilities.exists(created.liability)
        assert created.gas_used < 260_000

        hashes = message_hash(demand), message_hash(offer)
        assert (await chain.liabilities.get_with_orders(created.liability))[1] == hashes
        used = [
            await chain.liabilities.is_order_used(order_hash, who)
            for order_hash, who in zip(hashes, people, strict=True)
        ]
        assert used == [generation == 3] * 2
        assert not await chain.liabilities.is_order_used(hashes[0], market.stranger.address), (
            "who has signed no such order"
        )

        made = await chain.liabilities.get(created.liability)
        strange = [market.promisee.address, market.stranger.address]
        assert await chain.liabilities.find_all([*strange, created.liability]) == {created.liability: made}
        assert await chain.liabilities.find_open([*strange, created.liability]) == {created.liability: made}
        assert await chain.liabilities.read_existing([*strange, created.liability]) == [(made, hashes)]
        assert (made.model, made.objective, made.result) == (demand.model, demand.objective, "")
        assert (made.promisee, made.promisor, made.lighthouse) == (*people, market.deployment.lighthouse)
        assert (made.token, made.cost, made.lighthouse_fee) == (market.deployment.xrt, cost, fee)
        assert (made.validator, made.validator_fee) == (ZERO_ADDRESS, 0)
        assert (made.is_success, made.is_finalized) == (False, False)

        result = market.result(created.liability)
        settled = await chain.liabilities.finalize("airalab", result)
        assert settled.gas_used < 150_000
        done = await chain.liabilities.get(created.liability)
        assert (done.result, done.is_success, done.is_finalized) == (result.result, True, True)
        assert await chain.liabilities.find_open([*strange, created.liability]) == {}
        assert await chain.liabilities.find_open([]) == {}
        after = [await chain.tokens.balance(address) for address in people]
        assert [now - then for now, then in zip(after, before, strict=True)] == [-cost, cost - fee]


async def test_a_failed_job_pays_the_promisee_back(market: DeployedMarket) -> None:
    async with market.chain(market.provider) as chain:
        before = await chain.tokens.balance(market.promisee.address)
        orders = market.demand(cost=XRT), market.offer(cost=XRT)
        created = await chain.liabilities.create("airalab", *orders)
        assert await chain.tokens.balance(market.promisee.address) == before - XRT
        await chain.liabilities.finalize("airalab", market.result(created.liability, success=False))
        assert await chain.tokens.balance(market.promisee.address) == before
        assert not (await chain.liabilities.get(created.liability)).is_success


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [("cost", 1, "CostMismatch"), ("deadline", 1, "DeadlineReached"), ("token", ZERO_ADDRESS, "TokenMismatch")],
)
async def test_orders_that_do_not_match_are_refused_with_a_reason(
    market: DeployedMarket, field: str, value: Any, reason: str
) -> None:
    async with market.chain(market.provider) as chain:
        with pytest.raises(Reverted) as caught:
            await chain.liabilities.create("airalab", market.demand(), market.offer(**{field: value}))
    assert caught.value.reason == reason


async def test_an_order_creates_only_one_liability(market: DeployedMarket) -> None:
    demand, offer = market.demand(), market.offer()
    async with market.chain(market.provider) as chain:
        await chain.liabilities.create("airalab", demand, offer)
        with reverted("OrderUsed"):
            await chain.liabilities.create("airalab", demand, market.offer())


async def test_only_a_provider_sends_to_the_lighthouse(market: DeployedMarket) -> None:
    async with market.chain(market.stranger) as chain:
        assert not await chain.lighthouses.is_turn("airalab")
        with pytest.raises(Reverted) as caught:
            await chain.liabilities.create("airalab", market.demand(), market.offer())
    assert (caught.value.reason, caught.value.arguments) == ("NotAProvider", (market.stranger.address,))


async def test_a_result_signed_by_another_account_is_refused(market: DeployedMarket) -> None:
    async with market.chain(market.provider) as chain:
        created = await chain.liabilities.create("airalab", market.demand(), market.offer())
        forged = market.result(created.liability, account=market.stranger)
        with reverted("WrongSigner") as caught:
            await chain.liabilities.finalize("airalab", forged)
        assert caught.value.arguments == (market.promisor.address, market.stranger.address)


async def test_only_contracts_of_the_factory_are_liabilities(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        for address in (market.stranger.address, market.deployment.xrt):
            assert not await chain.liabilities.exists(address)
            with raises_with(NotALiability, address=address):
                await chain.liabilities.get(address)


async def test_the_named_validator_finalizes_a_generation_3_liability(market: DeployedMarket) -> None:
    validator = market.stranger.address
    async with market.chain(market.provider) as chain:
        orders = market.demand(validator=validator), market.offer(validator=validator)
        created = await chain.liabilities.create("airalab", *orders)
    result = market.result(created.liability)
    async with market.chain(market.stranger) as chain:
        await chain.liabilities.validate(result, agree=False)
        record = await chain.liabilities.get(created.liability)
    assert (record.is_finalized, record.is_success, record.validator) == (True, False, validator)


async def test_a_promisee_is_refunded_without_a_result(market: DeployedMarket) -> None:
    async with market.chain(market.provider) as chain:
        before = await chain.tokens.balance(market.promisee.address)
        created = await chain.liabilities.create("airalab", market.demand(cost=9), market.offer(cost=9))
        with reverted("RefundTooEarly"):
            await chain.liabilities.refund(created.liability)
        while await chain.block_number() + 1 < await chain.liabilities.refundable_from(created.liability):
            await chain.tokens.approve(market.stranger.address, 0)
        await chain.liabilities.refund(created.liability)
        assert await chain.tokens.balance(market.promisee.address) == before
        record = await chain.liabilities.get(created.liability)
    assert (record.is_finalized, record.is_success, record.result) == (True, False, "")


async def test_a_lighthouse_is_created_staked_on_and_left(market: DeployedMarket) -> None:
    owner = market.promisor
    async with market.chain(owner) as chain:
        made = await chain.lighthouses.create(minimal_stake=10, timeout_blocks=3, name="beacon")
        assert await chain.names.lighthouse("beacon") == made.lighthouse
        assert await chain.names.address("beacon.lighthouse.5.robonomics.eth") == made.lighthouse
        assert [(one.lighthouse, one.name) for one in await chain.lighthouses.list()] == [
            (market.deployment.lighthouse, "airalab"),
            (made.lighthouse, "beacon"),
        ]
        await chain.tokens.approve(made.lighthouse, 25)
        await chain.lighthouses.refill("beacon", 25)
        state = await chain.lighthouses.get("beacon")
        assert (state.minimal_stake, state.timeout_blocks, state.quota) == (10, 3, 2)
        assert (state.current, state.stakes) == (owner.address, {owner.address: 25})
        assert await chain.lighthouses.is_turn("beacon")
        await chain.lighthouses.withdraw("beacon", 20)
        assert (await chain.lighthouses.get("beacon")).stakes == {}
        with reverted("NameTaken"):
            await chain.lighthouses.create(minimal_stake=10, timeout_blocks=3, name="beacon")


async def test_concurrent_transactions_of_one_account_all_succeed(market: DeployedMarket) -> None:
    friend = Account(new_private_key()).address
    async with market.chain(market.promisee) as chain:
        txs = await asyncio.gather(*(chain.tokens.transfer(friend, 1) for _ in range(20)))
        assert len(set(txs)) == 20
        assert await chain.tokens.balance(friend) == 20


async def test_two_clients_of_one_account_do_not_lose_a_transaction(market: DeployedMarket) -> None:
    friend = Account(new_private_key()).address
    async with market.chain(market.promisee) as one, market.chain(market.promisee) as other:
        await asyncio.gather(*(chain.tokens.transfer(friend, 1) for chain in (one, other) * 5))
        assert await one.tokens.balance(friend) == 10


async def test_a_closed_chain_raises(market: DeployedMarket) -> None:
    chain = market.chain(market.promisee)
    with pytest.raises(ClosedError):
        await chain.names.address("xrt.3.robonomics.eth")
    async with chain:
        await chain.tokens.balance()
    with pytest.raises(ClosedError):
        _ = chain.factory
