"""People without ether: they order by a signature, and never send a transaction."""

from __future__ import annotations

import asyncio
import secrets
import sqlite3
from contextlib import asynccontextmanager, closing
from typing import TYPE_CHECKING, Literal

import pytest

from mesh import Progress
from mesh.amounts import XRT as XRT_UNIT
from mesh.chain import Account, DeploymentPlan
from mesh.chain.deploy import XRT
from mesh.errors import InputError
from mesh.network import call
from mesh.testing import MarketChain
from schemas import Demand
from schemas.rpc import PermitFeeRequest
from tests.support.agent.restarts import COST, SAYING, speaking
from tests.support.agent.trades import job, working
from tests.support.market import MODEL, Place, offering
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh import Agent
    from mesh.agent.agent import DemandTerms
    from tests.support.routers import EmbeddedRouter

GENERATIONS = pytest.mark.parametrize("generation", [3, 5])
FUNDS = 100 * XRT


@asynccontextmanager
async def penniless(place: Place, generation: Literal[3, 5]) -> AsyncIterator[Agent]:
    """A person with XRT and without ether, which it must not have or need at any time."""
    key = secrets.token_bytes(32)
    account = Account(key)
    await place.chains["provider"].tokens.transfer(account.address, FUNDS)
    async with place.another(key, generation=generation) as penniless:
        async with penniless as person:
            chain = person.chain
            yield person
        assert await chain.tokens.eth_balance() == 0
        assert await chain.node.transaction_count(account.address, block="pending") == 0


@pytest.mark.sample("generation")
@GENERATIONS
@pytest.mark.parametrize("is_alone", [False, True])
async def test_a_person_without_ether_gets_a_job_done(place: Place, generation: Literal[3, 5], is_alone: bool) -> None:
    async with (
        place.provider() as provider,
        working(place.agent("robot")) as robot,
        penniless(place, generation) as person,
        asyncio.timeout(60),
    ):
        named = robot.address if is_alone else ""
        for cost in (21, 300 * 1000):
            contract = await person.demand(job(place), cost=cost, robot=named)
            assert (await contract.outcome()).success
        tokens = person.chain.tokens
        assert await tokens.balance() == FUNDS - 21 - 300 * 1000
        assert await tokens.allowance(person.address, person.chain.factory) == 0
        assert provider.earnings().created == 2


async def test_nobody_is_told_of_a_permit_that_comes_a_moment_after_its_demand(place: Place) -> None:
    heard: list[Progress] = []
    async with place.provider(), working(place.agent("robot")), penniless(place, 3) as person, asyncio.timeout(60):
        outbox = person.parts.outbox
        permit_for, outbox.permit_for = outbox.permit_for, lambda _demand: None
        order = await person.order(job(place), cost=21)
        waiting = asyncio.create_task(order.contract(on_progress=heard.append))
        await asyncio.sleep(0.3)
        outbox.permit_for = permit_for
        own = person.chain.permits.own(person.chain.xrt)
        assert own is not None
        person.channel.publish(own)
        assert (await (await waiting).outcome()).success
    assert "rejected" not in [progress.kind for progress in heard]


@pytest.mark.sample("generation")
@GENERATIONS
async def test_orders_at_once_share_a_permit(place: Place, generation: Literal[3, 5]) -> None:
    async with (
        place.provider(),
        working(place.agent("robot")),
        penniless(place, generation) as person,
        asyncio.timeout(90),
    ):
        costs = (10, 200, 3000)
        contracts = await asyncio.gather(*(person.demand(job(place), cost=cost) for cost in costs))
        assert all([(await contract.outcome()).success for contract in contracts])
        assert await person.chain.tokens.balance() == FUNDS - sum(costs)


FEE = 40_000


@pytest.mark.sample("generation")
@GENERATIONS
async def test_the_provider_is_paid_for_the_permit(place: Place, generation: Literal[3, 5]) -> None:
    async with (
        place.provider() as provider,
        working(place.agent("robot")),
        penniless(place, generation) as person,
        asyncio.timeout(60),
    ):
        had, cost = await place.balance("provider"), 5
        contract = await person.demand(job(place), cost=cost, permit_fee=f"{FEE}wn")
        assert contract.liability.validator_fee == FEE
        assert (await contract.outcome()).success
        await until(lambda: provider.earnings().finalized == 1)
        earned = provider.earnings()
        assert earned.fees == FEE
        assert await place.balance("provider") == had + FEE + earned.minted
        assert await person.chain.tokens.balance() == FUNDS - cost - FEE
        (entry,) = (await person.statement()).entries
        assert (entry.spent, entry.fee) == (cost + FEE, 0)


@pytest.mark.sample("generation")
@GENERATIONS
async def test_the_fee_that_a_provider_wants_is_the_least_that_it_takes(
    place: Place, generation: Literal[3, 5]
) -> None:
    cost, heard = 5, list[Progress]()
    async with (
        place.provider(free_contracts=0) as provider,
        working(place.agent("robot")),
        penniless(place, generation) as person,
        asyncio.timeout(60),
    ):
        wanted = PermitFeeRequest(maker=person.address, generation=generation, token=person.chain.xrt, cost=cost)
        fee = int((await call(person.network.session, provider.address, "permit-fee", wanted)).fee)
        order = await person.order(job(place), cost=cost, permit_fee=fee - 1)
        waiting = asyncio.create_task(order.contract(on_progress=heard.append))
        await until(lambda: any(one.code == "unpaid" for one in heard))
        rejected = next(one for one in heard if one.code == "unpaid")
        assert f"a permit fee of {XRT_UNIT.show(fee)} (--permit-fee)" in rejected.detail
        waiting.cancel()
        contract = await person.demand(job(place), cost=cost, permit_fee=fee)
        assert (await contract.outcome()).success
        assert provider.earnings().fees == fee
        await order.withdraw()


async def test_a_permit_is_signed_for_the_fee_also_if_the_cost_is_approved(place: Place) -> None:
    async with (
        place.provider() as provider,
        working(place.agent("robot")),
        place.agent("person") as person,
        asyncio.timeout(60),
    ):
        await person.chain.tokens.approve(person.chain.factory, FUNDS)
        contract = await person.demand(job(place), cost=5, permit_fee=FEE)
        assert (await contract.outcome()).success
        assert provider.earnings().fees == FEE


async def test_a_fee_without_a_permit_is_not_charged(place: Place) -> None:
    """As demands of the legacy network may have one: the contracts took it for nothing there."""
    async with (
        place.provider() as provider,
        working(place.agent("robot")),
        place.agent("person") as person,
        asyncio.timeout(60),
    ):
        await person.chain.tokens.approve(person.chain.factory, FUNDS)
        had, cid = await place.balance("person"), await person.add(job(place))
        terms = await person.runtime.trader.writer.terms(
            model=MODEL, objective=cid, cost=5, token="", validator="", lifetime=500
        )
        demand = await person.runtime.trader.writer.sign(Demand, terms, validator_fee=FEE)
        await person.parts.outbox.post(demand)
        await until(lambda: provider.earnings().finalized == 1)
        assert provider.earnings().fees == 0
        assert await place.balance("person") == had - 5
        entry = (await person.statement()).entries[-1]
        assert (entry.spent, entry.liability.validator_fee) == (5, FEE)
        await person.chain.tokens.approve(person.chain.factory, 0)


@pytest.mark.parametrize("terms", [{"permit_fee": 1, "validator": "0x" + "11" * 20}, {"validator_fee": 1}])
async def test_a_demand_has_one_fee(place: Place, terms: DemandTerms, person: Agent) -> None:
    with pytest.raises(InputError) as refused:
        await person.order(job(place), **terms)
    assert refused.value.code == "fee-misplaced"


@pytest.mark.usefixtures("without_permits")
async def test_a_fee_for_a_permit_needs_a_token_with_permits(place: Place, person: Agent) -> None:
    with pytest.raises(InputError) as refused:
        await person.order(job(place), cost=5, permit_fee=1)
    assert refused.value.code == "token-without-permits"


REFUND_DELAY = 40


@pytest.fixture
async def impatient(router: EmbeddedRouter, tmp_path: Path) -> AsyncIterator[Place]:
    """A market whose contracts can be refunded soon."""
    plan = DeploymentPlan(timeout_blocks=10, refund_delay=REFUND_DELAY)
    async with MarketChain(plan) as chain, Place(chain, router.endpoint, tmp_path) as place:
        yield place


@pytest.mark.parametrize("is_restarted", [False, True])
async def test_the_provider_takes_back_what_nobody_earned(impatient: Place, tmp_path: Path, is_restarted: bool) -> None:
    place, said = impatient, list[str]()
    async with speaking(offering(place.agent("robot")), said, stuck_at="3"), penniless(place, 3) as person:
        tokens = person.chain.tokens
        async with place.provider(store=tmp_path / "provider.sqlite"):
            contract = await person.demand(SAYING, cost=COST)
            await until(lambda: len(said) == 3)
            assert await tokens.balance() == FUNDS - COST
            if not is_restarted:
                await place.node.mine(REFUND_DELAY)
                await until_found(lambda: is_back(place, person), what="the cost")
                await until(lambda: kept(tmp_path / "provider.sqlite") == 0)
        if is_restarted:
            assert kept(tmp_path / "provider.sqlite") == 1
            await place.node.mine(REFUND_DELAY)
            async with place.provider(store=tmp_path / "provider.sqlite"):
                await until_found(lambda: is_back(place, person), what="the cost")
                await until(lambda: kept(tmp_path / "provider.sqlite") == 0)
        assert (await contract.outcome()).code == "no-result"


def kept(store: Path) -> int:
    """How many contracts a provider's file has that were created with a permit and are open."""
    with closing(sqlite3.connect(store)) as database:
        return int(database.execute("SELECT count(*) FROM permitted").fetchone()[0])


async def is_back(place: Place, person: Agent) -> bool:
    await place.node.mine(1)
    return await person.chain.tokens.balance() == FUNDS
