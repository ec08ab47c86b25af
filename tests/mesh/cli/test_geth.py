"""Whole jobs on geth by the rules of today's Ethereum: by permit, refunded, judged, while it is killed."""

from __future__ import annotations

import asyncio
import secrets
from typing import TYPE_CHECKING, Any, Final

import pytest

from mesh.chain import Account
from mesh.chain.deploy import DeploymentPlan
from schemas import Result
from tests.support.cli.site import FEE, GENERATION_5, Site, has_event
from tests.support.nodes import Geth
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.agent.agent import Agent
    from schemas import Demand, Verified
    from tests.support.routers import EmbeddedRouter

COST: Final = 700
PERMIT_FEE: Final = 40
REFUND_DELAY: Final = 30
"""Blocks."""
TIMEOUT: Final = 120.0


@pytest.fixture(scope="module")
def geth(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Geth]:
    """A node with the contracts, which mines a block each second."""
    plan = DeploymentPlan(timeout_blocks=100, refund_delay=REFUND_DELAY)
    with Geth() as node:
        asyncio.run(Site.found(node.url, node.private_keys, "", tmp_path_factory.mktemp("geth"), plan=plan))
        node.stop()
        node.block_time = 1
        node.start()
        yield node


@pytest.fixture
def site(geth: Geth, router: EmbeddedRouter, tmp_path: Path) -> Site:
    return Site(geth.url, geth.private_keys, router.endpoint, tmp_path)


async def balances(site: Site) -> tuple[int, int]:
    """What person and robot have, wn."""
    async with site.chain("person") as chain:
        return await chain.tokens.balance(site.address("person")), await chain.tokens.balance(site.address("robot"))


@pytest.mark.parametrize(("generation", "endpoint"), [(3, "http"), (5, "websocket")])
async def test_a_job_is_done_and_paid_once(geth: Geth, site: Site, generation: int, endpoint: str) -> None:
    options: dict[str, Any] = GENERATION_5 | {"generation": 5} if generation == 5 else {}
    site.url = geth.url if endpoint == "http" else geth.ws_url
    done: list[str] = []
    before = await balances(site)
    async with (
        asyncio.timeout(TIMEOUT),
        site.provider(),
        site.robot(done, **options),
        site.agent("person", **options) as person,
    ):
        contract = await person.demand(site.job("once"), cost=COST)
        outcome = await contract.outcome()
    assert outcome.success
    assert done == ["once"]
    after = await balances(site)
    assert after == (before[0] - COST, before[1] + COST - FEE)


@pytest.mark.parametrize("generation", [3, 5])
async def test_a_person_without_ether_has_a_job_done_by_permit(site: Site, generation: int) -> None:
    options: dict[str, Any] = GENERATION_5 | {"generation": 5} if generation == 5 else {}
    site.accounts["penniless"] = account = Account(secrets.token_bytes(32))
    async with site.chain("person") as chain:
        first = await chain.block_number()
        await chain.tokens.transfer(account.address, COST + PERMIT_FEE)
    done: list[str] = []
    paid = (await balances(site))[1]
    async with (
        asyncio.timeout(TIMEOUT),
        site.provider() as provider,
        site.robot(done, **options),
        site.agent("penniless", **options) as person,
    ):
        chain = person.parts.chain
        assert await chain.tokens.allowance(account.address, chain.factory) == 0
        contract = await person.demand(site.job("permitted"), cost=COST, permit_fee=PERMIT_FEE)
        assert (await contract.outcome()).success
        assert done == ["permitted"]
        assert has_event(provider, "contract-created", liability=contract.address, permit_fee=str(PERMIT_FEE))
        assert await chain.tokens.balance() == 0
        assert await chain.node.transaction_count(account.address, block="pending") == 0
        for block in range(first, await chain.block_number() + 1):
            assert await chain.node.request("eth_getBalance", account.address, hex(block)) == "0x0"
    assert (await balances(site))[1] == paid + COST - FEE


async def test_a_validator_judges_and_pays(site: Site) -> None:
    async with site.chain("rival") as chain:
        await chain.validators.introduce()
    before, validator = await balances(site), site.address("rival")
    async with (
        asyncio.timeout(TIMEOUT),
        site.provider(),
        site.robot([]),
        site.agent("person") as person,
        site.agent("rival") as judge,
        judge.channel.subscribe(Result) as results,
    ):
        contract = await person.demand(site.job("judged"), cost=COST, validator=validator, validator_fee=0)
        result = (await anext(aiter(results))).message
        assert result.liability == contract.address
        await judge.parts.chain.liabilities.validate(result, agree=True)
        assert (await contract.outcome()).success
    assert await balances(site) == (before[0] - COST, before[1] + COST - FEE)


async def test_a_robot_that_vanishes_is_refunded(site: Site) -> None:
    before = await balances(site)
    began = asyncio.Event()
    robot = offering(site)

    @robot.on("/say")
    async def say(job: object, message: Any) -> None:
        began.set()
        await asyncio.Event().wait()

    async with asyncio.timeout(TIMEOUT), site.provider(), site.agent("person") as person:
        async with robot:
            contract = await person.demand(site.job("lost"), cost=COST)
            await until(began.is_set, what="the job's begin", seconds=TIMEOUT)
        outcome = await contract.outcome()  # the person's agent takes the money back when it may
    assert not outcome.success
    assert (await balances(site))[0] == before[0]


async def test_a_job_survives_the_kill_of_the_node(geth: Geth, site: Site) -> None:
    done: list[str] = []
    robot, began, may_end = offering(site), asyncio.Event(), asyncio.Event()

    @robot.on("/say")
    async def say(job: object, message: Any) -> None:
        done.append(message.data)
        began.set()
        await may_end.wait()

    before = await balances(site)
    async with asyncio.timeout(2 * TIMEOUT), site.provider(), robot, site.agent("person") as person:
        contract = await person.demand(site.job("survives"), cost=COST)
        await until(began.is_set, what="the job's begin", seconds=TIMEOUT)
        await asyncio.to_thread(geth.kill)
        may_end.set()
        await asyncio.to_thread(geth.start)
        outcome = await contract.outcome()
        made = await person.parts.chain.liabilities.list(promisee=person.address)
    assert outcome.success
    assert set(done) == {"survives"}  # twice if the node lost the block of the contract, which is made again then
    assert [one.address for one in made].count(contract.address) == 1
    assert await balances(site) == (before[0] - COST, before[1] + COST - FEE)


def offering(site: Site) -> Agent:
    """A robot that offers for every demand, without a handler for the job."""
    robot = site.agent("robot")

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand, lighthouse_fee=FEE)

    return robot
