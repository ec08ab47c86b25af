"""Offers that nothing is left for: those of a robot that declines, that is off, or whose demand another robot has."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh import AiraError
from mesh.agent.handlers import Declined
from mesh.agent.ledger import Outgoing
from mesh.agent.orders import EQUAL_DECLINED, OrderState
from mesh.chain import Account, Timing
from schemas import Demand, Liability, Offer, Withdrawal, checksum_address, decode, message_hash
from tests.support import orders
from tests.support.agent.trades import OBJECTIVE, job, unsettled
from tests.support.market import MODEL
from tests.support.raising import raises_with
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from mesh.agent.agent import Agent
    from mesh.agent.handlers import Job
    from mesh.agent.trade import Order
    from mesh.market.provider import Provider
    from schemas import Verified
    from tests.support.market import Place

GENERATIONS = pytest.mark.parametrize("generation", [3, 5])


class Robot:
    """A robot whose handler offers for a demand unless `declines` says why not."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self.declines: dict[str, str] = {}
        """Reasons by maker; `*` for all others."""
        self.seen: list[str] = []
        """The demands that the handler has decided on."""
        self.waits = asyncio.Event()
        """While it is not set, the handler waits before it offers."""
        self.waits.set()

        @agent.on("*")
        async def nothing(job: Job, message: object) -> None:
            pass

        @agent.on_demand
        async def decide(demand: Verified[Demand]) -> None:
            self.seen.append(demand.hash.hex())
            if reason := self.declines.get(demand.signer, self.declines.get("*", "")):
                raise Declined(reason)
            await self.waits.wait()
            await agent.offer(demand)

    @property
    def offers(self) -> list[Order]:
        return self.agent.orders()


async def offers_in(provider: Provider) -> list[Offer]:
    return [order.message for order in provider.book.orders() if isinstance(order.message, Offer)]


async def withdrawals(agent: Agent) -> list[str]:
    """The orders whose withdrawals an agent sends."""
    found = [decode(one.payload) for one in await unsettled(agent)]
    return [message.order for message in found if isinstance(message, Withdrawal)]


@pytest.mark.sample("generation")
@GENERATIONS
async def test_the_offer_of_a_robot_that_another_one_beat_is_withdrawn(place: Place, generation: int) -> None:
    async with place.provider() as provider, place.another(4) as second:
        robots = [Robot(place.agent("robot")), Robot(second)]
        async with robots[0].agent, robots[1].agent, place.agent("person", generation=generation) as person:
            order = await person.order(job(place), cost=1)
            contract = await order.contract()
            loser = next(one for one in robots if one.agent.address != contract.liability.promisor)
            await until(lambda: order.hash in loser.seen)
            await until(lambda: not robots[0].offers and not robots[1].offers, what="no open offer")
            await until_found(lambda: _none(offers_in(provider)), what="no offer in the book")
            loser.declines["*"] = "out-of-service"
            again = await asyncio.gather(*(person.demand(job(place), cost=1) for _ in range(3)))
            winners = {one.liability.promisor for one in again}
            assert winners == {contract.liability.promisor}


async def test_a_robot_that_polls_seldom_hears_of_contracts_from_the_provider(place: Place) -> None:
    seldom = Timing(poll_interval=60.0)
    async with place.provider() as provider, place.another(4, timing=seldom) as second:
        robots = [Robot(place.agent("robot")), Robot(second)]
        async with robots[0].agent, robots[1].agent, place.agent("person") as person:
            await person.demand(job(place), cost=1)  # its first look, which tells how fast blocks come
            robots[0].declines["*"] = "out-of-service"
            for _ in range(2):
                robots[1].waits.clear()
                order = await person.order(job(place), cost=1)
                await until(lambda: order.hash in robots[1].seen)  # noqa: B023
                robots[1].waits.set()
                await order.contract()
            robots[0].declines.clear()
            robots[1].declines["*"] = "out-of-service"
            contract = await person.demand(job(place), cost=1)
            assert contract.liability.promisor == robots[0].agent.address
            await until(lambda: not robots[1].offers, what="no open offer", seconds=30)
            assert await offers_in(provider) == []


async def _none(found: object) -> bool:
    return not await found  # type: ignore[misc]


async def test_an_offer_that_comes_after_the_contract_is_not_made(place: Place) -> None:
    """The handler is slow: the demand is another robot's contract before it offers."""
    async with place.provider() as provider, place.another(4) as second:
        slow, quick = Robot(place.agent("robot")), Robot(second)
        slow.waits.clear()
        async with slow.agent, quick.agent, place.agent("person") as person:
            order = await person.order(job(place), cost=1)
            await until(lambda: order.hash in slow.seen)
            contract = await order.contract()
            assert contract.liability.promisor == second.address
            slow.waits.set()
            with raises_with(AiraError, code="demand-taken", match=order.hash[:16]):
                await slow.agent.offer(order.message)  # type: ignore[arg-type]
            await until_found(lambda: _none(offers_in(provider)))
            assert slow.offers == []


async def test_a_decline_withdraws_the_offers_with_equal_terms(place: Place) -> None:
    """There is no provider yet, so the first demand is still open when the robot goes out of service."""
    robot = Robot(place.agent("robot"))
    async with robot.agent, place.another(4) as second, place.agent("person") as person:
        first = await person.order(job(place))
        other = await person.order(OBJECTIVE, cost=1)  # nobody has it: no offer
        await until(lambda: len(robot.offers) == 1)
        (offer,) = robot.offers
        robot.declines["*"] = "out-of-service"
        async with second:
            await second.order(first.message.objective)
            await until(lambda: not robot.offers, what="the offer is taken back")
        await until(lambda: robot.seen.count(first.hash) == 2, what="the first demand is decided on again")
        assert await withdrawals(robot.agent) == [offer.hash]
        async with place.provider() as provider:
            await until(lambda: len(provider.book) >= 1)
            await until(lambda: len(provider.withdrawals) >= 1)
            assert await offers_in(provider) == []
        for order in (first, other):
            await order.withdraw()


async def test_a_robot_that_is_busy_keeps_its_offer(place: Place) -> None:
    robot = Robot(place.agent("robot"))
    async with robot.agent, place.another(4) as second, second, place.agent("person") as person:
        first = await person.order(job(place))
        await until(lambda: len(robot.offers) == 1)
        robot.declines["*"] = "busy"
        equal = await second.order(first.message.objective)
        await until(lambda: equal.hash in robot.seen)
        (kept,) = robot.offers
        async with place.provider():
            both = [asyncio.create_task(order.contract()) for order in (first, equal)]
            done, waiting = await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            assert [(await one).liability.promisor for one in done] == [robot.agent.address]
            assert kept.honoured_by == frozenset()
            for one in waiting:
                one.cancel()
            await asyncio.wait(waiting)


async def test_a_maker_whose_demand_was_declined_never_gets_the_offer_for_an_equal_one(place: Place) -> None:
    robot = Robot(place.agent("robot"))
    async with robot.agent, place.another(4) as unwanted, unwanted, place.agent("person") as person:
        robot.declines[unwanted.address] = "not-for-you"
        path = job(place)
        declined = await unwanted.order(path)
        await until(lambda: declined.hash in robot.seen)
        said: list[str] = []
        async with place.provider() as provider:
            wanted = await person.order(path)
            waiting = asyncio.create_task(wanted.contract(on_progress=lambda seen: said.append(seen.code)))
            await until(lambda: EQUAL_DECLINED in said, what="the reason")
            assert await offers_in(provider) == []
            await declined.withdraw()
            contract = await asyncio.wait_for(waiting, 60)
            assert contract.liability.promisor == robot.agent.address
            assert declined.hash not in {order.hash for order in unwanted.orders(OrderState.MATCHED)}


async def test_a_robot_that_is_back_in_service_takes_what_it_declined(place: Place) -> None:
    robot = Robot(place.agent("robot"))
    robot.declines["*"] = "out-of-service"
    async with place.provider(), robot.agent, place.agent("person") as person:
        first = await person.order(job(place))
        await until(lambda: first.hash in robot.seen)
        robot.declines.clear()
        second = await person.order(job(place))
        contracts = await asyncio.gather(first.contract(), second.contract())
        assert {one.liability.promisor for one in contracts} == {robot.agent.address}


async def equal_contract(place: Place, demand: Demand, offer: Demand | Offer) -> None:
    """Make a contract of these two, whatever the provider of the test would match."""
    assert isinstance(offer, Offer)
    await place.chains["provider"].liabilities.create(demand.lighthouse, demand, offer)


def terms_of(order: Order) -> dict[str, Any]:
    """What an equal order of somebody else has in common with this one."""
    message = order.message
    return {name: getattr(message, name) for name in ("model", "objective", "token", "cost", "lighthouse", "deadline")}


async def test_of_two_equal_demands_the_one_that_is_left_keeps_an_offer(place: Place) -> None:
    """The robot has an offer for each, and another robot's is used for one of them."""
    robot, rival = Robot(place.agent("robot")), Account(place.node.funded_keys[5]).signer
    async with place.another(4) as second, second, place.agent("person") as person, robot.agent:
        path = job(place)
        demands = [await one.order(path) for one in (person, second)]
        await until(lambda: len(robot.offers) == 2)
        offered = orders.offer(signer=rival, **terms_of(demands[0]))
        assert isinstance(demands[0].message, Demand)
        await equal_contract(place, demands[0].message, offered)
        await until(lambda: len(robot.offers) == 1, what="the offer for the first is taken back")
        async with place.provider():
            assert (await demands[1].contract()).liability.promisor == robot.agent.address
            await until(lambda: not robot.offers)


async def test_an_offer_that_is_used_for_another_demand_is_replaced(place: Place) -> None:
    """An equal demand that the robot does not know uses its offer; what it has agreed to still gets one."""
    robot, unknown = Robot(place.agent("robot")), place.market.accounts["person"].signer
    async with place.another(4) as second, second, robot.agent, place.agent("person") as person:
        order = await second.order(job(place))
        await until(lambda: len(robot.offers) == 1)
        (offer,) = robot.offers
        chain = place.chains["provider"]
        terms = {
            field: getattr(order.message, field) for field in ("model", "objective", "token", "cost", "lighthouse")
        }
        equal = orders.demand(signer=unknown, deadline=order.deadline, **terms)
        await chain.liabilities.create(order.message.lighthouse, equal, offer.message)  # type: ignore[arg-type]
        await until(lambda: [one.hash for one in robot.offers] not in ([], [offer.hash]), what="a new offer")
        async with place.provider():
            assert (await order.contract()).liability.promisor == robot.agent.address
        assert person.orders() == []


async def test_the_offer_for_a_demand_that_its_maker_withdraws_is_withdrawn(place: Place) -> None:
    robot = Robot(place.agent("robot"))
    async with place.agent("person") as person, robot.agent:
        order = await person.order(job(place))
        await until(lambda: len(robot.offers) == 1)
        await order.withdraw()
        await until(lambda: not robot.offers)


async def test_a_robot_that_ends_withdraws_its_offers_and_waits_until_providers_have_heard_it(place: Place) -> None:
    robot = place.agent("robot")
    async with place.provider() as provider:
        async with robot, place.agent("person") as person:
            await robot.offer(objective=OBJECTIVE)
            await until(lambda: len(provider.book) == 1)
            del person
        assert len(provider.book) == 0
        assert len(provider.withdrawals) == 1


async def test_what_no_provider_heard_at_the_end_is_sent_at_the_next_start(place: Place) -> None:
    async with place.agent("robot") as robot:
        offer = await robot.offer(objective=OBJECTIVE)
    async with place.agent("robot") as robot, place.provider() as provider:
        assert await withdrawals(robot) == [offer]
        assert [order.state for order in robot.orders(*OrderState)] == [OrderState.WITHDRAWN]
        await until(lambda: len(provider.withdrawals) == 1)


async def test_the_offers_of_a_robot_that_was_killed_are_withdrawn_at_its_start(place: Place) -> None:
    """The ledger is left with an open offer, as by a kill."""
    signer = place.market.accounts["robot"].signer
    terms = {"lighthouse": place.market.deployment.lighthouse, "cost": 0, "deadline": 10**9}
    offer = Outgoing.of(orders.offer(signer=signer, **terms))
    async with place.agent("robot") as robot:
        await robot.parts.ledger.post(offer)
    async with place.agent("robot") as helper:  # without handlers: perhaps beside the robot
        assert [order.hash for order in helper.orders()] == [offer.identity]
    robot = Robot(place.agent("robot")).agent
    async with place.provider() as provider, robot:
        assert await withdrawals(robot) == [offer.identity]
        await until(lambda: len(provider.withdrawals) == 1)
        assert robot.orders() == []


@pytest.mark.parametrize("run", [1, 2, 3])
async def test_an_offer_that_was_withdrawn_and_became_a_contract_is_not_signed_again(place: Place, run: int) -> None:
    """When a reorganisation reverts the contract, its nonce is free again, but no provider takes what was withdrawn.

    The robot is started three times. It sees the contract in the given `run`, and makes another offer in the third.
    """
    signed: list[Demand | Offer] = []
    terms: Any = {}
    for number in (1, 2, 3):
        async with place.agent("robot", generation=5) as robot:  # its end and its start withdraw the offer
            trader = robot.runtime.trader
            if number == 1:
                asked: dict[str, Any] = {"cost": 1, "token": "", "validator": "", "lifetime": 200}
                terms = await trader.writer.terms(model=MODEL, objective=OBJECTIVE, **asked)
                signed.append((await trader.post(Offer, terms, lighthouse_fee=0)).message)
            if number == run:
                made = Liability.of_nobody(address=checksum_address(bytes(19) + b"\1"), promisor=robot.address)
                await trader.matched(made, demand_hash=bytes(32), offer_hash=message_hash(signed[0]))
            if number == 3:
                signed.append((await trader.post(Offer, terms, lighthouse_fee=0)).message)
    first, again = signed
    assert (again.nonce, again.deadline) == (first.nonce, first.deadline - 1)
