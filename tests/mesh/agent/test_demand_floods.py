"""Floods of demands: makers without money, and objectives that nobody has."""

from __future__ import annotations

import asyncio
import secrets
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.orders import TooManyOffers
from mesh.base.database import LedgerUnusable
from mesh.chain import NodeUnreachable, RequestRefused, TransactionTimeout
from mesh.network import Channel, Endpoints, Network
from schemas import Demand, Signer, cid_of_bytes
from tests.support import orders
from tests.support.market import MODEL, Place, offering
from tests.support.objectives import objective
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent.agent import Agent
    from mesh.errors import AiraError
    from schemas import Verified

BEFORE_ITS_TURN = 30.0
"""Seconds in which an honest demand is a contract, though a flood came first, which would take three times as long."""


@asynccontextmanager
async def stranger(place: Place) -> AsyncIterator[Channel]:
    """The channel of a participant that has no account, once it reaches a robot."""
    lighthouse = place.market.deployment.lighthouse_name
    async with (
        Network(Endpoints(connect=(place.endpoint,))) as network,
        Channel(network.session, lighthouse) as channel,
    ):
        await until_heard(network.session, f"aira/{lighthouse}/demand/{MODEL}")
        yield channel


def dead_demand(place: Place, signer: Signer | None = None, **changes: Any) -> Demand:
    """A demand of a fresh key for an objective that nobody has."""
    fields: dict[str, Any] = {
        "model": MODEL,
        "objective": cid_of_bytes(secrets.token_bytes(8)),
        "token": place.chains["person"].xrt,
        "lighthouse": place.market.deployment.lighthouse,
        "cost": 1,
    }
    return orders.demand(signer=signer or Signer(secrets.token_bytes(32)), **(fields | changes))


def counting(robot: Agent) -> list[Verified[Demand]]:
    """The demands that the robot's handlers get from now on."""
    handled: list[Verified[Demand]] = []

    @robot.on_demand
    async def count(demand: Verified[Demand]) -> None:
        handled.append(demand)

    return handled


@pytest.mark.sample("cost")
@pytest.mark.parametrize("cost", [1, 0])
async def test_an_honest_demand_is_offered_during_a_flood_of_dead_objectives(place: Place, cost: int) -> None:
    robot = offering(place.agent("robot", fetch_timeout=60.0))
    handled = counting(robot)
    async with place.at_work(robot) as person, stranger(place) as channel:
        path = place.save(objective(("/go", "there")))
        for number in range(300):
            channel.publish(dead_demand(place, cost=cost))
            if number % 50 == 49:
                await asyncio.sleep(0.1)
        await until(lambda: len(handled) >= 1 or robot.drops.totals().get("unfunded", 0) >= 1)
        async with asyncio.timeout(BEFORE_ITS_TURN):
            await person.demand(path, cost=100)


async def test_the_same_dead_objective_takes_one_fetch(place: Place) -> None:
    robot = offering(place.agent("robot", fetch_timeout=5.0))
    missing = cid_of_bytes(b"nobody has this one")
    async with place.at_work(robot) as person, stranger(place) as channel:
        for _ in range(100):
            channel.publish(dead_demand(place, cost=0, objective=missing))
        await until(
            lambda: sum(robot.drops.totals().values()) >= 92, what="all but those that share a fetch are dropped"
        )
        assert robot.drops.totals().keys() == {"objective-shared", "free-rate"}
        await until(lambda: sum(robot.drops.totals().values()) == 100)
        async with asyncio.timeout(BEFORE_ITS_TURN):
            await person.demand(place.save(objective(("/go", "there"))), cost=1)


async def test_a_demand_is_handled_once_its_maker_can_pay(place: Place) -> None:
    robot = place.agent("robot")
    handled = counting(robot)
    signer, rich = place.market.accounts["robot"].signer, place.chains["robot"]
    await rich.tokens.approve(rich.factory, 0)
    demand = dead_demand(place, signer, cost=5)
    async with robot, stranger(place) as channel:
        channel.publish(demand)
        await until(lambda: robot.drops.totals().get("unfunded") == 1)
        assert handled == []
        await rich.tokens.approve(rich.factory, 5)  # it was under way when the demand came: nobody sends it again
        await until(lambda: handled)
        assert [one.message for one in handled] == [demand]


@pytest.mark.parametrize(
    "error",
    [
        NodeUnreachable("http://there", "it is away"),
        RequestRefused("eth_call", -32000, "busy"),
        TransactionTimeout("0x01", 9.0),
        LedgerUnusable(Path("ledger.sqlite"), "database or disk is full"),
        TooManyOffers("0x02"),
    ],
    ids=lambda error: error.code,
)
async def test_a_demand_is_handled_again_after_a_failure_that_passes(place: Place, error: AiraError) -> None:
    """Nobody else may be there to offer, and the demand would wait until its deadline."""
    robot, attempts = place.agent("robot"), list[str]()

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        attempts.append(demand.hash.hex())
        if len(attempts) == 1:
            raise error
        await robot.offer(demand)

    async with place.at_work(robot) as person:
        await person.demand(place.save(objective(("/go", "there"))), cost=100)
        assert len(attempts) > len(set(attempts)) == 1
        others = {"unfunded"}  # the permit beside the demand may be read after it
        assert {code: many for code, many in robot.drops.totals().items() if code not in others} == {error.code: 1}


async def test_of_many_free_demands_few_are_handled(place: Place) -> None:
    robot = place.agent("robot")
    handled = counting(robot)
    async with robot, stranger(place) as channel:
        for _ in range(200):
            channel.publish(dead_demand(place, cost=0))
        await until(lambda: len(handled) + robot.drops.totals().get("free-rate", 0) == 200)
        assert robot.drops.totals()["free-rate"] >= 20


async def test_free_demands_are_handled(place: Place) -> None:
    robot = place.agent("robot")
    handled = counting(robot)
    async with robot, stranger(place) as channel:
        demands = [dead_demand(place, cost=0) for _ in range(20)]
        for demand in demands:
            channel.publish(demand)
        await until(lambda: len(handled) == 20)
        assert robot.drops.totals() == {}
