"""An agent that is stopped in the middle of a job goes on with it, and is paid once."""

from __future__ import annotations

import asyncio
import sqlite3
from contextlib import closing
from typing import TYPE_CHECKING, Any

from mesh.agent.agent import Agent
from mesh.agent.ledger import Ledger, Phase
from mesh.testing import assert_paid
from mesh.testing._market import ALLOWANCE
from schemas import cid_of_bytes
from tests.support.agent.restarts import COST, SAYING, WORDS, Paying, made_by_a_provider_that_leaves, paid, speaking
from tests.support.market import MODEL, in_phase, offering, offering_unseen
from tests.support.objectives import objective
from tests.support.orders import result
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.agent.contracts import Contract
    from mesh.agent.handlers import Job
    from mesh.testing import Market
    from schemas import Liability
    from tests.support.market import Place

__all__ = ["paid"]


async def test_a_ready_job_is_done_after_a_restart(market: Market) -> None:
    said: list[str] = []
    async with market.robot(offering(Agent(MODEL))) as robot:
        contract = await market.demand(robot, SAYING, cost=COST)
        await in_phase(robot, contract, Phase.READY)
    async with market.robot(speaking(robot, said)):
        assert_paid(await market.outcome(contract))
        await in_phase(robot, contract, Phase.FINALIZED)
        assert await market.balance(robot) == ALLOWANCE + COST
    assert said == WORDS


async def test_a_running_job_continues_where_it_was_however_often_it_is_stopped(market: Market) -> None:
    said, stuck_at = list[str](), {"0"}
    async with market.robot(speaking(offering(Agent(MODEL)), said, stuck_at=stuck_at)) as robot:
        contract = await market.demand(robot, SAYING, cost=COST)
        await market.running(contract)
        for stop in ("2", "2", "4"):
            stuck_at.clear()
            stuck_at.add(stop)
            await market.restart(robot)
            await until(lambda stop=stop: said == WORDS[: int(stop)])  # type: ignore[misc]
        stuck_at.clear()
        await market.restart(robot)
        assert_paid(outcome := await market.outcome(contract))
        assert await market.balance(robot) == ALLOWANCE + COST
    assert said == outcome.recording.values("/said") == WORDS, "what was recorded before a restart is not lost"


async def test_a_job_that_ended_on_the_chain_during_the_downtime_is_not_done(place: Place) -> None:
    said: list[str] = []
    seen: list[Phase] = []
    async with place.provider(), place.agent("person") as person:
        async with offering(place.agent("robot")) as robot:
            contract = await person.demand(SAYING)
            await in_phase(robot, contract, Phase.READY)
            failed = result(signer=robot.parts.signer, liability=contract.address, success=False)
        await place.chains["provider"].liabilities.finalize(place.market.deployment.lighthouse_name, failed)
        robot = place.agent("robot")
        robot.on_liability(take_note(seen))
        async with robot:
            await until(lambda: Phase.FINALIZED in seen)
        async with speaking(place.agent("robot"), said) as robot:
            await reading(robot)
    assert said == []


def take_note(seen: list[Phase]) -> Callable[[Phase, Liability], Any]:
    async def phase(phase: Phase, liability: Liability) -> None:
        seen.append(phase)

    return phase


async def reading(robot: Agent) -> None:
    """Wait until an agent has read the chain to its end."""
    head = await robot.parts.chain.block_number()

    async def read() -> bool:
        return ((await robot.parts.ledger.cursor())[0] or 0) >= head

    await until_found(read, what=f"block {head}")


async def test_a_liability_that_ended_before_the_agent_read_it_is_not_a_job(place: Place) -> None:
    said: list[str] = []
    async with place.provider(), place.agent("person") as person:
        async with offering(place.agent("robot", enable_executor=False)) as robot:
            await reading(robot)
            head, robot_memory = robot.parts.chain_head.head, robot.parts.directory
            contract = await person.demand(SAYING)
        failed = result(signer=place.market.accounts["robot"].signer, liability=contract.address, success=False)
        await place.chains["provider"].liabilities.finalize(place.market.deployment.lighthouse_name, failed)
        # As if it had been down since before the contract was made.
        async with Ledger(robot_memory / "ledger.sqlite") as ledger:
            await ledger.set_cursor(head)
        with closing(sqlite3.connect(robot_memory / "ledger.sqlite", isolation_level=None)) as database:
            database.execute("DELETE FROM jobs")
        async with speaking(place.agent("robot"), said) as robot:
            await reading(robot)
            assert await robot.parts.ledger.job(contract.address) is None
    assert said == []


async def created_again(robot: Agent, contract: Contract) -> None:
    """Revert a contract and create it again, as when the same transaction is mined in another block."""
    hashes = (await robot.parts.chain.liabilities.get_with_orders(contract.address))[1]
    await robot.runtime.liability_reverted(contract.address)
    assert await robot.parts.ledger.job(contract.address) is None
    assert "result" not in [waiting.kind for waiting in await robot.parts.ledger.outbox(head=0)]
    await robot.runtime.new_liability(contract.liability, demand_hash=hashes[0], offer_hash=hashes[1])


async def test_a_job_that_was_set_aside_continues_where_it_was(market: Market) -> None:
    said, released = list[str](), asyncio.Event()
    robot = offering(Agent(MODEL))

    @robot.on("/say")
    async def say(job: Job, message: str) -> None:
        if message == "3":
            await released.wait()
        said.append(message)
        job.publish("/said", message)

    async with market.robot(robot):
        contract = await market.demand(robot, SAYING, cost=COST)
        await until(lambda: len(said) == 3)
        await created_again(robot, contract)
        released.set()
        assert_paid(outcome := await market.outcome(contract))
        assert await market.balance(robot) == ALLOWANCE + COST
    assert said == outcome.recording.values("/said") == WORDS


async def test_a_job_may_be_set_aside_while_its_objective_is_fetched(market: Market) -> None:
    said, content, person = list[str](), objective(*SAYING), await market.person()
    async with market.robot(speaking(offering_unseen(Agent(MODEL)), said)) as robot:
        contract = await market.demand(MODEL, cid_of_bytes(content), by=person)
        await in_phase(robot, contract, Phase.INCOMING)
        await robot.runtime.liability_reverted(contract.address)
        cid = person.parts.store.put_bytes(content)
        await until(lambda: robot.parts.store.has(cid), what="the objective")
        await created_again(robot, contract)
        assert_paid(await market.outcome(contract))
    assert said == WORDS


async def test_a_finished_job_that_was_set_aside_sends_its_result_again(place: Place, paid: Paying) -> None:
    said: list[str] = []
    async with place.agent("person") as person, speaking(offering(place.agent("robot")), said) as robot:
        contract = await made_by_a_provider_that_leaves(place, person, robot)
        await in_phase(robot, contract, Phase.COMPLETE)
        await created_again(robot, contract)
        async with place.provider():
            assert (await contract.outcome()).success
    assert said == WORDS
    assert await paid.once()


async def test_a_restarted_development_chain_has_a_ledger_of_its_own(place: Place) -> None:
    """A development chain gives the same addresses to other contracts: an old job there must not hide a new one."""
    from mesh.chain import Chain
    from mesh.dev import EmbeddedChain
    from mesh.dev.development import deploy_market

    async with place.agent("robot") as robot:
        here = robot.parts.directory
    async with EmbeddedChain() as node:
        market = await deploy_market(node.provider, node.funded_keys)
        await node.mine()
        async with Chain(
            node.provider, account=market.accounts["robot"], contracts=market.deployment.contracts
        ) as chain:
            settings = place.settings("robot", ens_contract=market.deployment.ens)
            async with Agent(settings=settings, account=market.accounts["robot"], chain=chain) as robot:
                assert robot.parts.chain.chain_id == place.chains["robot"].chain_id
                assert robot.parts.directory != here
                assert robot.parts.directory.parent == here.parent


async def test_a_job_of_a_run_that_does_none_is_done_by_the_next_one(place: Place, paid: Paying) -> None:
    said: list[str] = []
    async with place.provider(), place.agent("person") as person:
        async with offering(place.agent("robot", enable_executor=False)) as robot:
            contract = await person.demand(SAYING, cost=COST)
            head = await place.chains["person"].block_number()
            await robot.parts.chain_head.reached(head)
        async with speaking(place.agent("robot"), said):
            assert (await contract.outcome()).success
    assert said == WORDS
    assert await paid.once()


async def test_a_program_of_the_account_that_does_no_jobs_leaves_them_to_the_robot_beside_it(
    place: Place, paid: Paying
) -> None:
    said: list[str] = []
    async with (
        place.provider(),
        place.agent("person") as person,
        place.agent("robot", enable_executor=False) as page,
        speaking(offering(place.agent("robot")), said) as robot,
    ):
        opened = robot.runtime.executor.wait_until_open

        async def later() -> None:
            """The page is first, as it may be."""
            head = await place.chains["person"].block_number()
            await page.parts.chain_head.reached(head)
            await opened()

        robot.runtime.executor.wait_until_open = later  # type: ignore[method-assign]
        contract = await person.demand(SAYING, cost=COST)
        assert (await contract.outcome()).success
        await in_phase(robot, contract, Phase.FINALIZED)
    assert said == WORDS
    assert await paid.once()
