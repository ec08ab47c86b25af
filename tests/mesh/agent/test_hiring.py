"""Orders for one robot alone: who gets the job, what others see of it, and what strangers can do with it."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.handlers import Declined
from mesh.agent.hiring import DemandDeclined
from mesh.agent.orders import OtherRobot
from mesh.errors import InputError, RemoteError
from mesh.network import Channel, Endpoints, Network, ServiceFailed, Services
from schemas import Demand, Offer
from schemas.rpc import Accepted, SendOffer
from tests.support.agent.trades import job, working
from tests.support.market import Place, offering
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh import Agent
    from mesh.agent.handlers import Job
    from schemas import Verified
    from schemas.rpc import AcceptDemand

GENERATIONS = pytest.mark.parametrize("generation", [3, 5])


@asynccontextmanager
async def listening(place: Place) -> AsyncIterator[list[Verified[Any]]]:
    """The demands and offers that anybody on the router can see."""
    heard: list[Verified[Any]] = []

    async def listen(orders: Any) -> None:
        async for order in orders:
            heard.append(order)

    async with (
        Network(Endpoints(connect=(place.endpoint,))) as network,
        Channel(network.session, place.market.deployment.lighthouse_name) as channel,
        channel.subscribe(Demand) as demands,
        channel.subscribe(Offer) as offers,
    ):
        tasks = [asyncio.create_task(listen(one)) for one in (demands, offers)]
        yield heard
        for task in tasks:
            task.cancel()


@pytest.mark.sample("generation")
@GENERATIONS
async def test_only_the_robot_that_was_named_gets_the_job_and_its_pay(place: Place, generation: int) -> None:
    before = await place.balance("robot")
    async with (
        place.provider() as provider,
        place.another(5) as rival,
        working(rival),
        working(place.agent("robot")) as robot,
        place.agent("person", generation=generation) as person,
        listening(place) as heard,
        asyncio.timeout(60),
    ):
        for cost in (21, 300):
            contract = await person.demand(job(place), cost=cost, robot=robot.address)
            assert contract.robot == contract.liability.promisor == robot.address
            outcome = await contract.outcome()
            assert (outcome.success, outcome.robot) == (True, robot.address)
        assert await rival.parts.ledger.jobs() == []
        assert heard == []  # nobody else has seen a demand or an offer
        assert provider.drops.totals() == {}
        # An order for all is published as before.
        open_to_all = await person.demand(job(place), cost=1)
        assert (await open_to_all.outcome()).success
        await until(lambda: {one.message.kind for one in heard} == {"demand", "offer"})
    assert await place.balance("robot") - before in (321, 322)


async def test_a_robot_is_hired_by_two_people_at_once(place: Place) -> None:
    """In generation 5 its offers have the same nonce: the second person gets one that was signed again."""
    people = [place.agent(role, generation=5) for role in ("person", "provider")]
    async with place.provider(), working(place.agent("robot")) as robot, people[0], people[1], asyncio.timeout(60):
        contracts = await asyncio.gather(
            *(one.demand(job(place), cost=cost, robot=robot.address) for one, cost in zip(people, (6, 7), strict=True))
        )
        assert [(await contract.outcome()).success for contract in contracts] == [True, True]


async def test_a_robot_that_declines_says_why_and_nothing_stays_open(place: Place) -> None:
    robot = place.agent("robot")

    @robot.on_demand
    async def price(demand: Verified[Demand]) -> None:
        if demand.message.cost < 50:
            raise Declined("too-cheap", "50 wn at least")
        await robot.offer(demand)

    async with place.provider(), robot, place.agent("person") as person, listening(place) as heard:
        allowed = await place.chains["person"].tokens.allowance(person.address, person.chain.factory)
        with pytest.raises(DemandDeclined, match="50 wn at least") as caught:
            await person.demand(job(place), cost=49, robot=robot.address)
        assert [(one.agent, one.code) for one in caught.value.declines] == [(robot.address, "too-cheap")]
        assert person.orders() == []
        assert await place.chains["person"].tokens.allowance(person.address, person.chain.factory) == allowed
        assert heard == []


async def test_a_robot_that_asks_for_other_terms_is_quoted(place: Place) -> None:
    robot = place.agent("robot")

    @robot.on_demand
    async def counter(demand: Verified[Demand]) -> None:
        await robot.offer(objective=demand.message.objective, cost=77)

    async with robot, place.agent("person") as person, listening(place) as heard:
        with pytest.raises(DemandDeclined, match="77"):
            await person.order(job(place), cost=5, robot=robot.address)
        assert robot.orders() == []
        assert heard == []


async def test_a_robot_is_named_by_its_name(place: Place) -> None:
    robot = working(place.agent("robot", name="Lifter"))
    async with place.provider(), robot, place.agent("person") as person, asyncio.timeout(60):
        assert (await person.demand(job(place), cost=2, robot="lifter")).robot == robot.address
        with pytest.raises(InputError, match="Loader") as caught:
            await person.order(job(place), cost=2, robot="Loader")
        assert caught.value.code == "robot-unknown"


async def test_who_is_not_there_is_an_error_at_once(place: Place, person: Agent) -> None:
    with pytest.raises(ServiceFailed, match="does not answer"):
        await person.order(job(place), robot=place.address("robot"))


async def test_a_restarted_person_gets_the_robot_that_was_named(place: Place) -> None:
    async with working(place.agent("robot")) as robot, listening(place) as heard:
        async with place.agent("person") as person:
            order = await person.order(job(place), cost=4, robot=robot.address)
        async with place.provider(), place.agent("person") as person, asyncio.timeout(60):
            contract = await until_found(lambda: _contract(person, order.hash), what="the contract")
            assert contract == robot.address
        assert heard == []


async def _contract(person: Agent, order: str) -> str | None:
    for payload, address in await person.parts.ledger.contracts("demand"):
        if payload:
            return (await person.contract(address)).robot
    return None


async def test_a_restarted_robot_is_asked_again(place: Place, person: Agent) -> None:
    async with working(place.agent("robot")) as robot:
        order = await person.order(job(place), cost=4, robot=robot.address)
    async with place.provider(), working(place.agent("robot")), asyncio.timeout(60):
        contract = await order.contract()
        assert contract.robot == place.address("robot")
        assert (await contract.outcome()).success


async def test_an_offer_of_another_robot_is_not_taken(place: Place) -> None:
    """Somebody else answers on the robot's key."""
    thief = place.market.accounts["provider"].signer

    async def accept(request: AcceptDemand) -> Accepted:
        demand: Any = request.demand.message()
        assert not demand.signature  # there is nothing to steal
        terms = {name: getattr(demand, name) for name in ("model", "objective", "token", "cost", "lighthouse")}
        offer = Offer(
            **terms, validator=demand.validator, deadline=demand.deadline, nonce=demand.nonce, lighthouse_fee=0
        )
        return Accepted(offer=SendOffer.of(thief.sign(offer)))

    async with (
        Network(Endpoints(connect=(place.endpoint,))) as network,
        Services(network.session, place.address("robot")) as services,
        place.agent("person") as person,
    ):
        services.offer("accept", accept)
        with pytest.raises(RemoteError, match="neither its offer nor its refusal") as caught:
            await person.order(job(place), cost=5, robot=place.address("robot"))
        assert caught.value.code == "not-its-answer"
        assert person.orders() == []


async def test_a_person_is_told_when_a_provider_gave_the_job_to_another_robot(place: Place) -> None:
    """A provider with the signed pair can do that; the demand can't name the robot."""
    lighthouse = place.market.deployment.lighthouse
    async with (
        place.another(5) as rival,
        offering(rival),
        working(place.agent("robot")) as robot,
        place.agent("person") as person,
        asyncio.timeout(60),
    ):
        order = await person.order(job(place), cost=5, robot=robot.address)
        demand = order.message
        assert isinstance(demand, Demand)
        terms = rival.runtime.trader.writer.terms_of(demand)
        offer = await rival.runtime.trader.writer.sign(Offer, terms, lighthouse_fee=0)
        assert isinstance(offer, Offer)
        made = await place.chains["provider"].liabilities.create(lighthouse, demand, offer)
        with pytest.raises(OtherRobot) as caught:
            await order.contract()
        assert (caught.value.promisor, caught.value.liability) == (rival.address, made.liability)
        assert (await person.contract(made.liability)).robot == rival.address


async def test_an_order_whose_nonce_another_program_uses_meanwhile_is_signed_again(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two programs of an account that order at once, in generation 5, take the same nonce."""
    robot, person = place.agent("robot"), place.agent("person", generation=5)
    async with place.provider(), working(robot), person, asyncio.timeout(60):
        trader = person.runtime.trader
        asked: list[int] = []
        agree = trader.hiring.agree

        async def overtaken(demand: Demand, address: str) -> None:
            if not asked:
                other = await trader.writer.sign_again(demand)
                assert other.nonce == demand.nonce
                await person.parts.chain.liabilities.withdraw(other)  # uses the nonce up
            asked.append(int(demand.nonce))
            await agree(demand, address)

        monkeypatch.setattr(trader.hiring, "agree", overtaken)
        contract = await person.demand(job(place), cost=4, robot=robot.address)
        assert asked == [asked[0], asked[0] + 1]
        assert (await contract.outcome()).success


async def test_a_job_that_its_robot_has_already_is_not_declined(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """A person who reads the chain later than the robot sends the order again, also when the robot is full."""
    released, robot = asyncio.Event(), place.agent("robot", queue_limit=1)

    @robot.on("*")
    async def go(job: Job, message: Any) -> None:
        await released.wait()

    async with place.provider(), offering(robot), place.agent("person") as person, asyncio.timeout(60):
        order = await person.order(job(place), cost=4, robot=robot.address)
        contract, hiring = await order.contract(), person.runtime.trader.hiring
        assert isinstance(order.message, Demand)
        await until(lambda: contract.address in robot.runtime.executor.at_hand)
        with pytest.raises(DemandDeclined, match="demand-taken"):
            await hiring._offer_of(order.message, robot.address)
        declined: list[object] = []
        monkeypatch.setattr(hiring, "_declined", declined.append)
        await hiring._send(order.hash, order.message, robot.address)
        assert declined == []
        released.set()
        assert (await contract.outcome()).success
