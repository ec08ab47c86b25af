"""When a provider may send: by the contract's rule, and without racing the providers before it."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.chain import XRT
from mesh.market.transactions import NoStake, Turns

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.support.provider.local_market import LocalMarket


@asynccontextmanager
async def turns(local: LocalMarket, role: str, **options: int) -> AsyncIterator[Turns]:
    async with local.chain_of(role) as chain:
        yield Turns(chain, local.lighthouse, **options)


async def head(local: LocalMarket) -> int:
    return await local.chain.block_number()


async def send_one(local: LocalMarket, role: str) -> None:
    """Send a transaction of a provider to the lighthouse."""
    async with local.chain_of(role) as chain:
        await chain.liabilities.create(local.lighthouse, local.demand(), local.offer())


async def test_a_turn_lasts_as_many_transactions_as_the_quota(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=1000, provider=2, rival=1)
    async with turns(local, "provider") as ours, turns(local, "rival") as theirs:
        for _ in range(2):
            assert await ours.has_come(since=0)
            assert not await theirs.has_come(since=0)
            ours.take_one()
            await send_one(local, "provider")
            ours.ended()
        assert not await ours.has_come(since=0)
        assert await theirs.has_come(since=0)


async def test_while_transactions_are_under_way_no_more_are_sent_than_the_turn_has(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=1000, provider=2, rival=1)
    async with turns(local, "provider", most=16) as ours:
        for _ in range(2):
            assert await ours.has_come(since=0)
            ours.take_one()
        assert not await ours.has_come(since=0)
        ours.ended()
        assert not await ours.has_come(since=0)
        ours.ended()
        assert await ours.has_come(since=0)  # they were not mined


async def test_a_single_provider_may_have_more_transactions_under_way_than_its_quota(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=1000, provider=1)
    async with turns(local, "provider", most=3) as ours:
        for _ in range(3):
            assert await ours.has_come(since=0)
            ours.take_one()
        assert not await ours.has_come(since=0)


async def test_a_single_provider_always_has_the_turn(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=1000, provider=1)
    async with turns(local, "provider") as ours:
        for _ in range(3):
            assert await ours.has_come(since=await head(local))
            ours.take_one()
            await send_one(local, "provider")
            ours.ended()


async def test_after_a_pause_a_new_job_is_left_to_the_provider_on_turn(local: LocalMarket) -> None:
    """After the timeout the contract would let all providers send at once."""
    await local.create_lighthouse(timeout_blocks=5, provider=1, rival=1)
    await local.mine(50)
    posted = await head(local)
    async with turns(local, "provider") as ours, turns(local, "rival") as theirs:
        assert await ours.has_come(since=posted)
        assert not await theirs.has_come(since=posted)
        await local.mine(4)
        assert not await theirs.has_come(since=posted)
        await local.mine(1)
        assert await theirs.has_come(since=posted)


async def test_the_provider_after_next_waits_for_two_timeouts(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=5, provider=1, rival=1, robot=1)
    await local.mine(50)
    posted = await head(local)
    async with turns(local, "robot") as last:
        await local.mine(9)
        assert not await last.has_come(since=posted)
        await local.mine(1)
        assert await last.has_come(since=posted)


async def test_further_providers_wait_for_two_timeouts_and_a_block_each(local: LocalMarket) -> None:
    """However many silent ones are before them."""
    await local.create_lighthouse(timeout_blocks=5, provider=1, rival=1, robot=1, person=1)
    await local.mine(50)
    posted = await head(local)
    async with turns(local, "person") as last:
        await local.mine(10)
        assert not await last.has_come(since=posted)
        await local.mine(1)
        assert await last.has_come(since=posted)


async def test_an_old_job_does_not_shorten_the_contracts_timeout(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=20, provider=2, rival=1)
    await send_one(local, "provider")
    async with turns(local, "rival") as theirs:
        assert not await theirs.has_come(since=0)
        await local.mine(20)
        assert await theirs.has_come(since=0)


async def test_after_forget_the_lighthouse_is_asked_again(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=1000, provider=1, rival=1)
    async with turns(local, "provider") as ours:
        assert await ours.has_come(since=0)
        await send_one(local, "provider")
        ours.forget()
        assert not await ours.has_come(since=0)


async def test_a_provider_without_a_stake_has_no_turn(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=1, provider=1)
    await local.mine(50)
    async with turns(local, "poor") as never:
        with pytest.raises(NoStake) as caught:
            await never.has_come(since=0)
        error = caught.value
        assert (error.provider, error.lighthouse) == (local.address("poor"), local.lighthouse)
        assert error.minimal_stake == XRT
        assert f"aira lighthouse join {XRT}wn" in error.hint
