"""Juries through the client: deploying them, what is known of them, finalizing by their jurors, collecting fees."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any
from unittest.mock import AsyncMock

import pytest
from msgspec import structs

from mesh.chain import (
    XRT,
    Account,
    InsufficientTokens,
    NotOffered,
    Timing,
    TransactionSender,
    new_private_key,
)
from mesh.errors import ChainError, InputError, InvalidMessage
from schemas import ZERO_ADDRESS, address_bytes
from tests.mesh.chain.conftest import cid, reverted
from tests.support.contracts.suite import artifact
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from mesh.chain import Chain, DeployedJury
    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")


def accounts(count: int) -> list[Account]:
    """New accounts, in ascending order of their addresses."""
    found = [Account(new_private_key()) for _ in range(count)]
    return sorted(found, key=lambda account: address_bytes(account.address))


async def some_jury(market: DeployedMarket, *, quorum: int = 2, size: int = 3) -> tuple[DeployedJury, list[Account]]:
    """A jury of new accounts; the stranger is its keeper."""
    jurors = accounts(size)
    async with market.chain(market.stranger) as chain:
        deployed = await chain.validators.deploy([juror.address for juror in reversed(jurors)], quorum)
    return deployed, jurors


async def create(market: DeployedMarket, chain: Chain, validator: str, *, fee: int = 0) -> str:
    """A new liability of generation 5 that costs 5 wn, with this validator."""
    nonces = [await chain.liabilities.next_nonce(one.address) for one in (market.promisee, market.promisor)]
    terms: dict[str, Any] = {"cost": 5, "validator": validator}
    demand = market.demand(**terms, validator_fee=fee, nonce=nonces[0], sender=market.promisee.address)
    offer = market.offer(**terms, nonce=nonces[1], sender=market.promisor.address)
    return (await chain.liabilities.create(market.deployment.lighthouse, demand, offer)).liability


async def place(market: DeployedMarket, code: bytes) -> str:
    """A new contract with this code."""
    creation = bytes.fromhex("61") + len(code).to_bytes(2) + bytes.fromhex("80600a5f395ff3") + code
    async with market.chain(market.stranger) as chain:
        receipt = await TransactionSender(chain.node, market.stranger).send(to=None, data=creation)
    assert receipt.contract is not None
    return receipt.contract


async def test_a_jury_is_deployed_and_found(market: DeployedMarket) -> None:
    deployed, jurors = await some_jury(market)
    addresses = tuple(juror.address for juror in jurors)
    assert (deployed.jurors, deployed.quorum) == (addresses, 2)
    assert deployed.gas_used > 500_000
    assert deployed.wei > 0
    async with market.chain() as chain:
        jury = await chain.validators.jury(deployed.address)
        assert jury is not None
        assert (jury.address, jury.keeper) == (deployed.address, market.stranger.address)
        assert (jury.jurors, jury.quorum, jury.fees) == (addresses, 2, 0)
        assert await chain.validators.quorum(deployed.address) == 2
        assert [await chain.validators.accepts(deployed.address, one) for one in addresses] == [True] * 3
        assert not await chain.validators.accepts(deployed.address, market.stranger.address)


@pytest.mark.parametrize(
    ("jurors", "quorum"),
    [
        ([], 1),
        ([f"0x{number:040x}" for number in range(1, 9)], 1),
        ([f"0x{1:040x}", f"0x{2:040x}"], 0),
        ([f"0x{1:040x}", f"0x{2:040x}"], 3),
        ([f"0x{1:040x}", f"0x{1:040x}"], 1),
        ([ZERO_ADDRESS], 1),
    ],
)
async def test_what_is_no_jury_is_refused_before_anything_is_sent(
    market: DeployedMarket, jurors: list[str], quorum: int
) -> None:
    async with market.chain(market.stranger) as chain:
        before = await chain.node.transaction_count(market.stranger.address)
        with raises_with(InputError, code="invalid-jury"):
            await chain.validators.deploy(jurors, quorum)
        assert await chain.node.transaction_count(market.stranger.address) == before


async def test_other_contracts_are_no_juries(market: DeployedMarket) -> None:
    deployed, jurors = await some_jury(market)
    async with market.chain() as chain:
        code = await chain.node.code(deployed.address)
        first, second = (address_bytes(juror.address) for juror in jurors[:2])
        marker = b"\xee" * 20
        swapped = code.replace(first, marker).replace(second, first).replace(marker, second)
        assert swapped != code
        lookalike = code.replace(address_bytes(market.deployment.xrt), address_bytes(market.deployment.factory))
        quorum = (2).to_bytes(32, "big")
        assert code.count(quorum) > 1
        for address in [
            await place(market, swapped),
            await place(market, code.replace(quorum, (1).to_bytes(32, "big"), 1)),
            await place(market, lookalike),
            await place(market, code + b"\0"),
            market.deployment.factory,
            market.deployment.lighthouse,
            market.stranger.address,
            accounts(1)[0].address,
        ]:
            assert await chain.validators.jury(address) is None


async def test_a_jury_that_a_node_did_not_know_is_asked_again(
    market: DeployedMarket, monkeypatch: pytest.MonkeyPatch
) -> None:
    deployed, jurors = await some_jury(market)
    async with market.chain(timing=Timing(validator_recheck=0.0)) as chain:
        with monkeypatch.context() as behind:
            behind.setattr("mesh.chain._validators.is_code_of", lambda name, code: False)
            assert await chain.validators.jurors(deployed.address) is None
        assert await chain.validators.jurors(deployed.address) == tuple(juror.address for juror in jurors)


async def test_a_jury_whose_code_a_node_did_not_know_is_asked_again(
    market: DeployedMarket, monkeypatch: pytest.MonkeyPatch
) -> None:
    deployed, _ = await some_jury(market)
    async with market.chain(timing=Timing(validator_recheck=0.0)) as chain:
        with monkeypatch.context() as behind:
            behind.setattr(chain.node, "code", AsyncMock(return_value=b""))
            assert await chain.validators.quorum(deployed.address) == 0
        assert await chain.validators.quorum(deployed.address) == deployed.quorum


async def test_another_contract_is_asked_about_each_signer(market: DeployedMarket) -> None:
    signer, other = accounts(2)
    async with market.chain(market.stranger) as chain:
        creation = bytes.fromhex(artifact("OneSigner")["bytecode"][2:]) + bytes(12) + address_bytes(signer.address)
        receipt = await TransactionSender(chain.node, market.stranger).send(to=None, data=creation)
        assert receipt.contract is not None
        assert await chain.validators.accepts(receipt.contract, signer.address)
        assert not await chain.validators.accepts(receipt.contract, other.address)
        assert await chain.validators.quorum(receipt.contract) == 1
        # What can't be asked accepts nobody.
        assert not await chain.validators.accepts(market.deployment.factory, signer.address)


async def test_an_account_judges_for_itself(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        assert await chain.validators.accepts(market.stranger.address, market.stranger.address)
        assert not await chain.validators.accepts(market.stranger.address, market.promisee.address)
        assert await chain.validators.quorum(market.stranger.address) == 0
        assert not await chain.validators.accepts(ZERO_ADDRESS, market.stranger.address)


async def test_an_order_of_generation_5_with_an_account_as_validator_is_refused_before_it_is_signed(
    market: DeployedMarket,
) -> None:
    deployed, _ = await some_jury(market)
    async with market.chain() as chain:
        authors: dict[int, dict[str, Any]] = {3: {}, 5: {"nonce": 0, "sender": market.promisee.address}}
        for generation, author in authors.items():
            order = market.demand(cost=5, validator=market.stranger.address, **author)
            with_jury = market.demand(cost=5, validator=deployed.address, **author)
            if generation == 5:
                await chain.validators.is_safe(market.stranger.address)
                with raises_with(InputError, code="validator-without-code", match=order.validator):
                    await chain.validators.check(order)
                with raises_with(InputError, code="validator-without-code"):
                    chain.validators.check_known(order)
            else:
                await chain.validators.check(order)
                chain.validators.check_known(order)
            await chain.validators.check(with_jury)
            chain.validators.check_known(with_jury)


async def test_a_quorum_finalizes_in_any_order(market: DeployedMarket) -> None:
    deployed, jurors = await some_jury(market)
    async with market.chain(market.provider, generation=5) as chain:
        for chosen in (jurors[:2], jurors[1:][::-1]):
            liability = await create(market, chain, deployed.address)
            signed = [market.result(liability, account=juror) for juror in chosen]
            settled = await chain.liabilities.finalize(market.deployment.lighthouse, *signed)
            assert settled.gas_used < 145_000
            assert (await chain.liabilities.get(liability)).is_success


async def test_anybody_brings_the_results_of_a_quorum_without_a_turn(market: DeployedMarket) -> None:
    deployed, jurors = await some_jury(market)
    async with market.chain(market.provider, generation=5) as provider, market.chain(market.stranger) as stranger:
        liability = await create(market, provider, deployed.address)
        signed = [market.result(liability, account=juror, success=False) for juror in jurors[::2]]
        await stranger.liabilities.finalize_without_turn(*signed)
        ended = await provider.liabilities.get(liability)
        assert (ended.is_finalized, ended.is_success) == (True, False)


async def test_what_is_no_quorum_is_refused(market: DeployedMarket) -> None:
    deployed, jurors = await some_jury(market)
    async with market.chain(market.provider, generation=5) as chain:
        liability, lighthouse = await create(market, chain, deployed.address), market.deployment.lighthouse
        first, second, third = (market.result(liability, account=juror) for juror in jurors)
        with reverted("RefusedByValidator"):
            await chain.liabilities.finalize(lighthouse, first)
        with reverted("RefusedByValidator"):
            await chain.liabilities.finalize(lighthouse, first, second, third)
        with reverted("SignersOutOfOrder"):
            await chain.liabilities.finalize(lighthouse, first, first)
        for change in ({"success": False}, {"result": cid(7)}):
            with pytest.raises(InvalidMessage):
                await chain.liabilities.finalize(lighthouse, first, structs.replace(second, **change))
        assert not (await chain.liabilities.get(liability)).is_finalized


async def test_the_originals_take_one_signature(market: DeployedMarket) -> None:
    deployed, jurors = await some_jury(market, quorum=1, size=2)
    async with market.chain(market.provider, kind="original", generation=5) as chain:
        liability, lighthouse = await create(market, chain, deployed.address), market.deployment.lighthouse
        first, second = (market.result(liability, account=juror) for juror in jurors)
        with pytest.raises(NotOffered):
            await chain.liabilities.finalize(lighthouse, first, second)
        await chain.liabilities.finalize(lighthouse, first)
        assert (await chain.liabilities.get(liability)).is_success


async def test_an_order_on_the_originals_names_no_jury_that_needs_several(market: DeployedMarket) -> None:
    """They take one signature, and never give the cost back."""
    several, _ = await some_jury(market)
    one, _ = await some_jury(market, quorum=1)
    author: dict[str, Any] = {"nonce": 0, "sender": market.promisee.address}
    async with market.chain(kind="original", generation=5) as chain:
        with pytest.raises(NotOffered):
            await chain.validators.check(market.demand(cost=5, validator=several.address, **author))
        await chain.validators.check(market.demand(cost=5, validator=one.address, **author))


async def test_the_keeper_collects_the_fees(market: DeployedMarket) -> None:
    deployed, jurors = await some_jury(market, quorum=1, size=1)
    async with market.chain(market.stranger) as keeper:
        with raises_with(ChainError, code="no-fees"):
            await keeper.validators.collect(deployed.address)
        async with market.chain(market.provider, generation=5) as chain:
            liability = await create(market, chain, deployed.address, fee=2 * XRT)
            await chain.liabilities.finalize(
                market.deployment.lighthouse, market.result(liability, account=jurors[0], success=False)
            )
            with reverted("NotTheKeeper"):
                await chain.validators.collect(deployed.address)
        before = await keeper.tokens.balance()
        with raises_with(InsufficientTokens, balance=2 * XRT, needed=2 * XRT + 1):
            await keeper.validators.collect(deployed.address, 2 * XRT + 1)
        assert (await keeper.validators.collect(deployed.address, XRT // 2)).value == XRT // 2
        collected = await keeper.validators.collect(deployed.address)
        assert collected.value == 3 * XRT // 2
        assert collected.gas_used > 21_000
        assert await keeper.tokens.balance() == before + 2 * XRT
        jury = await keeper.validators.jury(deployed.address)
        assert jury is not None
        assert replace(jury, fees=0) == jury
        with raises_with(ChainError, code="not-a-jury"):
            await keeper.validators.collect(market.deployment.factory)
