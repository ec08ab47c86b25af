"""Robots say why they don't work for a demand, and those who demand hear it of robots that are present."""

from __future__ import annotations

import asyncio
import itertools
import secrets
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace

from mesh import Agent, Declined, DemandDeclined, InputError, Progress, Settings
from mesh.agent.demands import PER_MAKER, DeclinePublisher, Grounds
from mesh.base.flood import Drops
from mesh.network import Endpoints, Network
from schemas import DeclineKey, Demand, Empty, RejectKey, Signer, Verified, cid_of_bytes
from schemas.signing import Decline
from tests.support import orders
from tests.support.agent.trades import OBJECTIVE, posted
from tests.support.log_events import logged_facts
from tests.support.market import MODEL, offering
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from mesh.agent.handlers import Job
    from mesh.agent.trade import Order
    from mesh.testing import Market
    from tests.support.market import Place


def taking_speeds() -> Agent:
    """A robot that offers for all that it can play: numbers on `/go`."""
    robot = offering(Agent(MODEL))

    @robot.on("/go", float)
    async def go(job: Job, speed: float) -> None:
        pass

    return robot


async def declined(market: Market, wanted: Any) -> Progress:
    """The first decline that a person hears who demands something."""
    person, heard = await market.person(), list[Progress]()
    demand = asyncio.create_task(person.demand(wanted, model=MODEL, on_progress=heard.append))
    await until(lambda: any(progress.kind == "declined" for progress in heard), seconds=60)
    demand.cancel()
    await asyncio.wait([demand])
    return next(progress for progress in heard if progress.kind == "declined")


@pytest.mark.parametrize(
    ("message", "code"), [(("/fly", Empty()), "unknown-topic"), (("/go", "fast"), "unfit-message")]
)
async def test_a_robot_says_why_an_objective_does_not_fit(market: Market, message: Any, code: str) -> None:
    async with market.robot(taking_speeds()) as robot:
        progress = await declined(market, [message])
        assert (progress.agent, progress.code) == (robot.address, code)
        assert message[0] in progress.detail


async def test_a_robot_says_that_it_found_nobody_with_the_objective(market: Market) -> None:
    async with market.robot(offering(Agent(MODEL, settings=Settings(fetch_timeout=0.5)))) as robot:
        progress = await declined(market, cid_of_bytes(b"nobody has this"))
        assert progress.code == "objective-unavailable"
        assert robot.settings.data_dir not in progress.detail


async def test_a_handler_declines_with_a_word_of_its_own(market: Market, caplog: pytest.LogCaptureFixture) -> None:
    robot = _declining("costs at least 5 XRT" + "!" * 1000)
    async with market.robot(robot):
        progress = await declined(market, OBJECTIVE)
        assert progress.code == "too-cheap"
        assert progress.detail.startswith("costs at least 5 XRT")
        assert len(progress.detail) == 500
    assert logged_facts(caplog, "handler-failed") == []


def test_a_decline_needs_a_word_for_programs() -> None:
    for word in ("", "Too cheap", "too_cheap", "a" * 65):
        with pytest.raises(InputError):
            Declined(word)


@asynccontextmanager
async def demanding(
    place: Place, heard: list[Progress]
) -> AsyncIterator[tuple[Agent, Agent, Order, Callable[[Decline], None]]]:
    """A robot and a person who waits for a contract: both, the order, and a way for anybody to put declines of it."""
    async with (
        place.agent("robot") as robot,
        place.agent("person") as person,
        Network(Endpoints(connect=(place.endpoint,))) as network,
    ):
        key = str(DeclineKey(person.channel.lighthouse, place.address("person")))

        def put(decline: Decline) -> None:
            network.session.put(key, decline.encode())

        demand = asyncio.create_task(person.demand(OBJECTIVE, on_progress=heard.append))
        await posted(person)
        (order,) = person.orders()
        yield robot, person, order, put
        demand.cancel()
        await asyncio.wait([demand])


async def test_a_decline_is_believed_of_agents_that_are_present(place: Place) -> None:
    """Not of accounts that are not; not if it has another's signature; and of each agent once."""
    stranger, heard = Signer(secrets.token_bytes(32)), list[Progress]()
    async with demanding(place, heard) as (robot, person, order, put):
        absent = Decline(order=order.hash, code="busy", detail="", agent=stranger.address).signed_by(stranger)
        true = Decline(order=order.hash, code="busy", detail="", agent=robot.address).signed_by(robot.parts.signer)
        forged = replace(absent, agent=robot.address, detail="forged")
        other = Decline(order="00" * 32, code="busy", detail="", agent=robot.address).signed_by(robot.parts.signer)

        def are_heard() -> bool:
            for decline in (absent, forged, other, true):
                put(decline)
            return bool(heard) and "declines" in person.drops.totals()

        await until(are_heard)
        assert heard == [Progress(kind="declined", agent=robot.address, code="busy")]


async def test_an_agent_that_goes_on_declining_is_not_heard(place: Place) -> None:
    """Each of its declines differs from the one before."""
    heard: list[Progress] = []
    async with demanding(place, heard) as (robot, person, order, put):
        signer, numbers = robot.parts.signer, itertools.count()

        def are_dropped() -> bool:
            for _ in range(10):
                decline = Decline(order=order.hash, code="busy", detail=str(next(numbers)), agent=robot.address)
                put(decline.signed_by(signer))
            return person.drops.totals().get("declines", 0) > 100

        await until(are_dropped, pause=0.05)
        assert 0 < len(heard) < next(numbers) - 100


async def test_declines_are_limited_for_each_maker(place: Place) -> None:
    drops = Drops()
    demands = [orders.demand(signer=Signer(b"\x05" * 32)) for _ in range(int(PER_MAKER.burst) + 60)]
    async with place.agent("robot") as robot:
        publisher = DeclinePublisher(robot.channel, robot.parts.signer, drops)
        for signed in demands:
            publisher.decline(Verified(signed, secrets.token_bytes(32), place.address("person")), Grounds("busy", ""))
    assert drops.totals()["declines"] >= 4


async def test_only_those_who_demand_subscribe_to_declines(place: Place) -> None:
    """A robot that only offers declares nothing for it."""
    async with (
        place.agent("robot") as robot,
        place.agent("person") as person,
        Network(Endpoints(connect=(place.endpoint,))) as network,
    ):
        lighthouse = person.channel.lighthouse
        order = await person.order(OBJECTIVE)
        await until_heard(network.session, str(DeclineKey(lighthouse, person.address)))
        await until_heard(network.session, str(RejectKey(lighthouse, robot.address)))
        with network.session.declare_publisher(str(DeclineKey(lighthouse, robot.address))) as publisher:
            assert not publisher.matching_status.matching  # type: ignore[attr-defined]
        async with asyncio.timeout(60):
            await order.withdraw()


async def test_a_demand_ends_when_all_robots_of_its_model_have_declined(market: Market) -> None:
    person = await market.person()
    async with market.robot(_declining("dear")) as first, market.robot(_declining("dear")) as second:
        with pytest.raises(DemandDeclined) as caught:
            await market.demand(MODEL, OBJECTIVE, by=person)
        assert {one.agent: one.code for one in caught.value.declines} == {
            first.address: "too-cheap",
            second.address: "too-cheap",
        }
        assert person.orders() == []
        # One that waits stays open.
        kept = asyncio.create_task(person.demand(OBJECTIVE, model=MODEL, cost=1, wait=True))
        await until(lambda: any(len(order._traded.declines) == 2 for order in person.orders()))
        assert not kept.done()
        kept.cancel()
        await asyncio.wait([kept])


async def test_a_demand_goes_on_while_one_robot_has_not_declined(market: Market) -> None:
    async with market.robot(_declining("dear")), market.robot(taking_speeds()) as silent:
        contract = await market.demand(MODEL, [("/go", 1.0)])
        assert contract.robot == silent.address


def _declining(why: str) -> Agent:
    """A robot that finds all too cheap."""
    robot = Agent(MODEL)

    @robot.on_demand
    async def decline(demand: Verified[Demand]) -> None:
        raise Declined("too-cheap", why)

    return robot
