"""Trading: what becomes of demands and offers, and what they may cost."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace

from mesh.agent import Agent, ContractTakenBack, OrderExpired, OrderRejected, Outcome, ShortOfFunds
from mesh.chain import Chain, NotALiability, Timing
from mesh.content import ContentUnavailable
from mesh.errors import ClosedError
from mesh.network import Endpoints, Network
from mesh.work import outbox as outbox_module
from schemas import ZERO_ADDRESS, Demand, Offer, RejectKey, cid_of_bytes, cid_of_file, decode, message_hash
from schemas.rejection import Rejection
from tests.support.market import MODEL, Place, careless, obliging
from tests.support.objectives import objective
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.work.run import Run
    from schemas import Verified

OBJECTIVE = cid_of_bytes(b"something to be done")
GENERATIONS = pytest.mark.parametrize("generation", [3, 5])


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox_module, "RESEND", 0.1)


def working(robot: Agent) -> Agent:
    """The same robot, which does whatever it is asked and played."""

    @robot.on("*")
    async def nothing(job: Run, message: Any) -> None:
        pass

    return careless(robot)


def job(place: Place) -> Path:
    return place.save(objective(("/go", "there")))


async def waiting(agent: Agent) -> list[str]:
    """The kinds of what is in an agent's outbox."""
    return [message.kind for message in await agent.parts.ledger.outbox(head=0)]


async def posted(agent: Agent) -> None:
    """Wait until an agent has something in its outbox."""
    await until_found(lambda: waiting(agent), what="a posted order")


async def known(robot: Agent, address: str) -> None:
    """Wait until a robot has heard of its job: it reads the chain by itself."""
    await until_found(lambda: robot.parts.ledger.job(address), what="a job")


async def allowance(place: Place, role: str) -> int:
    chain = place.chains[role]
    return await chain.allowance(place.address(role), chain.factory)


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


@GENERATIONS
async def test_concurrent_demands_become_a_contract_each(place: Place, generation: int) -> None:
    """Generation 5 counts the orders of an account: one that is overtaken has to be signed anew, on both sides."""
    before = await place.balance("robot")
    async with place.provider(), working(place.agent("robot")), place.agent("person", generation=generation) as person:
        async with asyncio.timeout(60):
            contracts = await asyncio.gather(*(person.demand(job(place), cost=cost) for cost in (10, 200, 3000)))
            outcomes = await asyncio.gather(*(contract.outcome() for contract in contracts))
        assert [contract.liability.cost for contract in contracts] == [10, 200, 3000]
        assert [outcome.success for outcome in outcomes] == [True] * 3
    assert await place.balance("robot") == before + 3210


async def test_offers_that_were_overtaken_in_generation_5_are_signed_anew(place: Place) -> None:
    """Both of the robot's offers bear the same nonce, since neither was taken when they were made."""
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


async def test_a_demand_that_was_overtaken_in_generation_5_is_signed_anew_without_being_told(place: Place) -> None:
    """Nobody offers to do it, so no provider says that its nonce is used: the person knows it of the other demand."""
    robot = place.agent("robot", generation=5)
    async with place.provider(), robot, place.agent("person", generation=5) as person:
        trader = person._working().trader
        lonely = asyncio.create_task(person.demand(cid_of_bytes(b"what nobody offers")))
        await posted(person)
        (overtaken,) = trader._matches
        await robot.offer(objective=OBJECTIVE)
        await person.demand(OBJECTIVE)
        await until(lambda: len(trader._matches) == 1 and overtaken not in trader._matches)
        await until_found(lambda: all_posted(person, 1))
        lonely.cancel()
        await asyncio.wait([lonely])


async def test_the_factory_is_allowed_what_all_open_demands_may_cost(place: Place) -> None:
    async with place.agent("person") as person:
        demands = [asyncio.create_task(person.demand(OBJECTIVE, cost=cost)) for cost in (7000, 500)]
        await until_found(lambda: all_posted(person, 2))
        assert await allowance(place, "person") >= 7500
        for demand in demands:
            demand.cancel()
        await asyncio.wait(demands)


async def all_posted(agent: Agent, count: int) -> bool:
    return len(await waiting(agent)) == count


async def test_a_demand_that_nobody_takes_expires_at_its_deadline(place: Place) -> None:
    async with place.provider(), place.agent("person") as person:
        deadline = await place.chains["person"].block_number() + 5
        demand = asyncio.create_task(person.demand(OBJECTIVE, lifetime=5))
        await posted(person)
        await place.node.mine(4)
        head = deadline - 1
        await until(lambda: person.parts.clock.head >= head)
        assert not demand.done()
        await place.node.mine(1)
        with pytest.raises(OrderExpired, match=f"until block {deadline}") as caught:
            await demand
        assert caught.value.deadline == deadline
        assert await waiting(person) == []


async def test_a_demand_that_the_contracts_refuse_is_rejected_with_their_reason(place: Place) -> None:
    robot = working(place.agent("robot"))
    async with place.provider(), robot, place.agent("person", generation=5) as person:
        with pytest.raises(OrderRejected, match="ValidatorWithoutCode") as caught:
            await person.demand(OBJECTIVE, validator=place.address("provider"))
        assert caught.value.rejection.reason == "ValidatorWithoutCode"
        assert caught.value.rejection.provider == place.address("provider")
        assert await waiting(person) == []


def rejection(place: Place, role: str, order: str, *, reason: str = "Unwanted") -> Rejection:
    """What an account says of an order."""
    account = place.market.accounts[role]
    unsigned = Rejection(order=order, reason=reason, detail="go away", provider=account.address)
    return unsigned.signed_by(account.signer)


def untrue_rejections(place: Place, order: str) -> list[Rejection]:
    """Of another order; in a provider's name, unsigned, or signed by somebody else; by who is no provider."""
    true = rejection(place, "provider", order)
    forged = rejection(place, "robot", order)
    return [
        rejection(place, "provider", "00" * 32),
        replace(true, signature=""),
        replace(forged, provider=true.provider),
        forged,
    ]


async def test_a_rejection_is_believed_of_the_lighthouses_providers_only(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    async with place.agent("person") as person, Network(Endpoints(connect=(place.endpoint,))) as stranger:
        demand = asyncio.create_task(person.demand(OBJECTIVE))
        await posted(person)
        (identity,) = person._working().trader._matches
        key = str(RejectKey(person.channel.lighthouse, identity, place.address("provider")))
        stranger.session.put(key, b"no rejection at all")
        for untrue in untrue_rejections(place, identity):
            stranger.session.put(key, untrue.encode())
        arrived: list[object] = []
        with person.parts.network.session.declare_subscriber("last", arrived.append):
            await until(lambda: stranger.session.put("last", b"") or arrived)
        assert not demand.done()
        await until(lambda: "who is no provider, says of an order: Unwanted" in caplog.text)
        assert not demand.done()
        stranger.session.put(key, rejection(place, "provider", identity).encode())
        with pytest.raises(OrderRejected, match=r"rejects the order \(Unwanted\): go away"):
            await demand


async def test_a_rejection_of_what_is_a_contract_already_means_nothing(place: Place) -> None:
    """Another provider was quicker, and this one says so before the person has read of the contract on the chain.

    A person of generation 5 would sign a second demand, and pay for two contracts.
    """
    slowly, me = Timing(poll_interval=2.0), place.market.accounts["person"]
    settings = place.settings("person", generation=5)
    chain = Chain(place.node.provider, account=me, ens=place.market.deployment.ens, timing=slowly)
    async with (
        chain,
        Agent(MODEL, settings=settings, account=me, chain=chain) as person,
        working(place.agent("robot")),
        Network(Endpoints(connect=(place.endpoint,))) as network,
    ):
        before = await chain.nonce_of(me.address)
        demand = asyncio.create_task(person.demand(OBJECTIVE))
        await posted(person)
        (identity,) = person._working().trader._matches
        async with place.provider() as provider:
            await until(lambda: provider.earnings().created == 1)
            key = str(RejectKey(person.channel.lighthouse, identity, place.address("provider")))
            network.session.put(key, rejection(place, "provider", identity, reason="WrongSigner").encode())
            contract = await demand
        demand_hash, _ = await chain.order_hashes(contract.address)
        assert demand_hash.hex() == identity
        assert await chain.nonce_of(me.address) == before + 1


async def test_a_provider_without_room_is_asked_again(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    async with place.agent("person") as person, Network(Endpoints(connect=(place.endpoint,))) as network:
        demand = asyncio.create_task(person.demand(cid_of_file(job(place))))
        await posted(person)
        (identity,) = person._working().trader._matches
        key = str(RejectKey(person.channel.lighthouse, identity, place.address("provider")))
        network.session.put(key, rejection(place, "provider", identity, reason="full").encode())
        await until(lambda: "has no room for the order" in caplog.text)
        assert await waiting(person) == ["demand"]
        async with place.provider(), working(place.agent("robot")):
            assert (await demand).liability.promisee == place.address("person")


async def test_orders_of_a_contract_that_the_chain_took_back_are_sent_again(place: Place) -> None:
    """The provider who made it is gone, and another one has never heard of them."""
    async with working(place.agent("robot")) as robot, place.agent("person") as person:
        async with place.provider():
            contract = await person.demand(cid_of_bytes(b"a job that nobody can begin"))
            await known(robot, contract.address)
        first = contract.address
        await place.forget_blocks(1)
        await until_found(lambda: all_posted(person, 1), what="the demand posted again")
        await until_found(lambda: all_posted(robot, 1), what="the offer posted again")
        async with place.provider():
            await until(lambda: contract.address != first)
            await until_found(lambda: all_posted(person, 0))


async def test_a_contract_that_the_chain_took_back_and_nobody_makes_again_ends_at_its_deadline(place: Place) -> None:
    async with working(place.agent("robot")) as robot, place.agent("person") as person:
        async with place.provider():
            contract = await person.demand(cid_of_bytes(b"a job that is made once"), lifetime=50)
            await known(robot, contract.address)
        outcomes = [
            asyncio.create_task((await agent.contract(contract.address)).outcome()) for agent in (person, robot)
        ]
        await place.forget_blocks(1)
        await until_found(lambda: all_posted(person, 1), what="the demand posted again")
        await until_found(lambda: all_posted(robot, 1), what="the offer posted again")
        assert not any(outcome.done() for outcome in outcomes)
        await place.node.mine(60)
        for outcome in outcomes:
            with pytest.raises(ContractTakenBack, match="was not made again until block") as caught:
                await asyncio.wait_for(outcome, 30)
            assert caught.value.liability == contract.address
        with pytest.raises(ContractTakenBack):
            await contract.recording()
        trader = person._working().trader
        assert (trader._unmade, trader._endings, trader._contracts) == ({}, {}, {})


async def test_a_contract_that_is_made_again_does_not_end_at_the_deadline(place: Place) -> None:
    async with working(place.agent("robot")) as robot, place.agent("person") as person:
        async with place.provider():
            contract = await person.demand(cid_of_bytes(b"a job that is made twice"), lifetime=50)
            await known(robot, contract.address)
        first = contract.address
        outcome = asyncio.create_task(contract.outcome())
        await place.forget_blocks(1)
        await until_found(lambda: all_posted(person, 1), what="the demand posted again")
        async with place.provider():
            await until(lambda: contract.address != first or not person._working().trader._unmade)
            await until_found(lambda: all_posted(person, 0))
        await place.node.mine(60)
        head = await place.chains["person"].block_number()
        await until(lambda: person.parts.clock.head >= head)
        assert not outcome.done()
        outcome.cancel()


async def test_a_contract_on_our_terms_that_a_stranger_has_signed_leaves_our_demand_open(place: Place) -> None:
    """He copies the demand with its nonce, so its hash is the same, and takes an offer of the same account."""
    async with place.agent("person", enable_executor=False) as person:
        demanding = asyncio.create_task(person.demand(OBJECTIVE))
        await posted(person)
        (waiting_demand,) = await person.parts.ledger.outbox(head=0)
        ours = decode(waiting_demand.payload)
        assert isinstance(ours, Demand)
        stolen = place.market.accounts["provider"].signer.sign(replace(ours, signature=""))
        terms = {
            name: getattr(ours, name) for name in ("model", "objective", "token", "cost", "lighthouse", "validator")
        }
        fresh: dict[str, Any] = {"deadline": ours.deadline, "nonce": "ab" * 32, "lighthouse_fee": 0}
        offer = person.parts.signer.sign(Offer(**terms, **fresh))
        chain = place.chains["provider"]
        made = await chain.create_liability(place.market.deployment.lighthouse, stolen, offer)
        assert (await chain.order_hashes(made.liability))[0] == message_hash(ours)

        head = await chain.block_number()
        await until(lambda: person.parts.clock.head >= head)
        assert not demanding.done()
        assert await waiting(person) == ["demand"]
        demanding.cancel()
        await asyncio.wait([demanding])


async def test_an_offer_that_can_not_be_signed_anew_stops_nothing(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    """One of two offers of generation 5 was taken; for the fee of the other one the robot has too little by then."""
    everything = await place.balance("robot")
    async with place.agent("robot", generation=5) as robot, place.agent("person", generation=5) as person:
        await robot.offer(objective=OBJECTIVE)
        await robot.offer(objective=cid_of_bytes(b"something dear"), lighthouse_fee=everything)
        await place.chains["robot"].transfer(place.address("person"), 5)
        async with place.provider():
            await person.demand(OBJECTIVE)
            await until(lambda: "is given up" in caplog.text)
            await until_found(lambda: all_posted(robot, 0))
            again = cid_of_bytes(b"something else")
            await robot.offer(objective=again)
            assert (await person.demand(again)).liability.promisor == place.address("robot")
    await place.chains["person"].transfer(place.address("robot"), 5)


async def test_who_is_short_of_funds_is_told_before_anything_is_sent(place: Place) -> None:
    balance = await place.balance("person")
    async with place.agent("person") as person:
        with pytest.raises(ShortOfFunds, match=f"has {balance} of token") as caught:
            await person.demand(OBJECTIVE, cost=balance + 1)
        assert (caught.value.balance, caught.value.needed) == (balance, balance + 1)
        assert await waiting(person) == []


async def test_open_demands_count_towards_what_can_be_paid_until_they_are_given_up(place: Place) -> None:
    balance = await place.balance("person")
    async with place.agent("person") as person:
        first = asyncio.create_task(person.demand(OBJECTIVE, cost=balance))
        await posted(person)
        with pytest.raises(ShortOfFunds):
            await person.demand(OBJECTIVE, cost=1)
        first.cancel()
        await asyncio.wait([first])
        second = asyncio.create_task(person.demand(OBJECTIVE, cost=1))
        await posted(person)
        second.cancel()
        await asyncio.wait([second])


async def test_a_refused_demand_promises_nothing(place: Place) -> None:
    balance = await place.balance("person")
    async with place.agent("person") as person:
        with pytest.raises(ShortOfFunds):
            await person.demand(OBJECTIVE, cost=balance - 10, validator_fee=11)
        demand = asyncio.create_task(person.demand(OBJECTIVE, cost=balance - 10, validator_fee=10))
        await posted(person)
        demand.cancel()
        await asyncio.wait([demand])


async def test_a_cancelled_demand_is_sent_no_more(place: Place) -> None:
    async with place.agent("person") as person:
        demand = asyncio.create_task(person.demand(OBJECTIVE))
        await posted(person)
        demand.cancel()
        with pytest.raises(asyncio.CancelledError):
            await demand
        assert await waiting(person) == []


async def test_the_end_of_the_agent_is_told_to_who_waits_for_a_contract(place: Place) -> None:
    async with place.agent("person") as person:
        demand = asyncio.create_task(person.demand(OBJECTIVE))
        await posted(person)
    with pytest.raises(ClosedError, match="the agent has ended"):
        await asyncio.wait_for(demand, 10)
    async with place.agent("person") as person:
        assert await waiting(person) == [], "nobody waits for it any more"


async def test_the_end_of_the_agent_is_told_to_who_waits_for_an_outcome(place: Place) -> None:
    robot = obliging(place.agent("robot"))
    async with place.provider(), robot:
        async with place.agent("person") as person:
            contract = await person.demand(job(place))
            outcome = asyncio.create_task(contract.outcome())
            await known(robot, contract.address)
        with pytest.raises(ClosedError, match="the agent has ended"):
            await asyncio.wait_for(outcome, 10)
        await robot.finish(contract.address, success=False)


async def test_an_offer_without_demand_waits_for_one(place: Place) -> None:
    robot = place.agent("robot")
    working_on: list[str] = []

    @robot.on("*")
    async def work(job: Run, message: Any) -> None:
        working_on.append(message.data)

    async with place.provider(), robot, place.agent("person") as person:
        cid = cid_of_file(job(place))
        offer = await robot.offer(objective=cid, cost=55)
        assert await waiting(robot) == ["offer"]
        contract = await person.demand(job(place), cost=55)
        assert (await contract.outcome()).success
        _, offer_hash = await place.chains["person"].order_hashes(contract.address)
        assert offer_hash.hex() == offer
        assert [kind for kind in await waiting(robot) if kind == "offer"] == []
    assert working_on == ["there"]


async def test_an_offer_is_forgotten_at_its_deadline(place: Place) -> None:
    fee = await place.balance("robot")
    async with place.agent("robot") as robot:
        await robot.offer(objective=OBJECTIVE, lighthouse_fee=fee, lifetime=4)
        with pytest.raises(ShortOfFunds):
            await robot.offer(objective=OBJECTIVE, lighthouse_fee=1)
        await place.node.mine(4)
        await until_found(lambda: all_posted(robot, 0))
        await robot.offer(objective=OBJECTIVE, lighthouse_fee=1)


async def test_the_lighthouse_fee_of_an_offer_is_paid_and_then_promised_no_more(place: Place) -> None:
    robot = place.agent("robot")

    @robot.on("*")
    async def nothing(job: Run, message: Any) -> None:
        pass

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand, lighthouse_fee=77)

    before = await place.balance("robot")
    async with place.provider() as provider, robot, place.agent("person") as person:
        contract = await person.demand(job(place), cost=100)
        await contract.outcome()
        assert contract.liability.lighthouse_fee == 77
        await until(lambda: not robot._working().trader._purse._promised)
        assert provider.earnings().fees == 77
    assert await place.balance("robot") == before + 100 - 77


async def test_an_offer_may_agree_to_a_bare_demand(place: Place) -> None:
    async with place.agent("robot") as robot, place.agent("person") as person:
        cid = await asyncio.to_thread(person.parts.store.put_file, job(place))
        terms = await person._working().trader.terms(
            model=MODEL, objective=cid, cost=3, token="", validator="", lifetime=50
        )
        demand = person.parts.signer.sign(Demand(**terms, nonce="ab" * 32, validator_fee=0))
        offer = await robot.offer(demand)
        assert offer != message_hash(demand).hex()
        assert await waiting(robot) == ["offer"]


async def test_an_order_of_an_earlier_run_is_settled_when_it_is_taken(place: Place) -> None:
    """The person's program was killed while it waited; its demand is sent on, and no more once it has a contract."""
    async with place.agent("person") as person:
        trader = person._working().trader
        terms = await trader.terms(
            model=MODEL, objective=cid_of_file(job(place)), cost=0, token="", validator="", lifetime=500
        )
        await person.parts.outbox.post(person.parts.signer.sign(Demand(**terms, nonce="cd" * 32, validator_fee=0)))
    async with place.provider(), working(place.agent("robot")), place.agent("person") as person:
        await until_found(lambda: all_posted(person, 0))


async def test_a_contract_of_others_can_be_waited_for(place: Place) -> None:
    robot = obliging(place.agent("robot"))
    async with place.provider(), robot, place.agent("person") as person, place.agent("provider") as stranger:
        address = (await person.demand(job(place))).address
        await known(robot, address)
        contract = await stranger.contract(address.lower())
        outcome = asyncio.create_task(contract.outcome())
        result = await robot.finish(address, success=True)
        assert await outcome == Outcome(success=True, result=result)


async def test_a_contract_that_has_ended_has_its_outcome_at_once(place: Place) -> None:
    async with place.provider(), working(place.agent("robot")), place.agent("person") as person:
        address = (await person.demand(job(place))).address
        outcome = await (await person.contract(address)).outcome()
    async with place.agent("provider") as later, asyncio.timeout(10):
        contract = await later.contract(address)
        assert await contract.outcome() == outcome
        assert later._working().trader._endings == {}


async def test_what_is_no_contract_can_not_be_waited_for(place: Place) -> None:
    async with place.agent("person") as person:
        with pytest.raises(NotALiability):
            await person.contract(place.address("robot"))
        assert person._working().trader._endings == {}


async def test_giving_up_to_wait_for_an_outcome_leaves_it_to_others(place: Place) -> None:
    robot = obliging(place.agent("robot"))
    async with place.provider(), robot, place.agent("person") as person:
        contract = await person.demand(job(place))
        impatient, patient = (asyncio.create_task(contract.outcome()) for _ in range(2))
        await known(robot, contract.address)
        impatient.cancel()
        await asyncio.wait([impatient])
        await robot.finish(contract.address, success=True)
        assert (await patient).success


async def test_a_contract_refunded_without_a_result_has_no_recording(place: Place) -> None:
    robot = obliging(place.agent("robot"))
    async with place.provider(), robot, place.agent("person") as person:
        contract = await person.demand(job(place))
        await known(robot, contract.address)
        person._working().trader.finalized(contract.address, Outcome(success=False, result=""))
        with pytest.raises(ContentUnavailable, match="was refunded without a result"):
            await contract.recording()
        await robot.finish(contract.address, success=False)
