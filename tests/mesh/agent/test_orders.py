"""Open orders: they survive a restart with their allowance, and are withdrawn until they can't be matched any more."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent._runtime import AgentRuntime
from mesh.agent.orders import ORDER_LIFETIME, REPEATED, OrderClosed, OrderState, lifetime_of
from mesh.base.database import LedgerUnusable
from mesh.chain import BlockHeader, InsufficientTokens
from mesh.chain._node import ContractBlocks, Heads
from mesh.chain.answers import Count, Word
from schemas import Demand, Offer, Withdrawal, cid_of_bytes, decode, message_hash
from tests.support.agent.trades import OBJECTIVE, all_posted, job, unsettled, waiting, working
from tests.support.log_events import logged_facts
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.agent.agent import Agent
    from tests.support.market import Place


async def allowance(place: Place, role: str) -> int:
    chain = place.chains[role]
    return await chain.tokens.allowance(place.address(role), chain.factory)


async def withdrawals(agent: Agent) -> list[Withdrawal]:
    """The withdrawals that an agent sends."""
    found = [decode(one.payload) for one in await unsettled(agent) if one.kind == "withdrawal"]
    return [message for message in found if isinstance(message, Withdrawal)]


@pytest.mark.usefixtures("without_permits")
async def test_open_orders_are_taken_up_again_with_their_allowance(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    chain = place.chains["person"]
    async with place.agent("person", enable_executor=False) as person:
        demand = await person.order(cid_of_bytes(b"dear work"), cost=7000)
        other = await person.order(cid_of_bytes(b"cheap work"), cost=11)
    async with place.agent("person", enable_executor=False) as person:
        assert [(order.hash, order.kind, order.state) for order in person.orders()] == [
            (demand.hash, "demand", OrderState.OPEN),
            (other.hash, "demand", OrderState.OPEN),
        ]
        resumed = {facts["order"]: facts["kind"] for facts in logged_facts(caplog, "order-resumed")}
        assert resumed == {demand.hash: "demand", other.hash: "demand"}
        assert person.orders()[0].message == demand.message
        await chain.tokens.approve(chain.factory, 0)
        await person.order(OBJECTIVE, cost=500)
        assert await allowance(place, "person") == 7511
        for order in person.orders():
            await order.withdraw()


@pytest.mark.usefixtures("without_permits")
async def test_resumed_orders_are_not_sent_before_their_allowance_is_ensured(place: Place) -> None:
    chain = place.chains["person"]
    async with place.agent("person") as person:
        order = await person.order(OBJECTIVE, cost=4000)
    await chain.tokens.approve(chain.factory, 0)
    allowed: list[int] = []
    async with place.provider() as provider, place.agent("person") as person:
        await until(lambda: len(provider.book) == 1, what="the demand at the provider")
        allowed.append(await allowance(place, "person"))
        (resumed,) = person.orders()
        await resumed.withdraw()
    assert allowed == [4000]
    assert resumed.hash == order.hash


@pytest.mark.usefixtures("without_permits")
async def test_an_allowance_that_a_provider_misses_is_ensured_again(place: Place) -> None:
    chain = place.chains["person"]

    async def is_ensured() -> bool:
        return await allowance(place, "person") == 4000

    async with place.agent("person") as person:
        order = await person.order(OBJECTIVE, cost=4000)
        await chain.tokens.approve(chain.factory, 0)  # as a reorganisation that the agent does not notice
        async with place.provider() as provider:
            await until_found(is_ensured, what="the allowance")
            await until(lambda: len(provider.book) == 1, what="the demand at the provider")
            await order.withdraw()


async def test_a_resumed_order_that_can_not_be_covered_is_reported(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    async with place.agent("person") as person:
        order = await person.order(OBJECTIVE, cost=4000)
    async with place.agent("person") as person:
        balance = await place.balance("person")
        await place.chains["person"].tokens.transfer(place.address("provider"), balance)
    try:
        await place.chains["person"].tokens.approve(place.chains["person"].factory, 0)
        async with place.agent("person") as person:
            await until(lambda: logged_facts(caplog, "order-not-covered"))
            assert [one.hash for one in person.orders()] == [order.hash]
    finally:
        await place.chains["provider"].tokens.transfer(place.address("person"), balance)


async def test_a_restarted_program_can_wait_for_the_contract_of_its_order(place: Place) -> None:
    async with place.agent("person") as person:
        order = await person.order(job(place), cost=5)
    async with place.provider(), working(place.agent("robot")), place.agent("person") as person:
        (resumed,) = person.orders()
        contract = await resumed.contract()
        assert (await contract.outcome()).success
        demand_hash, _ = (await place.chains["person"].liabilities.get_with_orders(contract.address))[1]
        assert demand_hash.hex() == order.hash
        assert person.orders() == []
        assert (await resumed.contract()).address == contract.address
        with pytest.raises(OrderClosed) as caught:
            await resumed.withdraw()
        assert (caught.value.state, caught.value.liability) == ("matched", contract.address)


async def test_a_withdrawn_order_is_sent_no_more_and_its_withdrawal_until_the_deadline(place: Place) -> None:
    async with place.agent("person") as person:
        order = await person.order(OBJECTIVE, cost=300, lifetime=20)
        contract = asyncio.create_task(order.contract())
        await asyncio.sleep(0)
        withdrawn = await order.withdraw()
        assert (withdrawn.state, withdrawn.hash) == (OrderState.WITHDRAWN, order.hash)
        with pytest.raises(OrderClosed) as caught:
            await contract
        assert caught.value.state == "withdrawn"
        assert await waiting(person) == ["withdrawal"]
        (message,) = await withdrawals(person)
        assert (message.order, message.deadline) == (order.hash, order.deadline)
        assert message.lighthouse == order.message.lighthouse
        assert (await withdrawn.withdraw()).state is OrderState.WITHDRAWN
    async with place.agent("person") as person:
        assert person.orders() == []
        assert [one.hash for one in person.orders(OrderState.WITHDRAWN)] == [order.hash]
        assert await waiting(person) == ["withdrawal"]
        await place.node.mine(20)
        await until(lambda: not person.orders(OrderState.WITHDRAWN))
        await until_found(lambda: all_posted(person, 0))


async def test_a_withdrawal_that_failed_on_the_disk_can_be_repeated(
    place: Place, monkeypatch: pytest.MonkeyPatch, person: Agent
) -> None:
    order = await person.order(OBJECTIVE, cost=300)

    async def full(*_: object) -> None:
        raise LedgerUnusable(place.folder, "database or disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(person.parts.ledger, "withdraw", full)
        with pytest.raises(LedgerUnusable):
            await order.withdraw()
    assert (await order.withdraw()).state is OrderState.WITHDRAWN
    assert await waiting(person) == ["withdrawal"]


async def test_a_provider_confirms_that_it_honours_a_withdrawal(place: Place) -> None:
    async with place.provider() as provider, place.agent("person", enable_executor=False) as person:
        order = await person.order(OBJECTIVE, cost=0)
        await until(lambda: len(provider.book) == 1)
        assert order.honoured_by == frozenset()
        withdrawn = await order.withdraw()
        await until(lambda: withdrawn.honoured_by == {provider.address})
        assert len(provider.book) == 0
        assert withdrawn.state is OrderState.WITHDRAWN


@pytest.mark.usefixtures("without_permits")
async def test_the_allowance_of_a_withdrawn_order_is_kept_and_its_tokens_are_free(place: Place) -> None:
    balance = await place.balance("person")
    async with place.agent("person") as person:
        first = await person.order(OBJECTIVE, cost=balance)
        with pytest.raises(InsufficientTokens):
            await person.order(OBJECTIVE, cost=1)
        await first.withdraw()
        second = await person.order(OBJECTIVE, cost=balance - 1)
        assert await allowance(place, "person") >= 2 * balance - 1
        await second.withdraw()


async def created(place: Place, demand: Demand | Offer) -> str:
    """The contract that the provider creates from a demand and an offer of the robot's."""
    assert isinstance(demand, Demand)
    fields = {field: getattr(demand, field) for field in (*REPEATED, "deadline")}
    offer = place.market.accounts["robot"].signer.sign(Offer(**fields, nonce="ef" * 32, lighthouse_fee=0))
    return (await place.chains["provider"].liabilities.create(demand.lighthouse, demand, offer)).liability


@pytest.mark.usefixtures("without_permits")
async def test_a_withdrawn_order_may_become_a_contract_all_the_same(place: Place, person: Agent) -> None:
    """A provider had the match already. The person's agent knows, and pays once."""
    order = await person.order(OBJECTIVE, cost=3)
    await order.withdraw()
    made = await created(place, order.message)
    await until(lambda: not person.orders(OrderState.WITHDRAWN))
    contract = await order.contract()
    assert contract.address == made
    await place.forget_blocks(1)
    await until(lambda: [one.hash for one in person.orders(OrderState.WITHDRAWN)] == [order.hash])
    assert person.orders() == [], "a reorganisation does not bring it back"
    assert await waiting(person) == ["withdrawal"]


@pytest.mark.sample("generation")
@pytest.mark.parametrize("generation", [3, 5])
async def test_an_order_withdrawn_on_the_chain_is_of_no_use_to_any_provider(place: Place, generation: int) -> None:
    async with place.agent("person", generation=generation) as person:
        order = await person.order(OBJECTIVE, cost=3)
        withdrawn = await order.withdraw_on_chain()
        assert withdrawn.state is OrderState.WITHDRAWN
        assert person.orders(OrderState.OPEN, OrderState.WITHDRAWN) == []
        liabilities = place.chains["person"].liabilities
        if generation == 3:
            assert await liabilities.is_order_used(message_hash(order.message), place.address("person"))
        else:
            assert await liabilities.next_nonce() == int(order.message.nonce) + 1


@pytest.mark.parametrize("generation", [3, 5])
async def test_a_withdrawal_on_the_chain_that_a_reorganisation_reverts_is_made_again(
    place: Place, generation: int
) -> None:
    async with place.agent("person", generation=generation) as person:
        order = await person.order(OBJECTIVE)
        head = await place.chains["person"].block_number()
        await order.withdraw_on_chain()
        mined = await place.chains["person"].block_number()
        await until(lambda: person.parts.chain_head.head >= mined)
        await place.forget_blocks(mined - head)
        digest, signer = message_hash(order.message), place.address("person")
        used = partial(place.chains["person"].liabilities.is_used, order.message, order_hash=digest, signer=signer)
        assert not await used()
        await until_found(used)


@pytest.mark.parametrize("is_own", [True, False])
async def test_an_order_is_signed_again_when_a_withdrawal_has_used_its_nonce(place: Place, is_own: bool) -> None:
    """Robots take it for one that has become a contract, and offer nothing: no provider ever looks at it."""
    async with place.agent("person", generation=5) as person:
        other = await person.order(OBJECTIVE, cost=2)
        order = await person.order(OBJECTIVE, cost=3)
        used = int(order.message.nonce)
        assert int(other.message.nonce) == used, "one of them becomes a contract first"
        if is_own:
            await other.withdraw_on_chain()
        else:  # by a program with another ledger
            await place.chains["person"].liabilities.withdraw(other.message)
        await until(lambda: all(int(one.message.nonce) == used + 1 for one in person.orders()), what="a fresh nonce")
        assert 3 in [one.message.cost for one in person.orders()]


async def test_orders_of_another_program_of_the_account_are_followed_too(place: Place) -> None:
    """Both use one ledger: what one posts and withdraws, the other one learns of."""
    async with place.agent("person") as person, place.agent("person") as other:
        order = await person.order(OBJECTIVE)

        async def is_known() -> bool:
            await place.node.mine(1)  # an agent looks at each block after the one at which it began to listen
            return [one.hash for one in other.orders()] == [order.hash]

        await until_found(is_known)
        await other.orders()[0].withdraw()
        contract = asyncio.create_task(order.contract())
        await place.node.mine(1)
        with pytest.raises(OrderClosed):
            await contract


class Clock:
    """A chain whose blocks came at these times."""

    def __init__(self, times: Sequence[int]) -> None:
        self.times = times
        self.node = self
        self.heads = Heads(self.latest_header, self.header, interval=1.0)
        self.contract_blocks = ContractBlocks(self.heads, self.run_number, interval=1.0)

    async def run_number(self, block: int | str) -> int:
        return int(block)

    async def header(self, number: int) -> BlockHeader | None:
        if number >= len(self.times):
            return None
        block_hash = Word(bytes(32))
        return BlockHeader(
            number=Count(number), timestamp=Count(self.times[number]), hash=block_hash, parent_hash=block_hash
        )

    async def latest_header(self) -> BlockHeader:
        latest = await self.header(len(self.times) - 1)
        assert latest is not None
        return latest


@pytest.mark.parametrize(
    ("times", "blocks"),
    [
        (range(0, 1200, 12), ORDER_LIFETIME.fewest),
        (range(0, 200, 2), ORDER_LIFETIME.seconds / 2),
        ([0, *range(1_700_000_000, 1_700_000_600, 6)], ORDER_LIFETIME.seconds / 6),
        (range(0, 10**7, 10**5), ORDER_LIFETIME.fewest),
        ([0, *([5] * 200)], ORDER_LIFETIME.seconds),
        ([0, *([5] * 99), 6], min(ORDER_LIFETIME.seconds * 99, ORDER_LIFETIME.most)),
        ([7], ORDER_LIFETIME.seconds),
    ],
)
async def test_orders_are_valid_for_minutes(times: Any, blocks: float) -> None:
    chain: Any = Clock(times)
    assert await lifetime_of(chain) == pytest.approx(blocks, rel=0.02)


@pytest.mark.usefixtures("without_permits")
async def test_an_order_that_became_a_contract_and_expired_while_its_program_was_away_is_not_forgotten(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its program had not begun to read the chain."""
    with monkeypatch.context() as patch:
        patch.setattr(AgentRuntime, "_follow_chain", lambda listener: asyncio.Event().wait())
        async with place.agent("person") as person:
            order = await person.order(OBJECTIVE, cost=5, lifetime=4)
    made = await created(place, order.message)
    await place.node.mine(5)
    async with place.agent("person") as person:
        (resumed,) = person.orders()
        assert (await resumed.contract()).address == made
