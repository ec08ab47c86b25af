"""What a robot takes by the settings of its owner: price, customers, hours, the length of its queue."""

from __future__ import annotations

import asyncio
from datetime import datetime
from typing import TYPE_CHECKING, Any
from zoneinfo import ZoneInfo

import pytest

from mesh import Agent, AiraError, ConfigurationError, Empty, Progress, Settings
from mesh.agent.contracts import Contract
from mesh.agent.hiring import DemandDeclined
from mesh.amounts import InvalidAmount
from mesh.base.hours import Hours
from mesh.testing import assert_paid
from tests.mesh.agent.conftest import other_token
from tests.support.market import MODEL, offering
from tests.support.raising import raises_with
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from mesh.agent.handlers import Job
    from mesh.agent.trade import Order
    from mesh.testing import Market
    from schemas import Demand, Verified

STRANGER = "0x000000000000000000000000000000000000bEEF"
GO = [("/go", Empty())]


def working(*, parallel: int = 1, **options: Any) -> tuple[Agent, asyncio.Event, list[str]]:
    """A robot that offers for all demands, works on `/go` until the event is set, and lists the jobs that it began."""
    released, begun = asyncio.Event(), list[str]()
    robot = Agent(MODEL, settings=Settings(**options), parallel=parallel)

    @robot.on("/go")
    async def go(job: Job, message: Empty) -> None:
        begun.append(job.liability.address)
        await released.wait()

    return offering(robot), released, begun


async def decline_of(person: Agent, **terms: Any) -> Progress:
    """The first decline of a demand, which is withdrawn then."""
    heard: list[Progress] = []
    demand = asyncio.create_task(person.demand(GO, model=MODEL, on_progress=heard.append, **terms))
    await until(lambda: any(progress.kind == "declined" for progress in heard), seconds=60)
    demand.cancel()
    await asyncio.wait([demand])
    return next(progress for progress in heard if progress.kind == "declined")


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        ({"least_price": "2"}, "price-too-low", "at least 2 XRT"),
        ({"accept": (STRANGER,)}, "not-accepted", "certain customers"),
        ({"refuse": ("person",)}, "refused", "this customer"),
        ({"hours": ("Mon-Sun 00:00-00:01 UTC", "Mon-Sun 00:01-00:02 UTC")}, "outside-hours", "00:00-00:01 UTC"),
    ],
)
async def test_a_demand_that_the_owner_excludes_is_declined_before_the_handlers(
    market: Market, options: dict[str, Any], code: str, said: str
) -> None:
    person, seen = await market.person(), list[object]()
    if "refuse" in options:
        options = {"refuse": (person.address,)}
    robot, _, _ = working(**options)
    robot.on_demand(seen.append)
    async with market.robot(robot):
        progress = await decline_of(person, cost=10**9)
        assert (progress.agent, progress.code) == (robot.address, code)
        assert said in progress.detail
        assert seen == []


@pytest.mark.parametrize(("hours", "state"), [("00:00-24:00 UTC", "idle"), ("Mon 00:00-00:01 UTC", "closed")])
async def test_the_profile_says_whether_the_robot_is_closed(market: Market, hours: str, state: str) -> None:
    async with market.robot(working(hours=(hours,))[0]) as robot:

        async def says_so() -> bool:
            return (await robot.runtime.profile.present()).state == state

        await until_found(says_so, what=state)


async def test_a_quote_and_an_order_for_this_robot_alone_follow_the_same_rules(market: Market) -> None:
    person = await market.person()
    robot, _, _ = working(refuse=(person.address,))
    robot.on_quote(lambda request: "3")
    async with market.robot(robot):
        (quote,) = await person.quotes(MODEL, GO, timeout=20)
        assert (quote.agent, quote.code) == (robot.address, "refused")
        with pytest.raises(AiraError, match="refused"):
            await market.demand(robot, GO, by=person)


async def test_who_is_accepted_and_pays_enough_is_served(market: Market) -> None:
    person = await market.person()
    terms: dict[str, Any] = {"accept": (person.address,), "refuse": (STRANGER,), "least_price": "2"}
    robot, released, _ = working(hours=("00:00-24:00",), queue_limit=1, **terms)
    released.set()
    async with market.robot(robot):
        assert_paid(await market.order(MODEL, GO, by=person, cost="2"))


@pytest.mark.parametrize(("options", "code"), [({"least_price": "2"}, "price-too-low"), ({}, "other-token")])
async def test_any_amount_of_a_token_that_the_robot_is_not_paid_in_is_declined(
    market: Market, options: dict[str, Any], code: str
) -> None:
    person = await market.person()
    token = await other_token(person.chain, supply=10**18)
    async with market.robot(working(**options)[0]):
        declined = await decline_of(person, cost=10**18, token=token)
        assert (declined.code, "XRT" in declined.detail) == (code, True)


async def test_a_full_queue_takes_the_next_job_when_one_has_ended(market: Market) -> None:
    robot, released, begun = working(queue_limit=1)
    person = await market.person()
    async with market.robot(robot):
        first = await market.demand(MODEL, GO, by=person)
        await until(lambda: begun == [first.address], seconds=30)
        heard: list[Progress] = []
        second = asyncio.create_task(person.demand(GO, model=MODEL, cost=1, wait=True, on_progress=heard.append))
        await until(lambda: any(progress.code == "queue-full" for progress in heard), seconds=30)
        released.set()
        assert (await first.outcome()).success
        assert (await (await second).outcome()).success


async def test_a_burst_of_demands_never_gets_more_contracts_than_the_queue_has_places(market: Market) -> None:
    robot, released, _ = working(queue_limit=2)
    most = 0
    person = await market.person()
    async with market.robot(robot):
        orders: list[Order] = [await person.order(GO, model=MODEL, cost=number) for number in range(1, 7)]
        contracts = [asyncio.create_task(order.contract()) for order in orders]
        await until(lambda: sum(task.done() for task in contracts) == 2, seconds=60)
        for _ in range(40):  # every order is sent again meanwhile
            jobs, offers = len(robot.runtime.executor.at_hand), len(robot.runtime.trader.answers)
            most = max(most, jobs + offers)
            await asyncio.sleep(0.05)
        assert (most, sum(task.done() for task in contracts)) == (2, 2)
        released.set()
        for contract in await asyncio.gather(*contracts):
            assert (await contract.outcome()).success
        assert robot.runtime.executor.at_hand == set()


async def test_two_people_who_want_this_robot_alone_never_get_more_contracts_than_the_queue_has_places(
    market: Market,
) -> None:
    """Both find a place when the robot is asked, and one of them none when it makes its offer."""
    robot, asked = Agent(MODEL, settings=Settings(queue_limit=1)), asyncio.Barrier(2)

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await asked.wait()
        await robot.offer(demand)

    @robot.on("/go")
    async def go(job: Job, message: Empty) -> None: ...

    async with market.robot(robot):
        wanted = [market.demand(robot, GO, by=await market.person(), cost=1) for _ in range(2)]
        found = await asyncio.gather(*wanted, return_exceptions=True)
        (declined,) = [one for one in found if isinstance(one, DemandDeclined)]
        (contract,) = [one for one in found if isinstance(one, Contract)]
        assert [one.code for one in declined.declines] == ["queue-full"]
        assert (await contract.outcome()).success


@pytest.mark.parametrize("parallel", [1, 2])
async def test_jobs_run_one_after_the_other_or_as_many_at_once_as_the_robot_can(market: Market, parallel: int) -> None:
    robot, released, begun = working(parallel=parallel)
    async with market.robot(robot):
        contracts = [await market.demand(MODEL, GO, cost=number) for number in range(3)]
        await until(lambda: len(begun) == parallel, seconds=30)

        await until(lambda: len(robot.runtime.executor.at_hand) == 3, seconds=30)
        await until(lambda: not robot.runtime.executor.preparing, seconds=30)
        assert len(begun) == parallel
        released.set()
        outcomes = [await contract.outcome() for contract in contracts]
        assert [outcome.success for outcome in outcomes] == [True] * 3
        assert sorted(begun) == sorted(contract.address for contract in contracts)


@pytest.mark.parametrize(
    ("hours", "at", "expected"),
    [
        ("08:00-18:00 UTC", "2026-11-28 08:00", True),
        ("08:00-18:00 UTC", "2026-11-28 18:00", False),
        ("Mon-Fri 08:00-18:00 UTC", "2026-11-28 12:00", False),  # a Saturday
        ("Sat 00:00-24:00 UTC", "2026-11-28 23:59", True),
        ("Fri 22:00-06:00 UTC", "2026-11-28 05:59", True),
        ("Fri 22:00-06:00 UTC", "2026-11-28 06:00", False),
        ("Fri 22:00-06:00 UTC", "2026-11-28 22:30", False),
        ("Sat-Mon 10:00-11:00 UTC", "2026-11-30 10:30", True),
        ("Sat-Mon 10:00-11:00 UTC", "2026-12-01 10:30", False),
        ("08:00-09:00 Europe/Berlin", "2026-11-28 07:30", True),
        ("08:00-09:00 Europe/Berlin", "2026-07-28 06:30", True),  # in summer
    ],
)
def test_hours_are_those_of_their_zone_and_of_the_day_on_which_they_begin(hours: str, at: str, expected: bool) -> None:
    moment = datetime.fromisoformat(at).replace(tzinfo=ZoneInfo("UTC")).timestamp()
    assert Hours.parse(hours).contain(moment) is expected


@pytest.mark.parametrize(
    ("hours", "why"),
    [
        ("8-18", "it is not like"),
        ("08:00-08:00", "it ends when it begins"),
        ("Mon-Fre 08:00-18:00", "a day is one of"),
        ("08:61-09:00", "08:61 is not a time"),
        ("25:00-26:00", "25:00 is not a time"),
        ("08:00-09:00 Mars/Base", "no time zone Mars/Base"),
    ],
)
def test_hours_that_make_no_sense_are_refused(hours: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        Hours.parse(hours)


@pytest.mark.parametrize("options", [{"hours": ("always",)}, {"refuse": ("0x12",)}, {"accept": ("me",)}])
async def test_settings_that_can_not_be_read_stop_the_agent_with_their_name(market: Market, options: Any) -> None:
    with raises_with(ConfigurationError, code="invalid-option", match=next(iter(options))):
        async with market.robot(working(**options)[0]):
            pass


async def test_a_least_price_that_is_no_amount_stops_the_agent(market: Market) -> None:
    with pytest.raises(InvalidAmount):
        async with market.robot(working(least_price="a lot")[0]):
            pass


@pytest.mark.parametrize("parallel", [0, -1, 1.5])
def test_the_number_of_parallel_jobs_is_checked(parallel: Any) -> None:
    with pytest.raises(ConfigurationError) as caught:
        Agent(MODEL, parallel=parallel)
    assert caught.value.code == "invalid-parallel"
