"""Messages that others have an agent sign, or publish."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh.chain import XRT
from schemas import ZERO_ADDRESS, Demand, Offer, Result, Verified, cid_of_bytes, message_hash
from schemas.keys import market_key
from schemas.rpc import Approve, Published, SendDemand, SendOffer, SendResult, SignDemand, SignOffer, SignResult
from tests.mesh.agent.conftest import Asker, asking
from tests.support.agent.trades import all_posted, unsettled
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.waiting import until_found, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent.agent import Agent
    from mesh.network import Subscription
    from schemas import SignedMessage
    from tests.support.market import Place

GENERATIONS = pytest.mark.parametrize("generation", [3, 5])
RECORDING = cid_of_bytes(b"a recording")


@pytest.fixture
async def ear(place: Place) -> AsyncIterator[Agent]:
    """An agent that receives the messages of the market."""
    async with place.agent("person") as ear:
        yield ear


def terms(place: Place, agent: Agent, **changed: Any) -> dict[str, Any]:
    """The terms of an order for a small file of the agent's, without a price."""
    lighthouse = place.market.deployment.lighthouse_name
    return {
        "model": MODEL,
        "objective": agent.parts.store.put_file(place.save(objective(("/say", "x")))),
        "token": "xrt.3.robonomics.eth",
        "cost": 0,
        "lighthouse": lighthouse,
        "validator": ZERO_ADDRESS,
        "deadline": agent.parts.chain_head.head + 1000,
    } | changed


def demand_of(place: Place, agent: Agent, *, generation: int = 3, **changed: Any) -> Demand:
    """A demand that the person has signed elsewhere."""
    signer = place.market.accounts["person"].signer
    deployment = place.market.deployment
    addresses = {"token": deployment.xrt, "lighthouse": deployment.lighthouse}
    origin = {"nonce": "ab" * 32} if generation == 3 else {"nonce": 2**70, "sender": signer.address}
    return signer.sign(Demand(**terms(place, agent, **addresses) | origin | changed, validator_fee=2**60))


@asynccontextmanager
async def hearing(speaker: Agent, kind: type[Any], ear: Agent) -> AsyncIterator[Subscription[Any]]:
    """The messages of a kind that `ear` receives; entered when those of `speaker` reach it."""
    async with ear.channel.subscribe(kind) as messages:
        key = market_key(ear.channel.lighthouse, kind.kind, "" if kind is Result else MODEL)
        await until_heard(speaker.parts.network.session, key)
        yield messages


async def heard(messages: Subscription[Any]) -> Verified[Any]:
    async with asyncio.timeout(30):
        return await anext(messages)


async def waiting(agent: Agent) -> list[bytes]:
    return [waiting.payload for waiting in await unsettled(agent)]


async def until_settled(agent: Agent) -> None:
    async def is_settled() -> bool:
        return not await waiting(agent)

    await until_found(is_settled, what="an empty outbox", seconds=30)


@pytest.mark.sample("generation")
@GENERATIONS
async def test_orders_that_two_agents_signed_become_a_contract(place: Place, generation: int) -> None:
    options: dict[str, Any] = {"open_services": True, "generation": generation}
    robot, person = place.agent("robot", **options), place.agent("person", **options)
    chain = place.chains["provider"]
    before = await chain.block_number() + 1
    async with place.provider(), asking(place, robot) as ask_robot, asking(place, person) as ask_person:
        await ask_person.ask("eth/approve", Approve(chain.factory, 9))
        agreed = terms(place, person, cost=9)
        demanded: Published = await ask_person.ask("sign/demand", SignDemand(**agreed, validator_fee=0))
        offered: Published = await ask_robot.ask("sign/offer", SignOffer(**agreed, lighthouse_fee=0))

        async def is_made() -> bool:
            return len(await chain.liabilities.list(from_block=before)) == 1

        await until_found(is_made, what="a contract", seconds=30)
        [liability] = await chain.liabilities.list(from_block=before)
        assert (liability.cost, liability.promisee, liability.promisor) == (9, person.address, robot.address)
        hashes = (await chain.liabilities.get_with_orders(liability.address))[1]
        assert tuple(digest.hex() for digest in hashes) == (demanded.hash, offered.hash)
        await until_settled(person)
        await until_settled(robot)


async def test_a_result_that_the_agent_signed_ends_the_contract_and_is_sent_until_then(place: Place) -> None:
    """The executor of the robot is off: the program that drives it makes the results."""
    robot = offering(place.agent("robot", open_services=True, enable_executor=False))
    async with asking(place, robot) as asker, place.agent("person") as person:
        async with place.provider():
            contract = await person.demand(place.save(objective(("/say", "x"))))
        await asker.ask("sign/result", SignResult(liability=contract.address, result=RECORDING, success=False))
        await until_found(lambda: all_posted(robot, 1), what="only the result: there was no provider to hear it")
        async with place.provider():
            outcome = await contract.outcome()
        assert (outcome.success, outcome.result) == (False, RECORDING)
        await until_settled(robot)
        again = SignResult(liability=contract.address, result=RECORDING, success=True)
        assert isinstance(await asker.ask("sign/result", again), Published)
        assert await waiting(robot) == [], "the result of an ended contract is not kept"


async def test_a_result_without_a_contract_is_published_once(place: Place, opened: Asker, ear: Agent) -> None:
    """As a sensor answers a demand without a price: nothing on the chain confirms that it arrived."""
    request = SignResult(liability=ear.address, result=RECORDING, success=True)
    async with hearing(opened.agent, Result, ear) as results:
        published = await opened.ask("sign/result", request)
        verified = await heard(results)
    assert (verified.signer, verified.hash.hex()) == (opened.agent.address, published.hash)
    assert (verified.message.liability, verified.message.result) == (ear.address, RECORDING)
    assert await waiting(opened.agent) == []


@pytest.mark.sample("generation")
@GENERATIONS
async def test_a_signed_order_is_published_unchanged(place: Place, opened: Asker, ear: Agent, generation: int) -> None:
    demand = demand_of(place, ear, generation=generation)
    async with hearing(opened.agent, Demand, ear) as demands:
        published = await opened.ask("send/demand", SendDemand.of(demand))
        assert await heard(demands) == Verified(demand, message_hash(demand), place.address("person"))
    assert published == Published(message_hash(demand).hex())


async def test_signed_offers_and_results_are_published_too(place: Place, opened: Asker, ear: Agent) -> None:
    signer = place.market.accounts["person"].signer
    fields = msgspec.structs.asdict(demand_of(place, ear))
    del fields["validator_fee"], fields["signature"]
    offer = signer.sign(Offer(**fields, lighthouse_fee=7))
    result = signer.sign(Result(liability=ear.address, result=RECORDING, success=True))
    for service, request, message in (
        ("send/offer", SendOffer.of(offer), offer),
        ("send/result", SendResult.of(result), result),
    ):
        async with hearing(opened.agent, type(message), ear) as messages:
            await opened.ask(service, request)
            assert (await heard(messages)).message == message


async def test_names_in_a_signed_order_are_looked_up(place: Place, opened: Asker, ear: Agent) -> None:
    """The signature is of the addresses."""
    demand = demand_of(place, ear)
    named = msgspec.structs.replace(SendDemand.of(demand), lighthouse=ear.channel.lighthouse.upper())
    async with hearing(opened.agent, Demand, ear) as demands:
        await opened.ask("send/demand", named)
        assert (await heard(demands)).message == demand


def forged(message: SignedMessage) -> Any:
    """The same message with an invalid signature."""
    return msgspec.structs.replace(message, signature="00" * 65)


async def test_only_messages_with_valid_signatures_are_published(place: Place, opened: Asker, ear: Agent) -> None:
    demand = demand_of(place, ear, generation=5)
    line = await opened.refused("send/demand", SendDemand.of(forged(demand)))
    assert "signature" in line
    other = msgspec.structs.replace(demand, cost=1)
    assert "sender" in await opened.refused("send/demand", SendDemand.of(other))
    nonce = msgspec.structs.replace(SendDemand.of(demand), nonce="0x12")
    assert "decimal digits" in await opened.refused("send/demand", nonce)


async def test_orders_of_other_lighthouses_and_expired_orders_are_refused(
    place: Place, opened: Asker, ear: Agent
) -> None:
    elsewhere = demand_of(place, ear, lighthouse=place.market.deployment.xrt)
    line = await opened.refused("send/demand", SendDemand.of(elsewhere))
    assert line.startswith(f"this agent trades on {ear.channel.address}")
    assert place.market.deployment.xrt in line
    asked = terms(place, ear, lighthouse=place.market.deployment.xrt)
    assert "trades on" in await opened.refused("sign/demand", SignDemand(**asked, validator_fee=0))
    late = terms(place, ear, deadline=1)
    assert "deadline is block 1" in await opened.refused("sign/offer", SignOffer(**late, lighthouse_fee=0))
    assert await waiting(opened.agent) == []


async def test_orders_whose_validator_is_a_lighthouse_are_refused(place: Place, opened: Asker, ear: Agent) -> None:
    lighthouses = place.chains["provider"].lighthouses
    trap = (await lighthouses.create(minimal_stake=XRT, timeout_blocks=5, name="services")).lighthouse
    asked = terms(place, ear, validator=trap)
    for kind, order in (
        ("sign/offer", SignOffer(**asked, lighthouse_fee=0)),
        ("sign/demand", SignDemand(**asked, validator_fee=0)),
        ("send/demand", SendDemand.of(demand_of(place, ear, validator=trap))),
    ):
        assert trap in await opened.refused(kind, order)
    assert await waiting(opened.agent) == []


async def test_the_refusal_of_an_invalid_order_names_its_field(place: Place, opened: Asker, ear: Agent) -> None:
    asked = SignDemand(**terms(place, ear, objective="the kitchen"), validator_fee=0)
    assert "objective" in await opened.refused("sign/demand", asked)
    asked = SignDemand(**terms(place, ear, model="dance.model.3.robonomics.eth"), validator_fee=0)
    assert "'dance.model.3.robonomics.eth' is not known" in await opened.refused("sign/demand", asked)
