"""A reorganisation reverts a contract: it is created again, and its job is done and paid once."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.ledger import Phase
from mesh.watching import status_of
from schemas.status import Status
from tests.mesh.agent.conftest import without_permits  # noqa: F401
from tests.support.cli.site import FEE, Site, has_event, has_traceback
from tests.support.log_events import logged_facts
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.agent import Agent
    from mesh.chain import Chain
    from schemas import Demand, Liability, Verified
    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

COST = 500
TIMEOUT = 60.0


async def request(chain: Chain, method: str, *parameters: Any) -> Any:
    return await chain.node.request(method, *parameters)


def waiting_robot(site: Site, may_work: asyncio.Event, incoming: list[str], done: list[str]) -> Agent:
    """A robot that offers to do every demand, works when `may_work` is set, and records liabilities and words."""
    robot = site.agent("robot")

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand, lighthouse_fee=FEE)

    @robot.on_liability
    async def phase(phase: Phase, liability: Liability) -> None:
        if phase is Phase.INCOMING:
            incoming.append(liability.address)

    @robot.on("/say")
    async def say(job: object, message: Any) -> None:
        await may_work.wait()
        done.append(message.data)

    return robot


async def has_read(site: Site, person: Agent, block: int) -> bool:
    """Whether the provider has read the chain up to that block: what it has not read is not reverted for it."""
    session = person.parts.network.session
    found = await status_of(session, site.address("provider"), site.lighthouse)
    return any(isinstance(status, Status) and status.head >= block for status in found)


async def test_a_reverted_contract_is_created_again_and_its_job_paid_once(
    anvil: Anvil, router: EmbeddedRouter, tmp_path: Path
) -> None:
    site = await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path)
    may_work = asyncio.Event()
    incoming: list[str] = []
    done: list[str] = []
    robot = waiting_robot(site, may_work, incoming, done)

    async with site.provider() as provider, robot, site.agent("person") as person, asyncio.timeout(3 * TIMEOUT):
        chain = person.parts.chain
        before = await chain.tokens.balance(site.address("robot"))
        contract = await person.demand(site.job("once"), cost=COST)
        first = contract.address
        await until(lambda: incoming == [first], what="the job", seconds=TIMEOUT)
        await until_found(lambda: robot.parts.ledger.job(first), what="the job in the ledger", seconds=TIMEOUT)
        block = await chain.block_number()
        await until_found(lambda: has_read(site, person, block), what="the provider's block", seconds=TIMEOUT)

        await request(chain, "anvil_reorg", 1, [])
        await request(chain, "evm_mine")
        await until(
            lambda: has_event(provider, "chain-reorganised", events="1"), what="the reorganisation", seconds=TIMEOUT
        )
        await until(lambda: len(incoming) == 2, what="the contract created again", seconds=TIMEOUT)
        assert await robot.parts.ledger.job(first) is None or contract.address == first
        may_work.set()

        assert (await contract.outcome()).success
        assert contract.address == incoming[-1]
        assert done == ["once"]
        (made,) = await chain.liabilities.list(promisee=site.address("person"))
        assert (made.address, made.is_finalized, made.is_success) == (contract.address, True, True)
        assert await chain.tokens.balance(site.address("robot")) == before + COST - FEE
        assert not has_traceback(provider)


@pytest.mark.full
@pytest.mark.usefixtures("without_permits")
async def test_orders_are_sent_again_only_with_their_allowance_when_a_reorganisation_reverted_it(
    anvil: Anvil, router: EmbeddedRouter, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    site = await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path)
    async with site.chain("person") as chain:
        await chain.tokens.approve(chain.factory, 0)
        founded = await chain.block_number()
    caplog.set_level("INFO")
    may_work = asyncio.Event()
    incoming: list[str] = []
    done: list[str] = []
    robot = waiting_robot(site, may_work, incoming, done)

    async with site.provider(), robot, site.agent("person") as person, asyncio.timeout(3 * TIMEOUT):
        chain = person.parts.chain
        contract = await person.demand(site.job("again"), cost=COST)
        await until(lambda: len(incoming) == 1, what="the job", seconds=TIMEOUT)
        await until_found(lambda: robot.parts.ledger.job(incoming[0]), what="the job in the ledger", seconds=TIMEOUT)
        approved = len(logged_facts(caplog, "allowance-approved"))

        await request(chain, "anvil_reorg", await chain.block_number() - founded, [])
        await request(chain, "evm_mine")
        await until(lambda: len(incoming) == 2, what="the contract created again", seconds=TIMEOUT)
        assert len(logged_facts(caplog, "allowance-approved")) > approved
        may_work.set()
        assert (await contract.outcome()).success
        assert done == ["again"]


@pytest.mark.usefixtures("without_permits")
async def test_the_allowance_of_an_open_order_is_ensured_again_when_a_reorganisation_reverted_it(
    anvil: Anvil, router: EmbeddedRouter, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """No contract is reverted, so nothing else shows the order's maker that it can't pay any more."""
    caplog.set_level("INFO")
    site = await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path)
    async with site.chain("person") as chain:
        await chain.tokens.approve(chain.factory, 0)
        founded = await chain.block_number()

    async with site.agent("person") as person, asyncio.timeout(TIMEOUT):
        chain = person.parts.chain

        async def is_allowed() -> bool:
            return await chain.tokens.allowance(site.address("person"), chain.factory) >= COST

        order = await person.order(site.job("waits"), cost=COST)
        assert await is_allowed()
        await until(lambda: person.parts.chain_head.head > founded, what="the head", seconds=TIMEOUT)
        approved = len(logged_facts(caplog, "allowance-approved"))
        await request(chain, "anvil_reorg", await chain.block_number() - founded, [])
        await request(chain, "evm_mine")
        await until(lambda: len(logged_facts(caplog, "allowance-approved")) > approved, what="it", seconds=TIMEOUT)
        await until_found(is_allowed, what="the allowance", seconds=TIMEOUT)
        await order.withdraw()
