"""Second chances: a job that failed is ordered again from another robot, once its cost has come back."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh import Agent, JobFailed, Settings
from mesh.agent.orders import ORDER_LIFETIME
from mesh.errors import InputError
from tests.support.agent.trades import JOB, known
from tests.support.market import MODEL
from tests.support.raising import raises_with
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from mesh.agent.contracts import Progress
    from mesh.agent.handlers import Job
    from mesh.testing import Market
    from schemas import Demand, Verified
    from schemas.rpc import QuoteRequest

CHEAP, DEAR = 30, 80
CHEAPEST: dict[str, Any] = {"cost": DEAR, "robot": "cheapest", "retry": 2}
"""The terms of an order from the cheapest robot, and from others after it."""


async def at_once() -> None:
    """Think no longer."""


def priced(cost: int, work: Callable[[Job], Any], think: Callable[[], Any] = at_once) -> Agent:
    """A robot that wants `cost` for every job."""
    robot = Agent(MODEL)

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
async def two_robots(
    market: Market, cheap: Callable[[Job], Any], dear: Callable[[Job], Any], think: Callable[[], Any] = at_once
) -> AsyncIterator[tuple[Agent, Agent, Agent]]:
    """A person, and a cheap and a dear robot with this work; the dear one thinks before it quotes."""
    person = await market.person()
    async with (
        market.robot(priced(CHEAP, cheap)) as one,
        market.robot(priced(DEAR, dear, think)) as other,
        asyncio.timeout(90),
    ):
        yield person, one, other


async def test_the_other_robot_does_what_the_cheaper_one_gave_back(market: Market) -> None:
    seen: list[Progress] = []
    async with two_robots(market, battery_low, done) as (person, cheap, dear):
        before = await market.balance(person)
        contract = await person.demand(JOB, model=MODEL, **CHEAPEST)
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
        assert before - await market.balance(person) == DEAR
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


async def test_an_open_demand_gets_a_second_chance_and_nobody_has_two(market: Market) -> None:
    seen: list[Progress] = []
    async with two_robots(market, battery_low, battery_low) as (person, cheap, dear):
        before = await market.balance(person)
        contract = await person.demand(JOB, model=MODEL, cost=DEAR, retry=9)
        waiting = asyncio.create_task(contract.outcome(on_progress=seen.append))
        outcome = await contract.outcome()
        assert await waiting == outcome  # who waits twice sees one end
        assert not outcome.success
        assert {one.robot for one in (*outcome.earlier, outcome)} == {cheap.address, dear.address}
        assert len(outcome.earlier) == 1
        assert await market.balance(person) == before
        assert person.orders() == []
    assert [(one.kind, one.code) for one in seen if one.kind in ("again", "given-up")] == [
        ("again", "battery-low"),
        ("given-up", "no-robot-fits"),
    ]


async def test_a_default_lifetime_above_the_limit_allows_another_attempt(market: Market) -> None:
    modest = Agent(settings=Settings(deadline_limit=ORDER_LIFETIME.fewest // 2))
    async with two_robots(market, battery_low, done) as (_, _, dear), market.robot(modest):
        outcome = await market.order(MODEL, JOB, by=modest, **CHEAPEST)
        assert (outcome.success, outcome.robot) == (True, dear.address)


async def test_a_job_that_its_customer_stops_is_not_ordered_again(market: Market) -> None:
    begun = asyncio.Event()

    async def stuck(job: Job) -> None:
        begun.set()
        await asyncio.Event().wait()

    async with two_robots(market, stuck, done) as (person, cheap, _):
        contract = await person.demand(JOB, model=MODEL, **CHEAPEST)
        await begun.wait()
        await contract.stop("changed my mind")
        outcome = await contract.outcome()
        assert (outcome.code, outcome.robot, outcome.earlier) == ("stopped", cheap.address, ())
        assert person.orders() == []


async def test_a_job_that_is_stopped_while_other_robots_are_asked_is_not_ordered_again(market: Market) -> None:
    thoughts: list[None] = []
    asked = asyncio.Event()

    async def think() -> None:
        thoughts.append(None)
        if len(thoughts) == 2:
            asked.set()
            await asyncio.sleep(1)

    async with two_robots(market, battery_low, done, think) as (person, cheap, dear):
        contract = await person.demand(JOB, model=MODEL, **CHEAPEST)
        await asked.wait()
        assert (await contract.stop("changed my mind")).devices == ()
        outcome = await contract.outcome()
        assert (outcome.success, outcome.robot, outcome.code) == (False, cheap.address, "battery-low")
        assert (person.orders(), await dear.parts.ledger.jobs()) == ([], [])


async def test_a_job_that_is_stopped_while_its_next_order_is_open_is_not_paid(market: Market) -> None:
    async def stuck(job: Job) -> None:
        await asyncio.Event().wait()

    stopping: list[asyncio.Task[Any]] = []
    async with two_robots(market, battery_low, stuck) as (person, _, _dear):
        before = await market.balance(person)
        contract = await person.demand(JOB, model=MODEL, **CHEAPEST)

        def stop(seen: Progress) -> None:
            if seen.kind == "again":
                stopping.append(asyncio.create_task(contract.stop("changed my mind")))

        outcome = await contract.outcome(on_progress=stop)
        assert not outcome.success
        await asyncio.gather(*stopping)
        assert await market.balance(person) == before
        assert person.orders() == []


async def test_a_contract_that_is_read_after_its_order_was_called_off_is_stopped(
    market: Market, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, may_read = asyncio.Event(), asyncio.Event()

    async def stuck(job: Job) -> None:
        begun.set()
        await asyncio.Event().wait()

    async with two_robots(market, battery_low, stuck) as (person, _, _dear):
        before, trader = await market.balance(person), person.runtime.trader
        contract = await person.demand(JOB, model=MODEL, **CHEAPEST)
        read = trader.matched

        async def read_later(*given: Any, **named: Any) -> None:
            await may_read.wait()
            await read(*given, **named)

        monkeypatch.setattr(trader, "matched", read_later)
        await begun.wait()  # its contract is on the chain
        assert (await contract.stop("changed my mind")).devices == ()
        assert not (await contract.outcome()).success
        assert await market.balance(person) == before - DEAR
        may_read.set()

        async def is_refunded() -> bool:
            return await market.balance(person) == before

        await until_found(is_refunded, what="the refund, which no block without a stop brings")


async def test_a_robot_that_does_not_begin_in_time_is_called_off(market: Market) -> None:
    seen: list[Progress] = []
    begun: list[str] = []

    async def stuck(job: Job) -> None:
        begun.append(job.liability.address)
        await asyncio.Event().wait()

    async with two_robots(market, stuck, done) as (person, cheap, dear):
        busy = await person.demand(JOB, model=MODEL, cost=CHEAP, robot=cheap.address)
        await until(lambda: begun == [busy.address])
        contract = await person.demand(JOB, model=MODEL, **CHEAPEST, start_within=2)
        first = contract.address
        await known(cheap, first)
        outcome = await contract.outcome(on_progress=seen.append)
        assert (outcome.success, outcome.robot) == (True, dear.address)
        assert [(one.contract, one.code) for one in outcome.earlier] == [(first, "stopped")]
        assert [(one.agent, one.detail) for one in seen if one.kind == "late"] == [(cheap.address, "2")]
        assert begun == [busy.address]
        await busy.stop()
        assert (await busy.outcome()).code == "stopped"


async def test_a_robot_that_begins_in_time_may_work_longer(market: Market) -> None:
    async def slow(job: Job) -> None:
        await asyncio.sleep(3)

    async with two_robots(market, slow, done) as (person, cheap, _):
        contract = await person.demand(JOB, model=MODEL, **CHEAPEST, start_within=2)
        outcome = await contract.outcome()
        assert (outcome.success, outcome.robot) == (True, cheap.address)


async def test_there_is_no_attempt_after_the_first_orders_deadline(market: Market) -> None:
    seen: list[Progress] = []

    async def fail_late(job: Job) -> None:
        await market.mine(40)
        raise JobFailed("battery low", code="battery-low")

    async with two_robots(market, fail_late, done) as (person, cheap, _):
        contract = await person.demand(JOB, model=MODEL, **CHEAPEST, lifetime=30)
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
    market: Market, terms: dict[str, Any], code: str
) -> None:
    person = await market.person()
    with raises_with(InputError, code=code):
        await person.order(JOB, model=MODEL, cost=1, **terms)
    assert person.orders() == []
