"""Rejections that may be untrue, and contracts that the chain takes back."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace

from mesh.agent.agent import Agent
from mesh.agent.contracts import LiabilityReverted
from mesh.agent.orders import REPEATED, OrderExpired, OrderState
from mesh.chain import Chain, Timing
from mesh.chain._validators import Validators
from mesh.chain.liabilities import Liabilities
from mesh.network import Endpoints, Network
from schemas import Demand, Offer, RejectKey, cid_of_bytes, cid_of_file, decode, message_hash
from schemas.signing import Rejection
from tests.support.agent.trades import OBJECTIVE, all_posted, job, known, posted, waiting, working
from tests.support.log_events import logged_facts
from tests.support.market import MODEL, Place
from tests.support.waiting import until, until_found, until_heard

if TYPE_CHECKING:
    from mesh.agent.contracts import Progress


async def test_a_demand_without_a_match_expires_at_its_deadline(place: Place) -> None:
    async with place.provider(), place.agent("person") as person:
        deadline = await place.chains["person"].block_number() + 5
        demand = asyncio.create_task(person.demand(OBJECTIVE, lifetime=5))
        await posted(person)
        await place.node.mine(4)
        head = deadline - 1
        await until(lambda: person.parts.chain_head.head >= head)
        assert not demand.done()
        await place.node.mine(1)
        with pytest.raises(OrderExpired) as caught:
            await demand
        assert caught.value.deadline == deadline
        assert await waiting(person) == []


async def test_a_rejection_is_information_and_the_order_stays_valid(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    """A provider says that it can't use the demand; a robot offers later, and the contract is created."""
    heard: list[Progress] = []
    async with place.agent("person") as person, Network(Endpoints(connect=(place.endpoint,))) as network:
        demand = asyncio.create_task(person.demand(cid_of_file(job(place)), on_progress=heard.append))
        await posted(person)
        (order,) = person.orders()
        key = str(RejectKey(person.channel.lighthouse, place.address("person")))
        await until_heard(network.session, key)
        for _ in range(2):
            network.session.put(key, rejection(place, "provider", order.hash).encode())
        await until(lambda: heard)
        facts = {"order": order.hash, "provider": place.address("provider"), "reason": "Unwanted"}
        assert facts in logged_facts(caplog, "order-rejected")
        assert not demand.done()
        again: list[Progress] = []
        waiting_too = asyncio.create_task(order.contract(on_progress=again.append))
        await until(lambda: again == heard)
        async with place.provider(), working(place.agent("robot")):
            contract = await demand
            assert (await waiting_too).address == contract.address
        kinds = [progress.kind for progress in heard if progress.kind != "offer"]
        assert kinds == ["rejected", "contract"]
        assert (await place.chains["person"].liabilities.get_with_orders(contract.address))[1][0].hex() == order.hash


async def test_the_reason_of_the_contracts_is_reported(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """To agents that sign what the contracts refuse."""

    async def unchecked(validators: Validators, order: object) -> None:
        pass

    monkeypatch.setattr(Validators, "check", unchecked)
    robot = working(place.agent("robot"))
    heard: list[Progress] = []
    async with place.provider(), robot, place.agent("person", generation=5) as person:
        wanted = person.demand(
            OBJECTIVE, validator=place.address("provider"), validator_fee=0, on_progress=heard.append
        )
        demand = asyncio.create_task(wanted)
        await until(lambda: any(progress.kind == "rejected" for progress in heard))
        (rejected,) = (progress for progress in heard if progress.kind == "rejected")
        assert (rejected.code, rejected.agent) == ("ValidatorWithoutCode", place.address("provider"))
        assert not demand.done()
        assert await waiting(person) == ["demand"]
        demand.cancel()
        await asyncio.wait([demand])


async def test_nonces_that_a_reorganisation_freed_do_not_keep_the_next_order_waiting(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each account's orders count up in generation 5, and the earlier orders have expired."""
    async with (
        place.provider(),
        working(place.agent("robot", generation=5)),
        place.agent("person", generation=5) as person,
    ):
        liabilities = person.parts.chain.liabilities
        free = await liabilities.next_nonce()

        async def before_the_reorganisation(
            liabilities: Liabilities, address: str | None = None, **_block: object
        ) -> int:
            return free + 2

        with monkeypatch.context() as patch:
            patch.setattr(Liabilities, "next_nonce", before_the_reorganisation)
            order = await person.order(OBJECTIVE, cost=7)
        contract = await order.contract()
        assert (await place.chains["person"].liabilities.get_with_orders(contract.address))[1][0].hex() == order.hash
        assert await liabilities.next_nonce() == free + 3


def rejection(place: Place, role: str, order: str, *, reason: str = "Unwanted") -> Rejection:
    """What an account says of an order."""
    account = place.market.accounts[role]
    unsigned = Rejection(order=order, reason=reason, detail="go away", provider=account.address)
    return unsigned.signed_by(account.signer)


def untrue_rejections(place: Place, order: str) -> list[Rejection]:
    """For another order; unsigned or signed by another account; by an account that is not a provider."""
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
        (identity,) = (order.hash for order in person.orders())
        key = str(RejectKey(person.channel.lighthouse, place.address("person")))
        await until_heard(stranger.session, key)
        stranger.session.put(key, b"no rejection at all")
        for untrue in untrue_rejections(place, identity):
            stranger.session.put(key, untrue.encode())
        arrived: list[object] = []
        with person.parts.network.session.declare_subscriber("last", arrived.append):
            await until(lambda: stranger.session.put("last", b"") or arrived)
        assert not demand.done()
        ignored = {"signer": place.address("robot"), "reason": "Unwanted"}
        await until(lambda: ignored in logged_facts(caplog, "rejection-ignored"))
        assert not demand.done()
        assert logged_facts(caplog, "order-rejected") == []
        stranger.session.put(key, rejection(place, "provider", identity).encode())
        await until(lambda: logged_facts(caplog, "order-rejected"))
        demand.cancel()
        await asyncio.wait([demand])


async def test_a_rejection_of_an_order_that_became_a_contract_is_ignored(place: Place) -> None:
    """Another provider was quicker, and this one says so before the person has read of the contract on the chain.

    A person of generation 5 would sign a second demand, and pay for two contracts.
    """
    slowly, me = Timing(poll_interval=2.0), place.market.accounts["person"]
    settings = place.settings("person", generation=5)
    chain = Chain(place.node.provider, account=me, contracts=place.market.deployment.contracts, timing=slowly)
    async with (
        chain,
        Agent(MODEL, settings=settings, account=me, chain=chain) as person,
        working(place.agent("robot")),
        Network(Endpoints(connect=(place.endpoint,))) as network,
    ):
        before = await chain.liabilities.next_nonce(me.address)
        demand = asyncio.create_task(person.demand(OBJECTIVE))
        await posted(person)
        (identity,) = (order.hash for order in person.orders())
        key = str(RejectKey(person.channel.lighthouse, place.address("person")))
        await until_heard(network.session, key)
        async with place.provider() as provider:
            await until(lambda: provider.earnings().created == 1)
            network.session.put(key, rejection(place, "provider", identity, reason="WrongSigner").encode())
            contract = await demand
        demand_hash, _ = (await chain.liabilities.get_with_orders(contract.address))[1]
        assert demand_hash.hex() == identity
        assert await chain.liabilities.next_nonce(me.address) == before + 1


async def test_an_order_is_sent_again_to_a_provider_whose_book_was_full(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    async with place.agent("person") as person, Network(Endpoints(connect=(place.endpoint,))) as network:
        demand = asyncio.create_task(person.demand(cid_of_file(job(place))))
        await posted(person)
        (identity,) = (order.hash for order in person.orders())
        key = str(RejectKey(person.channel.lighthouse, place.address("person")))
        await until_heard(network.session, key)
        network.session.put(key, rejection(place, "provider", identity, reason="full").encode())
        await until(lambda: logged_facts(caplog, "order-deferred"))
        assert await waiting(person) == ["demand"]
        async with place.provider(), working(place.agent("robot")):
            assert (await demand).liability.promisee == place.address("person")


async def test_orders_of_a_reverted_contract_are_sent_again(place: Place) -> None:
    """The provider that created it is gone, and another one does not know the orders."""
    async with working(place.agent("robot", fetch_timeout=60.0)) as robot, place.agent("person") as person:
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


async def test_a_reverted_contract_that_is_not_created_again_fails_at_its_deadline(place: Place) -> None:
    async with working(place.agent("robot", fetch_timeout=60.0)) as robot, place.agent("person") as person:
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
            with pytest.raises(LiabilityReverted) as caught:
                await asyncio.wait_for(outcome, 30)
            assert caught.value.liability == contract.address
        with pytest.raises(LiabilityReverted):
            await contract.recording()
        assert len(person.runtime.trader.contracts) == 0


async def test_a_contract_that_is_created_again_does_not_fail_at_the_deadline(place: Place) -> None:
    async with working(place.agent("robot", fetch_timeout=60.0)) as robot, place.agent("person") as person:
        async with place.provider():
            contract = await person.demand(cid_of_bytes(b"a job that is made twice"), lifetime=50)
            await known(robot, contract.address)
        outcome = asyncio.create_task(contract.outcome())
        await place.forget_blocks(1)
        await until_found(lambda: all_posted(person, 1), what="the demand posted again")
        async with place.provider():
            await until_found(lambda: all_posted(person, 0))
        await place.node.mine(60)
        head = await place.chains["person"].block_number()
        await until(lambda: person.parts.chain_head.head >= head)
        assert not outcome.done()
        outcome.cancel()


async def test_a_contract_on_equal_terms_of_another_signer_leaves_our_demand_open(place: Place) -> None:
    """The other signer copies the demand with its nonce, so its hash is the same, and takes an offer of the person."""
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
        made = await chain.liabilities.create(place.market.deployment.lighthouse, stolen, offer)
        assert (await chain.liabilities.get_with_orders(made.liability))[1][0] == message_hash(ours)

        head = await chain.block_number()
        await until(lambda: person.parts.chain_head.head >= head)
        assert not demanding.done()
        assert await waiting(person) == ["demand"]
        demanding.cancel()
        await asyncio.wait([demanding])


async def test_an_offer_that_can_not_be_signed_again_does_not_stop_the_agent(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    """One of two offers of generation 5 was taken; for the fee of the other one the robot has too little by then."""
    everything = await place.balance("robot")
    async with place.agent("robot", generation=5) as robot, place.agent("person", generation=5) as person:
        await robot.offer(objective=OBJECTIVE)
        await robot.offer(objective=cid_of_bytes(b"something dear"), lighthouse_fee=everything)
        await place.chains["robot"].tokens.transfer(place.address("person"), 5)
        async with place.provider():
            await person.demand(OBJECTIVE)
            await until(lambda: logged_facts(caplog, "order-abandoned"))
            await until_found(lambda: all_posted(robot, 0))
            again = cid_of_bytes(b"something else")
            await robot.offer(objective=again)
            assert (await person.demand(again)).liability.promisor == place.address("robot")
    await place.chains["person"].tokens.transfer(place.address("robot"), 5)


@pytest.mark.usefixtures("without_permits")
async def test_an_earlier_version_of_an_order_that_a_reorganisation_makes_valid_is_that_order(place: Place) -> None:
    """Generation 5: the order was signed again, because the contract of another one had used its nonce."""
    robot, provider = place.market.accounts["robot"], place.chains["provider"]
    lighthouse = place.market.deployment.lighthouse

    async def create(demand: Demand | Offer) -> None:
        assert isinstance(demand, Demand)
        ours = {field: getattr(demand, field) for field in (*REPEATED, "deadline")}
        nonce = await provider.liabilities.next_nonce(robot.address)
        offer = robot.signer.sign(Offer(**ours | {"sender": robot.address}, nonce=nonce, lighthouse_fee=0))
        await provider.liabilities.create(lighthouse, demand, offer)

    async with place.agent("person", generation=5) as person:
        order = await person.order(OBJECTIVE, cost=7)
        other = await person.order(OBJECTIVE, cost=8)
        earlier, blocks = order.message, await provider.block_number()
        await create(other.message)
        await until(lambda: order.hash not in {one.hash for one in person.orders()})
        await place.forget_blocks(await provider.block_number() - blocks)
        await until(lambda: other.hash in {one.hash for one in person.orders()})
        await create(earlier)
        contract = await asyncio.wait_for(order.contract(), 60)
        assert (await provider.liabilities.get_with_orders(contract.address))[1][0].hex() == message_hash(earlier).hex()
        await until(lambda: [one.message.cost for one in person.orders(OrderState.OPEN)] == [8])
