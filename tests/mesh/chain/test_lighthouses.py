"""Staking on lighthouses, and listing them."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import (
    XRT,
    Account,
    Approval,
    InsufficientTokens,
    NewLighthouse,
    NoContracts,
    TransactionTimeout,
    Transfer,
    _contracts,
    new_private_key,
)
from mesh.chain.answers import InvalidAnswer
from mesh.errors import InputError
from schemas.address import ZERO_ADDRESS
from tests.mesh.chain.conftest import QUICK, events_of, no_contracts, prepare, read_to
from tests.support.nodes import Anvil

if TYPE_CHECKING:
    from pathlib import Path

    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")

STAKE = 25


async def _newcomer(market: DeployedMarket, *, holding: int) -> Account:
    """An account with ether and XRT."""
    account = Account(new_private_key())
    async with market.chain(market.deployer) as chain:
        await chain.tokens.send_eth(account.address, 10**18)
        await chain.tokens.transfer(account.address, holding)
    return account


async def _beacon(market: DeployedMarket, name: str) -> str:
    async with market.chain(market.deployer) as chain:
        return (await chain.lighthouses.create(minimal_stake=10, timeout_blocks=3, name=name)).lighthouse


async def test_becoming_a_provider_approves_and_stakes_exactly_the_stake(market: DeployedMarket) -> None:
    beacon, account = await _beacon(market, "first"), await _newcomer(market, holding=XRT)
    async with market.chain(account) as chain:
        start = await chain.block_number()
        state = await chain.lighthouses.become_provider("first", STAKE)
        assert (state.stakes, state.current) == ({account.address: STAKE}, account.address)
        assert await chain.tokens.allowance(account.address, beacon) == 0
        events = events_of(await read_to(chain, start + 1, await chain.block_number()))
    assert [event.value for event in events if isinstance(event, Approval)] == [STAKE]
    assert [event.value for event in events if isinstance(event, Transfer)] == [STAKE]


async def test_providers_are_read_in_the_order_of_their_turns(
    market: DeployedMarket, monkeypatch: pytest.MonkeyPatch
) -> None:
    await _beacon(market, "queue")
    accounts = [await _newcomer(market, holding=XRT) for _ in range(4)]
    for number, account in enumerate(accounts):
        async with market.chain(account) as chain:
            await chain.lighthouses.become_provider("queue", STAKE + number)
    async with market.chain(accounts[0]) as chain:
        await chain.lighthouses.withdraw("queue", STAKE)
        await chain.lighthouses.become_provider("queue", STAKE)
        for page in (1, 2, 3, 250):
            limits = _contracts.LIGHTHOUSE_LIMITS._replace(page=page)
            monkeypatch.setattr(_contracts, "LIGHTHOUSE_LIMITS", limits)
            state = await chain.lighthouses.get("queue")
            stakes = {account.address: STAKE + number for number, account in enumerate(accounts)}
            in_turn = [*accounts[1:], accounts[0]]
            assert list(state.stakes.items()) == [(one.address, stakes[one.address]) for one in in_turn]
            assert state.current == accounts[1].address


async def test_a_queue_that_never_ends_is_an_invalid_answer(
    market: DeployedMarket, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with market.chain() as chain:
        read_all = chain.node.read_all

        async def lying(calls: Any, **options: Any) -> Any:
            asked = list(calls)
            values = await read_all(asked, **options)
            endless = market.provider.address
            return [
                (*value[:2], endless) if call.fn_name == "queue" else value
                for call, value in zip(asked, values, strict=True)
            ]

        async def lying_once(call: Any, block: Any = "latest") -> Any:
            return (await lying([call], block=block))[0]

        monkeypatch.setattr(chain.node, "read_all", lying)
        monkeypatch.setattr(chain.node, "read", lying_once)
        with pytest.raises(InvalidAnswer):
            await chain.lighthouses.get("airalab")


async def test_a_provider_that_stakes_enough_already_sends_nothing(market: DeployedMarket) -> None:
    await _beacon(market, "second")
    account = await _newcomer(market, holding=XRT)
    async with market.chain(account) as chain:
        await chain.lighthouses.become_provider("second", STAKE)
        sent = await chain.node.transaction_count(account.address)
        state = await chain.lighthouses.become_provider("second", STAKE - 5)
        assert state.stakes == {account.address: STAKE}
        assert await chain.node.transaction_count(account.address) == sent
        assert (await chain.lighthouses.become_provider("second", STAKE + 1)).stakes == {account.address: STAKE + 1}


async def test_becoming_a_provider_resumes_after_an_interruption(market: DeployedMarket) -> None:
    beacon, account = await _beacon(market, "third"), await _newcomer(market, holding=XRT)
    async with market.chain(account) as chain:
        await chain.tokens.approve(beacon, STAKE)  # and then the process was killed
    async with market.chain(account) as chain:
        start = await chain.block_number()
        assert (await chain.lighthouses.become_provider("third", STAKE)).stakes == {account.address: STAKE}
        events = events_of(await read_to(chain, start + 1, await chain.block_number()))
    assert not [event for event in events if isinstance(event, Approval)]


async def test_a_stake_sent_before_a_crash_is_not_sent_again(tmp_path: Path) -> None:
    async with Anvil() as anvil:
        market = await prepare(anvil.url, anvil.private_keys)
        beacon, account = await _beacon(market, "beacon"), await _newcomer(market, holding=XRT)
        async with market.chain(account) as chain:
            await chain.tokens.approve(beacon, STAKE)
            await chain.node.request("evm_setAutomine", False)
        hasty = replace(QUICK, receipt_timeout=0.3)
        async with market.chain(account, transactions=tmp_path, timing=hasty) as chain:
            with pytest.raises(TransactionTimeout) as sent:
                await chain.lighthouses.become_provider("beacon", STAKE)
        async with market.chain(account, transactions=tmp_path) as chain, asyncio.timeout(30):
            becoming = asyncio.create_task(chain.lighthouses.become_provider("beacon", STAKE))
            await asyncio.sleep(5 * QUICK.poll_interval)
            await chain.node.request("evm_mine")
            assert (await becoming).stakes == {account.address: STAKE}
            assert await chain.node.receipt(sent.value.tx)
            assert await chain.node.transaction_count(account.address) == 2


@pytest.mark.parametrize("generation", [3, 5])
async def test_providers_join_the_originals_in_the_same_way(market: DeployedMarket, generation: int) -> None:
    await _beacon(market, f"original-{generation}")
    account = await _newcomer(market, holding=XRT)
    async with market.chain(account, kind="original", generation=generation) as chain:
        state = await chain.lighthouses.become_provider(f"original-{generation}", STAKE)
    assert state.stakes == {account.address: STAKE}


async def test_a_small_stake_and_missing_tokens_are_refused_before_anything_is_sent(market: DeployedMarket) -> None:
    await _beacon(market, "fourth")
    account = await _newcomer(market, holding=STAKE)
    async with market.chain(account) as chain:
        with pytest.raises(InputError, match="a stake of 9 wn") as small:
            await chain.lighthouses.become_provider("fourth", 9)
        with pytest.raises(InsufficientTokens) as poor:
            await chain.lighthouses.become_provider("fourth", STAKE + 1)
        assert await chain.node.transaction_count(account.address) == 0
    assert small.value.code == "stake-too-small"
    assert (small.value.hint, poor.value.hint) != ("", "")
    assert (poor.value.account, poor.value.balance, poor.value.needed) == (account.address, STAKE, STAKE + 1)


async def test_only_contracts_of_the_factory_are_lighthouses(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        assert await chain.lighthouses.exists("airalab.lighthouse.3.robonomics.eth")
        assert not await chain.lighthouses.exists(market.deployment.xrt)
        assert not await chain.lighthouses.exists(ZERO_ADDRESS)


async def test_creating_a_lighthouse_returns_its_event(market: DeployedMarket) -> None:
    async with market.chain(market.provider) as chain:
        made = await chain.lighthouses.create(minimal_stake=1, timeout_blocks=1, name="far")
    assert isinstance(made, NewLighthouse)
    assert made.name == "far"
    assert made.tx.startswith("0x")


async def test_an_address_that_is_not_a_lighthouse_is_an_error(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        with no_contracts("queue"):
            await chain.lighthouses.get(market.promisee.address)
        functions = chain.node.contract("Liability", market.promisee.address)
        with pytest.raises(NoContracts):
            await chain.node.read_all((functions.model(), functions.cost()), block="latest")
