"""Quotes, and orders from the robot that is chosen by them."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh.agent.errors import Declined, DemandDeclined
from mesh.errors import RemoteError
from mesh.network import Endpoints, Network, Services
from schemas.rpc import Quote, QuoteRequest
from tests.mesh.agent.trades import job, working
from tests.support.market import MODEL, Place

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh import Agent
    from mesh.agent.handlers import Job
    from schemas import Demand, Verified


def priced(robot: Agent, price: int | str, *, only: str = "") -> Agent:
    """The same robot, which does every job for a price; or declines each, with the code `only`."""

    @robot.on_quote
    async def quote(request: QuoteRequest) -> int | str:
        if only:
            raise Declined(only, "not today")
        return price

    return working(robot)


def played_by_devices(robot: Agent) -> Agent:
    """The same robot, which has a profile, and no handler of demands, so that it quotes nothing."""

    @robot.on("*")
    async def nothing(job: Job, message: Any) -> None:
        pass

    return robot


@asynccontextmanager
async def two_robots(place: Place, dear: int = 9, cheap: int = 4) -> AsyncIterator[tuple[Agent, Agent, Agent]]:
    """A dear robot, a cheap one, and a person, with a provider at work."""
    async with (
        place.another(5) as second,
        place.provider(),
        priced(place.agent("robot"), dear) as first,
        priced(second, cheap),
        place.agent("person") as person,
        asyncio.timeout(60),
    ):
        yield first, second, person


async def test_robots_say_what_they_want_the_cheapest_first(place: Place) -> None:
    async with two_robots(place) as (dear, cheap, person):
        quotes = await person.quotes(MODEL, job(place))
        assert [(one.agent, one.cost, one.code) for one in quotes] == [(cheap.address, 4, ""), (dear.address, 9, "")]
        assert all(one.is_signed and one.until > person.parts.chain_head.head for one in quotes)
        assert {one.token for one in quotes} == {person.chain.xrt}
        contract = await person.demand(job(place), robot="cheapest", max_cost=8)
        assert (contract.robot, contract.liability.cost) == (cheap.address, 4)
        assert (await contract.outcome()).success


async def test_a_price_above_the_most_is_not_paid(place: Place) -> None:
    async with two_robots(place) as (dear, cheap, person):
        with pytest.raises(RemoteError, match="wants") as caught:
            await person.order(job(place), robot="cheapest", max_cost=3)
        assert caught.value.code == "no-robot-fits"
        assert person.orders() == []
        order = await person.order(job(place), cost=1, max_cost=20, robot=dear.address)
        assert (order.message.cost, (await order.contract()).robot) == (9, dear.address)
        open_to_all = await person.order(job(place), cost=1, max_cost=5)
        assert open_to_all.message.cost == 4
        as_given = await person.order(job(place), cost=1, max_cost=2)
        assert as_given.message.cost == 1
        assert cheap.address != dear.address


class Move(msgspec.Struct):
    meters: int


async def test_a_price_may_depend_on_what_the_objective_plays(place: Place) -> None:
    robot = place.agent("robot")

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
    async with robot, place.agent("person") as person:
        (quote,) = await person.quotes(MODEL, wanted)
        assert quote.cost == 7
        with pytest.raises(DemandDeclined, match="too-cheap"):
            await person.order(wanted, cost=6, robot=robot.address)
        assert (await person.order(wanted, cost=7, robot=robot.address)).message.cost == 7


async def test_a_robot_declines_with_its_reason(place: Place) -> None:
    async with priced(place.agent("robot"), 1, only="closed-today"), place.agent("person") as person:
        (quote,) = await person.quotes(MODEL, job(place))
        assert (quote.code, quote.detail, quote.cost) == ("closed-today", "not today", 0)
        with pytest.raises(RemoteError, match="closed-today"):
            await person.order(job(place), robot="first", max_cost=5)


async def test_a_robot_without_a_price_says_so(place: Place) -> None:
    async with working(place.agent("robot")), place.agent("person") as person:
        assert [one.code for one in await person.quotes(MODEL, job(place))] == ["no-price"]


async def test_the_next_robot_is_asked_if_the_cheapest_declines_after_all(place: Place) -> None:
    async with place.another(5) as second:

        @second.on_quote
        async def quote(request: QuoteRequest) -> str:
            return "2wn"

        @second.on_demand
        async def decline(demand: Any) -> None:
            raise Declined("busy-now", "another one was faster")

        async with place.provider(), second, priced(place.agent("robot"), 7) as robot, place.agent("person") as person:
            order = await person.order(job(place), robot="cheapest", max_cost=10)
            assert (await order.contract()).robot == robot.address
            with pytest.raises(DemandDeclined, match="another one was faster"):
                await person.order(job(place), robot=second.address, cost=2)


async def test_a_quote_that_another_one_has_signed_does_not_count(place: Place) -> None:
    stranger = place.market.accounts["provider"].signer

    async def lie(request: QuoteRequest) -> Quote:
        return Quote(agent=place.address("robot"), request=request.identity, cost=1).signed_by(stranger)

    async with (
        Network(Endpoints(connect=(place.endpoint,))) as network,
        Services(network.session, place.address("robot")) as services,
        played_by_devices(place.agent("robot")),
        place.agent("person") as person,
    ):
        services.offer("quote", lie)
        assert await person.quotes(MODEL, job(place)) == []
