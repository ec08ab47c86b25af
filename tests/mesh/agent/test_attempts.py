"""Second chances: a job that failed is ordered again from another robot, once its cost has come back."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh import JobFailed
from mesh.agent.orders import FEWEST_BLOCKS
from mesh.errors import InputError
from tests.mesh.agent.trades import job, known
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from mesh import Agent
    from mesh.agent.contracts import Progress
    from mesh.agent.handlers import Job
    from schemas import Demand, Verified
    from schemas.rpc import QuoteRequest
    from tests.support.market import Place

CHEAP, DEAR = 30, 80


async def at_once() -> None:
    """Think no longer."""


def priced(robot: Agent, cost: int, work: Callable[[Job], Any], think: Callable[[], Any] = at_once) -> Agent:
    """The same robot, which wants `cost` for every job."""

    @robot.on_quote
    async def quote(request: QuoteRequest) -> int:
        await think()
        return cost

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        if demand.message.cost >= cost:
            await robot.offer(demand)

    @robot.on("*")
    async def do(job: Job, message: object) -> None:
        await work(job)

    return robot


async def done(job: Job) -> None:
    """The work succeeds."""


async def battery_low(job: Job) -> None:
    raise JobFailed("battery low", code="battery-low")


@asynccontextmanager
async def market(
    place: Place,
    cheap: Callable[[Job], Any],
    dear: Callable[[Job], Any],
    think: Callable[[], Any] = at_once,
    **options: Any,
) -> AsyncIterator[list[Agent]]:
    """A provider, a person, and a cheap and a dear robot with this work; the dear one thinks before it quotes.

    `options` are settings of the person.
    """
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(place.provider())
        robots = [priced(place.agent("robot"), CHEAP, cheap), await stack.enter_async_context(place.another(5))]
        priced(robots[1], DEAR, dear, think)
        for robot in (*robots, person := place.agent("person", **options)):
            await stack.enter_async_context(robot)
        await stack.enter_async_context(asyncio.timeout(90))
        yield [person, *robots]


@pytest.mark.parametrize("generation", [3, 5])
async def test_the_other_robot_does_what_the_cheaper_one_gave_back(place: Place, generation: int) -> None:
    seen: list[Progress] = []
    async with market(place, battery_low, done) as (person, cheap, dear):
        before = await place.balance("person")
        contract = await person.demand(job(place), cost=DEAR, robot="cheapest", retry=2)
        number, first = contract.number, contract.address
        assert contract.robot == cheap.address
        outcome = await contract.outcome(on_progress=seen.append)
        assert (outcome.success, outcome.robot, outcome.contract) == (True, dear.address, contract.address)
        assert [(one.contract, one.robot, one.code) for one in outcome.earlier] == [
            (first, cheap.address, "battery-low")
        ]
        assert (contract.number, contract.robot) == (number, dear.address)
        assert contract.address != first
        assert (await contract.recording()).is_file()
        assert before - await place.balance("person") == DEAR
        assert len(await person.parts.ledger.contracts("demand")) == 2
        names = cheap.address, dear.address
    ends = [(one.kind, one.agent, one.code) for one in seen if one.kind in ("refunded", "again", "contract", "paid")]
    assert ends == [
        ("refunded", names[0], "battery-low"),
        ("again", names[0], "battery-low"),
        ("contract", names[1], ""),
        ("paid", names[1], ""),
    ]
    assert [(one.position, one.total) for one in seen if one.kind == "again"] == [(2, 3)]


async def test_an_open_demand_gets_a_second_chance_and_nobody_has_two(place: Place) -> None:
    seen: list[Progress] = []
    async with market(place, battery_low, battery_low) as (person, cheap, dear):
        before = await place.balance("person")
        contract = await person.demand(job(place), cost=DEAR, retry=9)
        waiting = asyncio.create_task(contract.outcome(on_progress=seen.append))
        outcome = await contract.outcome()
        assert await waiting == outcome  # who waits twice sees one end
        assert not outcome.success
        assert {one.robot for one in (*outcome.earlier, outcome)} == {cheap.address, dear.address}
        assert len(outcome.earlier) == 1
        assert await place.balance("person") == before
        assert person.orders() == []
    assert [(one.kind, one.code) for one in seen if one.kind in ("again", "given-up")] == [
        ("again", "battery-low"),
        ("given-up", "no-robot-fits"),
    ]


async def test_a_default_lifetime_above_the_limit_allows_another_attempt(place: Place) -> None:
    async with market(place, battery_low, done, deadline_limit=FEWEST_BLOCKS // 2) as (person, _, dear):
        contract = await person.demand(job(place), cost=DEAR, robot="cheapest", retry=1)
        outcome = await contract.outcome()
        assert (outcome.success, outcome.robot) == (True, dear.address)


async def test_a_job_that_its_customer_stops_is_not_ordered_again(place: Place) -> None:
    begun = asyncio.Event()

    async def stuck(job: Job) -> None:
        begun.set()
        await asyncio.Event().wait()

    async with market(place, stuck, done) as (person, cheap, _):
        contract = await person.demand(job(place), cost=DEAR, robot="cheapest", retry=2)
        await begun.wait()
        await contract.stop("changed my mind")
        outcome = await contract.outcome()
        assert (outcome.code, outcome.robot, outcome.earlier) == ("stopped", cheap.address, ())
        assert person.orders() == []


async def test_a_job_that_is_stopped_while_other_robots_are_asked_is_not_ordered_again(place: Place) -> None:
    thoughts: list[None] = []
    asked = asyncio.Event()

    async def think() -> None:
        thoughts.append(None)
        if len(thoughts) == 2:
            asked.set()
            await asyncio.sleep(1)

    async with market(place, battery_low, done, think) as (person, cheap, dear):
        contract = await person.demand(job(place), cost=DEAR, robot="cheapest", retry=2)
        await asked.wait()
        assert (await contract.stop("changed my mind")).devices == ()
        outcome = await contract.outcome()
        assert (outcome.success, outcome.robot, outcome.code) == (False, cheap.address, "battery-low")
        assert (person.orders(), await dear.parts.ledger.jobs()) == ([], [])


async def test_a_job_that_is_stopped_while_its_next_order_is_open_is_not_paid(place: Place) -> None:
    async def stuck(job: Job) -> None:
        await asyncio.Event().wait()

    stopping: list[asyncio.Task[Any]] = []
    async with market(place, battery_low, stuck) as (person, _, _dear):
        before = await place.balance("person")
        contract = await person.demand(job(place), cost=DEAR, robot="cheapest", retry=2)

        def stop(seen: Progress) -> None:
            if seen.kind == "again":
                stopping.append(asyncio.create_task(contract.stop("changed my mind")))

        outcome = await contract.outcome(on_progress=stop)
        assert not outcome.success
        await asyncio.gather(*stopping)
        assert await place.balance("person") == before
        assert person.orders() == []


async def test_a_robot_that_does_not_begin_in_time_is_called_off(place: Place) -> None:
    seen: list[Progress] = []
    begun: list[str] = []

    async def stuck(job: Job) -> None:
        begun.append(job.liability.address)
        await asyncio.Event().wait()

    async with market(place, stuck, done) as (person, cheap, dear):
        busy = await person.demand(job(place), cost=CHEAP, robot=cheap.address)
        await until(lambda: begun == [busy.address])
        contract = await person.demand(job(place), cost=DEAR, robot="cheapest", retry=1, start_within=2)
        first = contract.address
        await known(cheap, first)
        outcome = await contract.outcome(on_progress=seen.append)
        assert (outcome.success, outcome.robot) == (True, dear.address)
        assert [(one.contract, one.code) for one in outcome.earlier] == [(first, "stopped")]
        assert [(one.agent, one.detail) for one in seen if one.kind == "late"] == [(cheap.address, "2")]
        assert begun == [busy.address]
        await busy.stop()
        assert (await busy.outcome()).code == "stopped"


async def test_a_robot_that_begins_in_time_may_work_longer(place: Place) -> None:
    async def slow(job: Job) -> None:
        await asyncio.sleep(3)

    async with market(place, slow, done) as (person, cheap, _):
        contract = await person.demand(job(place), cost=DEAR, robot="cheapest", retry=1, start_within=2)
        outcome = await contract.outcome()
        assert (outcome.success, outcome.robot) == (True, cheap.address)


async def test_there_is_no_attempt_after_the_first_orders_deadline(place: Place) -> None:
    seen: list[Progress] = []

    async def fail_late(job: Job) -> None:
        await place.chains["person"].node.request("evm_mine", 40)
        raise JobFailed("battery low", code="battery-low")

    async with market(place, fail_late, done) as (person, cheap, _):
        contract = await person.demand(job(place), cost=DEAR, robot="cheapest", retry=1, lifetime=30)
        outcome = await contract.outcome(on_progress=seen.append)
        assert (outcome.success, outcome.robot) == (False, cheap.address)
    assert [one.code for one in seen if one.kind == "given-up"] == ["order-expired"]


@pytest.mark.parametrize(
    ("terms", "code"),
    [
        ({"retry": 11}, "invalid-retry"),
        ({"retry": -1}, "invalid-retry"),
        ({"retry": 1, "robot": "Lifter"}, "invalid-retry"),
        ({"start_within": 0}, "invalid-start-within"),
        ({"start_within": float("nan")}, "invalid-start-within"),
    ],
)
async def test_attempts_that_can_not_be_are_refused_before_anything_is_sent(
    place: Place, terms: dict[str, Any], code: str
) -> None:
    async with place.agent("person") as person:
        with pytest.raises(InputError) as caught:
            await person.order(job(place), cost=1, **terms)
        assert caught.value.code == code
        assert person.orders() == []
