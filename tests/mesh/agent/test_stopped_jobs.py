"""A job is stopped: by its customer, by the robot's account, by nobody else; and it never continues."""

from __future__ import annotations

import asyncio
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

from mesh import Agent
from mesh.agent.hiring import DemandDeclined
from mesh.agent.ledger import Phase
from mesh.errors import ClosedError, InputError
from mesh.network import ServiceFailed, call
from mesh.role.local_stop import release, stop_folder
from mesh.testing import assert_paid, assert_refunded
from schemas import Signer
from schemas.signing import LONGEST_WHY, StopRequest
from tests.support.agent.restarts import COST, SAYING, WORDS, half_way, notes, speaking
from tests.support.market import MODEL, in_phase, offering
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from mesh.agent.handlers import Job
    from mesh.testing import Market


async def test_a_job_that_is_stopped_half_way_is_refunded_and_its_recording_says_so(market: Market) -> None:
    person, parked = await market.person(), list[str]()
    before = await market.balance(person)
    async with half_way(market, by=person, parked=parked) as (_, contract):
        await contract.stop("the lamp smokes")
        outcome = await market.outcome(contract)
        assert_refunded(outcome, code="stopped")
        assert outcome.reason == "stopped by the customer: the lamp smokes"
        assert await market.balance(person) == before
    assert outcome.recording.values("/said") == WORDS[:3]
    assert outcome.recording.values("/parked") == [True]
    assert notes(outcome) == ["stopped by the customer: the lamp smokes [stopped]"]
    assert parked == ["the lamp smokes"]


async def test_the_next_job_begins_when_the_robot_is_safe(market: Market) -> None:
    order, safe = list[str](), asyncio.Event()
    async with half_way(market) as (robot, first):

        @robot.on_stop
        async def make_safe(job: Job, why: str) -> None:
            await safe.wait()
            order.append("safe")

        @robot.on_liability
        async def note(phase: Phase, liability: Any) -> None:
            if phase is Phase.RUNNING:
                order.append(liability.address)

        second = await market.demand(MODEL, SAYING, cost=COST + 1)
        await in_phase(robot, second, Phase.READY)
        await first.stop()
        await until(lambda: not robot.runtime.executor._playing)
        safe.set()
        assert_refunded(await market.outcome(first), code="stopped")
        await in_phase(robot, second, Phase.RUNNING)
    assert order == ["safe", second.address]


async def test_a_robot_that_its_customer_has_stopped_is_held_if_its_owner_said_so(market: Market) -> None:
    async with half_way(market, hold_when_stopped=True) as (robot, first):
        second = await market.demand(MODEL, SAYING, cost=COST + 1)
        await in_phase(robot, second, Phase.READY)
        await first.stop("smoke")
        assert_refunded(await market.outcome(first), code="stopped")
        await until(lambda: not robot.runtime.executor._stopping)
        assert robot.runtime.executor.hold.is_held
        with raises_with(DemandDeclined, code="demand-declined", match="before its owner releases it"):
            await market.demand(MODEL, SAYING, cost=COST + 2)
        await in_phase(robot, second, Phase.READY)
        assert release(stop_folder(robot.settings)) == 1
        await in_phase(robot, second, Phase.RUNNING)


async def test_a_stranger_can_not_stop_a_job(market: Market) -> None:
    person, stranger = await market.person(), Signer(b"\7" * 32)
    async with half_way(market, by=person) as (robot, contract):
        fields: dict[str, Any] = {"liability": contract.address, "why": "no", "time": int(time.time())}
        forged = StopRequest(by=person.address, **fields)
        forged = StopRequest(by=person.address, signature=stranger.sign_hash(forged._hash()).hex(), **fields)
        for request in (StopRequest(by=stranger.address, **fields).signed_by(stranger), forged):
            with raises_with(ServiceFailed, code="service-failed", match="may not stop"):
                await call(person.network.session, robot.address, "stop", request)
        assert await robot.parts.ledger.stopped(contract.address) is None
        assert contract.address in robot.runtime.executor.runs


async def test_the_robot_itself_may_stop_its_job(market: Market) -> None:
    async with half_way(market) as (robot, contract):
        await (await robot.contract(contract.address)).stop("a person is in the way")
        outcome = await market.outcome(contract)
        assert_refunded(outcome, code="robot-stopped")
        assert outcome.reason == "stopped by the robot's side: a person is in the way"


async def test_a_sync_handler_goes_on_but_publishes_nothing_any_more(market: Market) -> None:
    robot, begun, released, failed = offering(Agent(MODEL)), threading.Event(), threading.Event(), []

    @robot.on("/say")
    def say(job: Job, message: str) -> None:
        begun.set()
        released.wait(60)
        assert job.stopped
        try:
            job.publish("/said", message)
        except ClosedError as error:
            failed.append(error)

    @robot.on_stop
    def make_safe(job: Job, why: str) -> None:
        released.set()
        job.publish("/parked", True)

    async with market.robot(robot):
        contract = await market.demand(robot, SAYING)
        await until(begun.is_set)
        await contract.stop()
        outcome = await market.outcome(contract)
        await until(lambda: bool(failed))
    assert_refunded(outcome, code="stopped")
    assert outcome.recording.published == [("/parked", True)]


async def test_a_handler_that_ignores_its_cancellation_does_not_keep_its_job_from_ending(market: Market) -> None:
    robot, released = offering(Agent(MODEL)), asyncio.Event()

    @robot.on("/say")
    async def say(job: Job, message: str) -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            await released.wait()

    async with market.robot(robot):
        contract = await market.demand(robot, SAYING)
        await market.stop(contract)
        assert_refunded(await market.outcome(contract), code="stopped")
        released.set()


async def test_a_job_that_has_not_begun_is_refunded_and_never_begins(market: Market) -> None:
    parked: list[str] = []
    async with half_way(market, parked=parked) as (robot, first):
        second = await market.demand(MODEL, SAYING, cost=COST + 1)
        await in_phase(robot, second, Phase.READY)
        assert (await second.stop("changed my mind")).devices == ()
        assert_refunded(outcome := await market.outcome(second), code="stopped")
        assert first.address in robot.runtime.executor.runs
        await first.stop("enough")
        await first.outcome()
    assert outcome.recording.published == []
    assert parked == ["enough"]


async def test_a_stop_is_obeyed_that_comes_before_the_robot_has_read_of_the_contract(
    market: Market, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, asked = speaking(offering(Agent(MODEL)), [], stuck_at="3"), asyncio.Event()
    async with market.robot(robot):
        take, read = robot.runtime.new_liability, robot.runtime.executor.read

        async def take_late(*liability: Any, **orders: Any) -> None:
            await asked.wait()
            await take(*liability, **orders)

        async def note(address: str) -> Any:
            try:
                return await read(address)
            finally:
                asked.set()

        monkeypatch.setattr(robot.runtime, "new_liability", take_late)
        monkeypatch.setattr(robot.runtime.executor, "read", note)
        contract = await market.demand(MODEL, SAYING)
        await contract.stop("too late for me")
        assert_refunded(await market.outcome(contract), code="stopped")


async def test_a_job_that_has_ended_can_not_be_stopped(market: Market) -> None:
    robot = speaking(offering(Agent(MODEL)), [])
    async with market.robot(robot):
        done = await market.demand(robot, SAYING)
        assert_paid(await market.outcome(done))
        with raises_with(ServiceFailed, code="service-failed", match="can't stop"):
            await done.stop()
        with pytest.raises(InputError):
            await done.stop("x" * (LONGEST_WHY + 1))


async def test_to_stop_a_job_again_changes_nothing(market: Market) -> None:
    parked: list[str] = []
    async with half_way(market, parked=parked) as (_, contract):
        await asyncio.gather(contract.stop("one"), contract.stop("two"))
        outcome = await market.outcome(contract)
        await contract.stop("three")
    assert len(parked) == 1
    assert outcome.reason == f"stopped by the customer: {parked[0]}"


async def test_a_stopped_job_does_not_continue_after_a_restart(market: Market) -> None:
    """The agent ends after it has answered and before the job has ended."""
    stopped, safe = list[str](), asyncio.Event()
    async with half_way(market) as (robot, contract):

        @robot.on_stop
        async def make_safe(job: Job, why: str) -> None:
            stopped.append(why)
            await safe.wait()
            job.publish("/parked", True)

        await contract.stop("smoke")
        await until(lambda: bool(stopped))
    safe.set()
    async with market.robot(robot):
        outcome = await market.outcome(contract)
    assert_refunded(outcome, code="stopped")
    assert outcome.recording.values("/said") == WORDS[:3]
    assert outcome.recording.values("/parked") == [True]
    assert stopped == ["smoke", "smoke"]
