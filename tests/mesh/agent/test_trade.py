"""Trading: what becomes of demands and offers, and what they may cost."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.contracts import Outcome
from mesh.chain import InsufficientTokens, NotALiability
from mesh.chain.liabilities import Liabilities
from mesh.content import ContentUnavailable
from mesh.errors import ClosedError
from schemas import ZERO_ADDRESS, Demand, cid_of_bytes, cid_of_file, message_hash
from tests.support.agent.trades import OBJECTIVE, all_posted, job, known, posted, waiting, working
from tests.support.market import MODEL, Place, offering
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh import Agent
    from mesh.agent.handlers import Job
    from schemas import Liability, Verified

GENERATIONS = pytest.mark.parametrize("generation", [3, 5])


async def allowance(place: Place, role: str) -> int:
    chain = place.chains[role]
    return await chain.tokens.allowance(place.address(role), chain.factory)


@pytest.mark.sample("generation")
@GENERATIONS
async def test_a_demand_becomes_a_contract_with_its_terms(place: Place, generation: int) -> None:
    async with place.provider(), working(place.agent("robot")), place.agent("person", generation=generation) as person:
        contract = await person.demand(job(place), cost=321)
        terms = contract.liability
        assert (terms.model, terms.objective, terms.cost) == (MODEL, cid_of_file(job(place)), 321)
        assert (terms.promisee, terms.promisor) == (place.address("person"), place.address("robot"))
        assert (terms.validator, terms.validator_fee, terms.lighthouse_fee) == (ZERO_ADDRESS, 0, 0)
        assert (await contract.outcome()).success
        assert await waiting(person) == []


@pytest.mark.sample("generation")
@GENERATIONS
async def test_each_of_several_concurrent_demands_becomes_a_contract(place: Place, generation: int) -> None:
    """Generation 5 counts the orders of an account: one that is overtaken is signed again, on both sides."""
    before = await place.balance("robot")
    async with place.provider(), working(place.agent("robot")), place.agent("person", generation=generation) as person:
        async with asyncio.timeout(60):
            contracts = await asyncio.gather(*(person.demand(job(place), cost=cost) for cost in (10, 200, 3000)))
            outcomes = await asyncio.gather(*(contract.outcome() for contract in contracts))
        assert [contract.liability.cost for contract in contracts] == [10, 200, 3000]
        assert [outcome.success for outcome in outcomes] == [True] * 3
    assert await place.balance("robot") == before + 3210


async def test_equal_demands_of_generation_5_become_a_contract_each(place: Place) -> None:
    """They would have the same nonce, and so the same hash."""
    async with place.provider(), working(place.agent("robot")), place.agent("person", generation=5) as person:
        async with asyncio.timeout(30):
            contracts = await asyncio.gather(*(person.demand(job(place), cost=7) for _ in range(3)))
        assert len({contract.address for contract in contracts}) == 3


async def test_overtaken_offers_of_generation_5_are_signed_again(place: Place) -> None:
    """Both offers of the robot have the same nonce, because neither was taken when they were made."""
    robot = working(place.agent("robot"))
    people = [place.agent(role, generation=5) for role in ("person", "provider")]
    async with robot, people[0], people[1], asyncio.timeout(30):
        demands = [
            asyncio.create_task(one.demand(job(place), cost=cost)) for one, cost in zip(people, (6, 7), strict=True)
        ]
        await until_found(lambda: all_posted(robot, 2))
        async with place.provider():
            contracts = [await demand for demand in demands]
            assert [(await contract.outcome()).success for contract in contracts] == [True, True]
        await until(lambda: len(robot.runtime.trader.answers) == 0)


async def test_an_overtaken_demand_of_generation_5_is_signed_again_without_a_rejection(place: Place) -> None:
    """It has no offer, so no provider rejects its used nonce: the person knows from the other demand."""
    robot = place.agent("robot", generation=5)
    async with place.provider(), robot, place.agent("person", generation=5) as person:
        lonely = asyncio.create_task(person.demand(cid_of_bytes(b"what nobody offers")))
        await posted(person)
        (overtaken,) = (order.hash for order in person.orders())
        await robot.offer(objective=OBJECTIVE)
        await person.demand(OBJECTIVE)
        await until(lambda: [order.hash for order in person.orders()] not in ([], [overtaken]))
        await until_found(lambda: all_posted(person, 1))
        lonely.cancel()
        await asyncio.wait([lonely])


async def test_a_demand_may_become_a_contract_before_its_maker_listens_to_offers(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    @asynccontextmanager
    async def late(*_: object) -> AsyncIterator[None]:
        await until(lambda: not person.orders())
        yield

    monkeypatch.setattr("mesh.agent.trade.seen_offers", late)
    async with place.provider(seconds=20), working(place.agent("robot")), place.agent("person") as person:
        contract = await person.demand(job(place), on_progress=lambda _: None)
        assert (await contract.outcome()).success


async def test_a_contract_may_end_while_it_is_read(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    robot, get, released = offering(place.agent("robot")), Liabilities.get, asyncio.Event()

    @robot.on("*")
    async def wait(job: Job, message: Any) -> None:
        await released.wait()

    async def late(self: Liabilities, address: str) -> Liability:
        found = await get(self, address)
        if self._node is other.chain.node:
            released.set()
            await until(lambda: address not in other.runtime.trader.contracts)
        return found

    async with place.provider(seconds=20), robot, place.agent("person") as person, place.agent("provider") as other:
        contract = await person.demand(job(place))
        monkeypatch.setattr(Liabilities, "get", late)
        assert (await (await other.contract(contract.address)).outcome()).success


@pytest.mark.usefixtures("without_permits")
async def test_the_allowance_of_the_factory_covers_all_open_demands(place: Place, person: Agent) -> None:
    demands = [asyncio.create_task(person.demand(OBJECTIVE, cost=cost)) for cost in (7000, 500)]
    await until_found(lambda: all_posted(person, 2))
    assert await allowance(place, "person") >= 7500
    for demand in demands:
        demand.cancel()
    await asyncio.wait(demands)


async def test_short_funds_raise_before_anything_is_sent(place: Place) -> None:
    balance = await place.balance("person")
    async with place.agent("person") as person:
        with pytest.raises(InsufficientTokens) as caught:
            await person.demand(OBJECTIVE, cost=balance + 1)
        assert (caught.value.balance, caught.value.needed) == (balance, balance + 1)
        assert await waiting(person) == []


async def test_open_demands_reserve_tokens_until_they_are_cancelled(place: Place) -> None:
    balance = await place.balance("person")
    async with place.agent("person") as person:
        first = asyncio.create_task(person.demand(OBJECTIVE, cost=balance))
        await posted(person)
        with pytest.raises(InsufficientTokens):
            await person.demand(OBJECTIVE, cost=1)
        first.cancel()
        await asyncio.wait([first])
        second = asyncio.create_task(person.demand(OBJECTIVE, cost=1))
        await posted(person)
        second.cancel()
        await asyncio.wait([second])


async def test_a_refused_demand_does_not_count(place: Place) -> None:
    balance = await place.balance("person")
    async with place.agent("person") as person:
        with pytest.raises(InsufficientTokens):
            await person.demand(OBJECTIVE, cost=balance - 10, permit_fee=11)
        demand = asyncio.create_task(person.demand(OBJECTIVE, cost=balance - 10, permit_fee=10))
        await posted(person)
        demand.cancel()
        await asyncio.wait([demand])


async def test_a_cancelled_demand_is_withdrawn(person: Agent) -> None:
    demand = asyncio.create_task(person.demand(OBJECTIVE))
    await posted(person)
    demand.cancel()
    with pytest.raises(asyncio.CancelledError):
        await demand
    assert await waiting(person) == ["withdrawal"]


async def test_a_demand_that_is_cancelled_when_it_has_just_become_a_contract_is_cancelled(place: Place) -> None:
    async with place.provider(), working(place.agent("robot")), place.agent("person") as person:
        demand = asyncio.create_task(person.demand(job(place)))
        await posted(person)
        while person.orders():  # until the demand is matched, and its task has not noticed yet
            await asyncio.sleep(0)
        demand.cancel()
        with pytest.raises(asyncio.CancelledError):
            await demand


async def test_closing_the_agent_fails_the_wait_for_a_contract(place: Place) -> None:
    async with place.agent("person") as person:
        demand = asyncio.create_task(person.demand(OBJECTIVE))
        await posted(person)
    with pytest.raises(ClosedError):
        await asyncio.wait_for(demand, 60)
    async with place.agent("person") as person:
        assert [order.kind for order in person.orders()] == ["demand"], "it is open until it is withdrawn or expires"


async def test_closing_the_agent_fails_the_wait_for_an_outcome(place: Place) -> None:
    robot = offering(place.agent("robot"))
    async with place.provider(), robot:
        async with place.agent("person") as person:
            contract = await person.demand(job(place))
            outcome = asyncio.create_task(contract.outcome())
            await known(robot, contract.address)
        with pytest.raises(ClosedError):
            await asyncio.wait_for(outcome, 60)
        await robot.finish(contract.address, success=False)


async def test_an_offer_without_demand_waits_for_one(place: Place) -> None:
    robot = place.agent("robot")
    working_on: list[str] = []

    @robot.on("*")
    async def work(job: Job, message: Any) -> None:
        working_on.append(message.data)

    async with place.provider(), robot, place.agent("person") as person:
        cid = cid_of_file(job(place))
        offer = await robot.offer(objective=cid, cost=55)
        assert await waiting(robot) == ["offer"]
        contract = await person.demand(job(place), cost=55)
        assert (await contract.outcome()).success
        _, offer_hash = (await place.chains["person"].liabilities.get_with_orders(contract.address))[1]
        assert offer_hash.hex() == offer
        assert [kind for kind in await waiting(robot) if kind == "offer"] == []
    assert working_on == ["there"]


async def test_an_offer_is_forgotten_at_its_deadline(place: Place) -> None:
    fee = await place.balance("robot")
    async with place.agent("robot") as robot:
        await robot.offer(objective=OBJECTIVE, lighthouse_fee=fee, lifetime=4)
        with pytest.raises(InsufficientTokens):
            await robot.offer(objective=OBJECTIVE, lighthouse_fee=1)
        await place.node.mine(4)
        await until_found(lambda: all_posted(robot, 0))
        await robot.offer(objective=OBJECTIVE, lighthouse_fee=1)


async def test_the_lighthouse_fee_of_an_offer_is_paid_and_then_promised_no_more(place: Place) -> None:
    robot = place.agent("robot")

    @robot.on("*")
    async def nothing(job: Job, message: Any) -> None:
        pass

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand, lighthouse_fee=77)

    before = await place.balance("robot")
    async with place.provider() as provider, robot, place.agent("person") as person:
        contract = await person.demand(job(place), cost=100)
        await contract.outcome()
        assert contract.liability.lighthouse_fee == 77
        await until(lambda: not robot.orders())
        await until(lambda: provider.earnings().fees == 77, what="the fee")
    assert await place.balance("robot") == before + 100 - 77


async def test_an_offer_may_agree_to_a_bare_demand(place: Place) -> None:
    async with place.agent("robot") as robot, place.agent("person") as person:
        cid = await asyncio.to_thread(person.parts.store.put_file, job(place))
        terms = await person.runtime.trader.writer.terms(
            model=MODEL, objective=cid, cost=3, token="", validator="", lifetime=50
        )
        demand = person.parts.signer.sign(Demand(**terms, nonce="ab" * 32, validator_fee=0))
        offer = await robot.offer(demand)
        assert offer != message_hash(demand).hex()
        assert await waiting(robot) == ["offer"]


async def test_an_order_of_an_earlier_run_is_settled_when_it_is_taken(place: Place) -> None:
    """The person's program was killed while it waited; its demand is sent on, and no more once it has a contract."""
    async with place.agent("person") as person:
        trader = person.runtime.trader
        terms = await trader.writer.terms(
            model=MODEL, objective=cid_of_file(job(place)), cost=0, token="", validator="", lifetime=500
        )
        await person.parts.outbox.post(person.parts.signer.sign(Demand(**terms, nonce="cd" * 32, validator_fee=0)))
    async with place.provider(), working(place.agent("robot")), place.agent("person") as person:
        await until_found(lambda: all_posted(person, 0))


async def test_an_agent_can_wait_for_a_contract_of_others(place: Place) -> None:
    robot = offering(place.agent("robot"))
    async with place.provider(), robot, place.agent("person") as person, place.agent("provider") as stranger:
        address = (await person.demand(job(place))).address
        await known(robot, address)
        contract = await stranger.contract(address.lower())
        outcome = asyncio.create_task(contract.outcome())
        result = await robot.finish(address, success=True)
        assert await outcome == Outcome(success=True, result=result, robot=robot.address, contract=address)


async def test_a_contract_that_has_ended_has_its_outcome_at_once(place: Place) -> None:
    async with place.provider(), working(place.agent("robot")), place.agent("person") as person:
        address = (await person.demand(job(place))).address
        outcome = await (await person.contract(address)).outcome()
    async with place.agent("provider") as later, asyncio.timeout(60):
        contract = await later.contract(address)
        assert await contract.outcome() == outcome
        assert len(later.runtime.trader.contracts) == 0


async def test_waiting_for_an_address_that_is_not_a_contract_raises(place: Place, person: Agent) -> None:
    with pytest.raises(NotALiability):
        await person.contract(place.address("robot"))
    assert len(person.runtime.trader.contracts) == 0


async def test_cancelling_one_wait_for_an_outcome_does_not_affect_others(place: Place) -> None:
    robot = offering(place.agent("robot"))
    async with place.provider(), robot, place.agent("person") as person:
        contract = await person.demand(job(place))
        impatient, patient = (asyncio.create_task(contract.outcome()) for _ in range(2))
        await known(robot, contract.address)
        impatient.cancel()
        await asyncio.wait([impatient])
        await robot.finish(contract.address, success=True)
        assert (await patient).success


async def test_a_contract_refunded_without_a_result_has_no_recording(place: Place) -> None:
    robot = offering(place.agent("robot"))
    async with place.provider(), robot, place.agent("person") as person:
        contract = await person.demand(job(place))
        await known(robot, contract.address)
        contracts = person.runtime.trader.contracts
        contracts.finalized(contract.address, Outcome(success=False, result=""), 0)
        await contracts.settle()
        with pytest.raises(ContentUnavailable):
            await contract.recording()
        await robot.finish(contract.address, success=False)
