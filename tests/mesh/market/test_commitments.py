"""What transactions under way compete for: makers' funds, nonces, liabilities."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, nullcontext
from typing import TYPE_CHECKING

from mesh.chain import Funding, Holding
from mesh.market.transactions import Commitments, Stakes

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

HOLDING = Holding("token", "maker")
TURNS = 100
"""Turns of the event loop in which what need not wait is taken, however busy the machine is."""


def of(amount: int) -> Stakes:
    return Stakes({HOLDING: amount})


def alone(what: str) -> Stakes:
    return Stakes(alone=frozenset({what}))


class Purses:
    """What there is of each holding, instead of a chain."""

    def __init__(self, amount: int | None) -> None:
        self.amount = amount
        self.asked = 0

    async def of(self, holdings: Sequence[Holding]) -> Mapping[Holding, Funding | None]:
        self.asked += 1
        answer = None if self.amount is None else Funding(self.amount, 10**9)
        await asyncio.sleep(0)
        return dict.fromkeys(holdings, answer)


async def taken_at_once(commitments: Commitments, *wanted: Stakes) -> list[bool]:
    """Which of these can be taken while those before are."""
    async with AsyncExitStack() as stack:
        found = []
        for stakes in wanted:
            taking = asyncio.create_task(stack.enter_async_context(commitments.take(stakes, nullcontext())))
            for _ in range(TURNS):
                await asyncio.sleep(0)
            found.append(taking.done())
            if not taking.done():
                taking.cancel()
            await asyncio.wait([taking])
    return found


async def test_no_more_is_taken_of_a_makers_funds_than_there_is() -> None:
    commitments = Commitments(Purses(10).of)
    five = of(5)
    assert await taken_at_once(commitments, five, five, of(1)) == [True, True, False]
    assert await taken_at_once(commitments, of(4), five, five) == [True, True, False]


async def test_the_first_is_left_to_the_simulation_without_asking_the_node() -> None:
    purses = Purses(1)
    commitments = Commitments(purses.of)
    assert await taken_at_once(commitments, of(5), Stakes({Holding("token", "other"): 5})) == [True, True]
    assert purses.asked == 0


async def test_funds_that_can_not_be_read_are_taken_by_one_at_a_time() -> None:
    assert await taken_at_once(Commitments(Purses(None).of), of(5), of(5)) == [True, False]


async def test_a_name_is_taken_by_one_at_a_time() -> None:
    commitments = Commitments(Purses(10).of)
    assert await taken_at_once(commitments, alone("one"), alone("one"), alone("other")) == [True, False, True]


async def test_who_waits_goes_on_when_it_is_given_back() -> None:
    commitments, order = Commitments(Purses(10).of), []

    async def take(number: int) -> None:
        async with commitments.take(of(6), nullcontext()):
            order.append(number)
            await asyncio.sleep(0.01)
            order.append(-number)

    async with asyncio.timeout(60):
        await asyncio.gather(*map(take, (1, 2, 3)))
    assert order == [1, -1, 2, -2, 3, -3]
    assert await taken_at_once(commitments, of(6)) == [True]


async def test_what_was_spent_is_not_counted_again_though_the_answer_is_older() -> None:
    """The first is mined and given back while the node is asked for the second."""
    purses = Purses(10)
    commitments, given_back = Commitments(purses.of), asyncio.Event()

    async def first() -> None:
        async with commitments.take(of(8), nullcontext()):
            await given_back.wait()

    holding = asyncio.create_task(first())
    await asyncio.sleep(0)
    async with commitments.take(of(1), nullcontext()):
        assert purses.asked == 1
        purses.amount = 2
        given_back.set()
        await holding
        assert await taken_at_once(commitments, of(2), of(1)) == [False, True]


async def test_those_that_wait_ask_the_node_once_after_each_that_ends() -> None:
    purses = Purses(10)
    commitments, done = Commitments(purses.of), []

    async def take(number: int) -> None:
        async with commitments.take(of(6), nullcontext()):
            await asyncio.sleep(0.001)
            done.append(number)

    async with asyncio.timeout(60):
        await asyncio.gather(*map(take, range(20)))
    assert len(done) == 20
    assert purses.asked <= 21
