"""Quotes, and orders from the robot that is chosen by them."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh import Agent
from mesh.agent.handlers import Declined
from mesh.agent.hiring import DemandDeclined
from mesh.errors import RemoteError
from mesh.network import Endpoints, Network, Services
from mesh.testing import assert_paid
from schemas.rpc import Quote, QuoteRequest
from tests.support.agent.trades import JOB, doing_nothing, working
from tests.support.market import MODEL
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent.handlers import Job
    from mesh.testing import Market
    from schemas import Demand, Verified
    from tests.support.market import Place


def priced(robot: Agent, price: int | str, *, only: str = "") -> Agent:
    """The same robot, which does every job for a price; or declines each, with the code `only`."""

    @robot.on_quote
    async def quote(request: QuoteRequest) -> int | str:
        if only:
            raise Declined(only, "not today")
        return price

    return working(robot)


@asynccontextmanager
async def two_robots(market: Market) -> AsyncIterator[tuple[Agent, Agent, Agent]]:
    """A dear robot, a cheap one, and a person."""
    async with (
        market.robot(priced(Agent(MODEL), 9)) as dear,
        market.robot(priced(Agent(MODEL), 4)) as cheap,
        asyncio.timeout(60),
    ):
        yield dear, cheap, await market.person()


async def test_robots_say_what_they_want_the_cheapest_first(market: Market) -> None:
    async with two_robots(market) as (dear, cheap, person):
        quotes = await person.quotes(MODEL, JOB)
        assert [(one.agent, one.cost, one.code) for one in quotes] == [(cheap.address, 4, ""), (dear.address, 9, "")]
        assert all(one.is_signed and one.until > person.parts.chain_head.head for one in quotes)
        assert {one.token for one in quotes} == {person.chain.xrt}
        contract = await market.demand(MODEL, JOB, robot="cheapest", max_cost=8)
        assert (contract.robot, contract.liability.cost) == (cheap.address, 4)
        assert_paid(await market.outcome(contract))


async def test_a_price_above_the_most_is_not_paid(market: Market) -> None:
    async with two_robots(market) as (dear, cheap, person):
        with raises_with(RemoteError, code="no-robot-fits", match="wants"):
            await market.demand(MODEL, JOB, by=person, robot="cheapest", max_cost=3)
        assert person.orders() == []
        contract = await market.demand(dear, JOB, cost=1, max_cost=20)
        assert (contract.liability.cost, contract.robot) == (9, dear.address)
        open_to_all = await person.order(JOB, model=MODEL, cost=1, max_cost=5)
        assert open_to_all.message.cost == 4
        as_given = await person.order(JOB, model=MODEL, cost=1, max_cost=2)
        assert as_given.message.cost == 1
        assert cheap.address != dear.address


class Move(msgspec.Struct):
    meters: int


async def test_a_price_may_depend_on_what_the_objective_plays(market: Market) -> None:
    robot, person = Agent(MODEL), await market.person()

    @robot.on("/move")
    async def move(job: Job, message: Move) -> None:
        pass

    @robot.on("*")
    async def others(job: Job, message: Any) -> None:
        pass

    @robot.on_quote
    async def price(request: QuoteRequest) -> int:
        return sum(move.meters for move in (await robot.examine(request)).of(Move))

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        messages = await robot.examine(demand)
        assert [topic for topic, _ in messages] == ["/move", "/lamp", "/move"]
        if demand.message.cost < sum(move.meters for move in messages.of(Move)):
            raise Declined("too-cheap")
        await robot.offer(demand)

    wanted = [("/move", Move(3)), ("/lamp", True), ("/move", Move(4))]
    async with market.robot(robot):
        (quote,) = await person.quotes(MODEL, wanted)
        assert quote.cost == 7
        with pytest.raises(DemandDeclined, match="too-cheap"):
            await market.demand(robot, wanted, cost=6)
        assert (await market.demand(robot, wanted, cost=7)).liability.cost == 7


async def test_a_robot_declines_with_its_reason(market: Market) -> None:
    async with market.robot(priced(Agent(MODEL), 1, only="closed-today")):
        (quote,) = await (await market.person()).quotes(MODEL, JOB)
        assert (quote.code, quote.detail, quote.cost) == ("closed-today", "not today", 0)
        with pytest.raises(RemoteError, match="closed-today"):
            await market.demand(MODEL, JOB, robot="first", max_cost=5)


async def test_a_robot_without_a_price_says_so(market: Market) -> None:
    async with market.robot(working(Agent(MODEL))):
        assert [one.code for one in await (await market.person()).quotes(MODEL, JOB)] == ["no-price"]


async def test_the_next_robot_is_asked_if_the_cheapest_declines_after_all(market: Market) -> None:
    second = Agent(MODEL)
    second.on_quote(lambda request: "2wn")

    @second.on_demand
    async def decline(demand: Any) -> None:
        raise Declined("busy-now", "another one was faster")

    async with market.robot(second), market.robot(priced(Agent(MODEL), 7)) as robot:
        assert (await market.demand(MODEL, JOB, robot="cheapest", max_cost=10)).robot == robot.address
        with pytest.raises(DemandDeclined, match="another one was faster"):
            await market.demand(second, JOB, cost=2)


async def test_a_quote_that_another_one_has_signed_does_not_count(place: Place) -> None:
    stranger = place.market.accounts["provider"].signer

    async def lie(request: QuoteRequest) -> Quote:
        return Quote(agent=place.address("robot"), request=request.identity, cost=1).signed_by(stranger)

    async with (
        Network(Endpoints(connect=(place.endpoint,))) as network,
        Services(network.session, place.address("robot")) as services,
        doing_nothing(place.agent("robot")),
        place.agent("person") as person,
    ):
        services.offer("quote", lie)
        assert await person.quotes(MODEL, JOB) == []
