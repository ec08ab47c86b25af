"""Whose turn it is: by the contract's rule, and without racing those who were there before."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.chain import XRT
from mesh.market.transaction_queue import NoStake, Turns

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.mesh.market.floor import Floor


@asynccontextmanager
async def turns(floor: Floor, role: str) -> AsyncIterator[Turns]:
    async with floor.chain_of(role) as chain:
        yield Turns(chain, floor.lighthouse)


async def head(floor: Floor) -> int:
    return await floor.chain.block_number()


async def send_one(floor: Floor, role: str) -> None:
    """A transaction of a provider's to the lighthouse."""
    async with floor.chain_of(role) as chain:
        await chain.liabilities.create(floor.lighthouse, floor.demand(), floor.offer())


async def test_a_turn_lasts_as_many_transactions_as_are_staked_for(floor: Floor) -> None:
    await floor.found_lighthouse(timeout_blocks=1000, provider=2, rival=1)
    async with turns(floor, "provider") as ours, turns(floor, "rival") as theirs:
        for _ in range(2):
            assert await ours.has_come(since=0)
            assert not await theirs.has_come(since=0)
            await send_one(floor, "provider")
            ours.took_one()
        assert not await ours.has_come(since=0)
        assert await theirs.has_come(since=0)


async def test_who_is_alone_always_has_the_turn(floor: Floor) -> None:
    await floor.found_lighthouse(timeout_blocks=1000, provider=1)
    async with turns(floor, "provider") as ours:
        for _ in range(3):
            assert await ours.has_come(since=await head(floor))
            await send_one(floor, "provider")
            ours.took_one()


async def test_after_silence_a_new_job_is_left_to_whose_turn_it_is(floor: Floor) -> None:
    """Nothing was to do for long, so that the contract would let anybody in; they would all come at once."""
    await floor.found_lighthouse(timeout_blocks=5, provider=1, rival=1)
    await floor.mine(50)
    posted = await head(floor)
    async with turns(floor, "provider") as ours, turns(floor, "rival") as theirs:
        assert await ours.has_come(since=posted)
        assert not await theirs.has_come(since=posted)
        await floor.mine(4)
        assert not await theirs.has_come(since=posted)
        await floor.mine(1)
        assert await theirs.has_come(since=posted)


async def test_the_second_in_line_waits_for_two_timeouts(floor: Floor) -> None:
    await floor.found_lighthouse(timeout_blocks=5, provider=1, rival=1, robot=1)
    await floor.mine(50)
    posted = await head(floor)
    async with turns(floor, "robot") as last:
        await floor.mine(9)
        assert not await last.has_come(since=posted)
        await floor.mine(1)
        assert await last.has_come(since=posted)


async def test_a_job_that_waits_for_long_does_not_shorten_the_contracts_timeout(floor: Floor) -> None:
    await floor.found_lighthouse(timeout_blocks=20, provider=2, rival=1)
    await send_one(floor, "provider")
    async with turns(floor, "rival") as theirs:
        assert not await theirs.has_come(since=0)
        await floor.mine(20)
        assert await theirs.has_come(since=0)


async def test_a_turn_that_may_have_passed_is_asked_for_again(floor: Floor) -> None:
    await floor.found_lighthouse(timeout_blocks=1000, provider=1, rival=1)
    async with turns(floor, "provider") as ours:
        assert await ours.has_come(since=0)
        await send_one(floor, "provider")
        ours.forget()
        assert not await ours.has_come(since=0)


async def test_without_a_stake_there_is_no_turn(floor: Floor) -> None:
    await floor.found_lighthouse(timeout_blocks=1, provider=1)
    await floor.mine(50)
    async with turns(floor, "poor") as never:
        with pytest.raises(NoStake) as caught:
            await never.has_come(since=0)
        error = caught.value
        assert (error.provider, error.lighthouse) == (floor.address("poor"), floor.lighthouse)
        assert error.minimal_stake == XRT
        assert f"aira lighthouse join {XRT}wn" in error.hint
