"""A robot hands a job back: in any phase before its end, only itself, and it is never paid for it."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

import pytest

from mesh import Agent, Settings
from mesh.agent.ledger import Phase, WrongPhase
from mesh.errors import InputError
from mesh.network import ServiceFailed, call
from mesh.testing import assert_paid, assert_refunded
from schemas import Signer, cid_of_bytes
from schemas.signing import LONGEST_WHY, StopRequest
from tests.support.agent.restarts import COST, SAYING, WORDS, half_way, notes, speaking
from tests.support.market import MODEL, in_phase, offering, offering_unseen
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.handlers import Job
    from mesh.testing import Market
    from schemas import Liability


async def test_a_job_that_is_handed_back_half_way_is_refunded_and_the_next_one_begins(market: Market) -> None:
    person, parked = await market.person(), list[str]()
    before = await market.balance(person)
    async with half_way(market, by=person, parked=parked, hold_when_stopped=True) as (robot, first):
        second = await market.demand(MODEL, SAYING, by=person, cost=COST + 1)
        await in_phase(robot, second, Phase.READY)
        await robot.hand_back(first.address, "arm-broken", "the arm is broken")
        outcome = await market.outcome(first)
        assert_refunded(outcome, code="arm-broken")
        assert outcome.reason == "handed back by the robot: the arm is broken"
        assert await market.balance(person) == before - COST - 1
        await in_phase(robot, second, Phase.RUNNING)
    assert outcome.recording.values("/said") == WORDS[:3]
    assert outcome.recording.values("/parked") == [True]
    assert notes(outcome) == ["handed back by the robot: the arm is broken [arm-broken]"]
    assert len(parked) == 1


async def test_a_job_that_is_handed_back_while_it_waits_never_begins(market: Market) -> None:
    parked: list[str] = []
    async with half_way(market, parked=parked) as (robot, first):
        second = await market.demand(MODEL, SAYING, cost=COST + 1)
        await in_phase(robot, second, Phase.READY)
        assert (await robot.hand_back(second.address, "too-late")).devices == ()
        outcome = await market.outcome(second)
        assert (outcome.reason, outcome.code) == ("handed back by the robot", "too-late")
        assert robot.runtime.executor.at_hand == {first.address}
    assert (outcome.recording.published, parked) == ([], [])


async def test_a_job_can_be_handed_back_as_soon_as_it_comes(market: Market) -> None:
    said: list[str] = []
    robot = speaking(offering(Agent(MODEL)), said)

    @robot.on_liability
    async def refuse(phase: Phase, liability: Liability) -> None:
        if phase is Phase.INCOMING:
            await robot.hand_back(liability.address, "wrong-hall", "it is in another hall")

    async with market.robot(robot):
        assert_refunded(await market.order(robot, SAYING, cost=COST), code="wrong-hall")
        await until(lambda: not robot.runtime.executor.preparing)
        assert not robot.runtime.executor.at_hand
    assert said == []


async def test_an_objective_that_nobody_serves_does_not_hold_up_a_job_that_is_handed_back(market: Market) -> None:
    robot = speaking(offering_unseen(Agent(MODEL, settings=Settings(fetch_timeout=300.0))), [])
    async with market.robot(robot):
        contract = await market.demand(MODEL, cid_of_bytes(b"nobody has this"), cost=COST)
        await until(lambda: bool(robot.runtime.executor.preparing))
        await robot.hand_back(contract.address, "no-objective")
        assert_refunded(await market.outcome(contract), code="no-objective")
        await until(lambda: not robot.runtime.executor.preparing)


async def test_a_handler_that_hands_back_its_own_job_is_cancelled(market: Market) -> None:
    robot, after = offering(Agent(MODEL)), []

    @robot.on("/say")
    async def say(job: Job, message: str) -> None:
        await robot.hand_back(job.liability.address, "no-paint", "the can is empty")
        after.append(message)

    async with market.robot(robot):
        for cost in (COST, COST + 1):
            outcome = await market.order(robot, SAYING, cost=cost)
            assert (outcome.reason, outcome.code) == ("handed back by the robot: the can is empty", "no-paint")
    assert after == []


async def test_to_hand_a_job_back_twice_changes_nothing(market: Market) -> None:
    person, parked = await market.person(), list[str]()
    async with half_way(market, by=person, parked=parked) as (robot, contract):
        await asyncio.gather(
            robot.hand_back(contract.address, "one", "first"), robot.hand_back(contract.address, "two", "second")
        )
        assert ((await contract.outcome()).code, parked) == ("one", ["first"])
        await robot.hand_back(contract.address, "three")
        assert (await (await person.contract(contract.address)).outcome()).code == "one"


async def test_a_job_that_has_ended_can_not_be_handed_back(market: Market) -> None:
    async with market.robot(speaking(offering(Agent(MODEL)), [])) as robot:
        assert_paid(done := await market.order(robot, SAYING, cost=COST))
        for agent, why in ((robot, "can't hand back"), (await market.person(), "not a job of this agent")):
            with raises_with(WrongPhase, code="wrong-phase", match=why):
                await agent.hand_back(done.contract, "late")


async def test_a_job_that_its_customer_has_stopped_can_not_be_handed_back_any_more(market: Market) -> None:
    async with half_way(market) as (robot, contract):
        await contract.stop("no need")
        await robot.hand_back(contract.address, "arm-broken")
        assert (await contract.outcome()).reason == "stopped by the customer: no need"


async def test_a_job_is_handed_back_by_a_robot_that_was_restarted(market: Market) -> None:
    parked: list[str] = []
    async with half_way(market, parked=parked) as (robot, contract):
        await market.restart(robot)
        await robot.hand_back(contract.address, "power-lost", "the power was away")
        outcome = await market.outcome(contract)
    assert_refunded(outcome, code="power-lost")
    assert parked == ["the power was away"]
    assert outcome.recording.values("/said") == WORDS[:3]


async def test_neither_a_stranger_nor_the_customer_can_hand_a_job_back(market: Market) -> None:
    person, stranger = await market.person(), Signer(b"\7" * 32)
    async with half_way(market, by=person) as (robot, contract):
        customer = person.parts.signer
        fields: dict[str, Any] = {"liability": contract.address, "why": "no", "time": int(time.time())}
        forged = StopRequest(by=robot.address, code="no", **fields)
        forged = StopRequest(by=robot.address, code="no", signature=stranger.sign_hash(forged._hash()).hex(), **fields)
        plain = StopRequest(by=robot.address, **fields).signed_by(robot.parts.signer)
        altered = StopRequest(by=robot.address, code="no", signature=plain.signature, **fields)
        of_customer = StopRequest(by=customer.address, code="no", **fields).signed_by(customer)
        of_stranger = StopRequest(by=stranger.address, code="no", **fields).signed_by(stranger)
        for request in (forged, altered, of_customer, of_stranger):
            with raises_with(ServiceFailed, code="service-failed", match="may not hand back"):
                await call(person.network.session, robot.address, "stop", request)
        assert await robot.parts.ledger.stopped(contract.address) is None
        assert contract.address in robot.runtime.executor.runs


async def test_a_job_is_not_handed_back_with_a_code_that_is_no_word_of_its_own(market: Market) -> None:
    """Above all not as if its customer had stopped it: its own signature would be worth the pay of a stopped job."""
    async with half_way(market) as (robot, contract):
        for code in ("", "Two Words", "a/b", "x" * 65, "stopped", "robot-stopped"):
            with raises_with(InputError, code="invalid-code"):
                await robot.hand_back(contract.address, code)
        with raises_with(InputError, code="why-too-long"):
            await robot.hand_back(contract.address, "no", "x" * (LONGEST_WHY + 1))
        request = StopRequest(liability=contract.address, by=robot.address, why="", time=0, code="stopped")
        with raises_with(ServiceFailed, code="service-failed", match="can't have the code stopped"):
            await call(robot.network.session, robot.address, "stop", request.signed_by(robot.parts.signer))
        assert await robot.parts.ledger.stopped(contract.address) is None


async def test_what_a_job_is_handed_back_for_shows_neither_paths_nor_keys(market: Market) -> None:
    why = "/home/robot/arm.log says that https://node.example/v3/SECRETKEY refused"
    async with half_way(market) as (robot, contract):
        await robot.hand_back(contract.address, "arm-broken", why)
        outcome = await market.outcome(contract)
    assert outcome.reason == "handed back by the robot: … says that https://node.example refused"
    assert notes(outcome) == [f"{outcome.reason} [arm-broken]"]


@pytest.mark.parametrize("has_begun", [True, False])
@pytest.mark.parametrize(
    ("who", "code"), [("hand-back", "arm-broken"), ("robot", "robot-stopped"), ("customer", "stopped")]
)
async def test_of_what_ends_a_job_early_only_its_customers_stop_is_paid(
    market: Market, tmp_path: Path, who: str, code: str, has_begun: bool
) -> None:
    """With a description that says so, and if the job had begun."""
    model = tmp_path / "model.json"
    model.write_bytes(speaking(Agent(MODEL), []).model_description("A lamp", on_stop="paid").encode())
    robot = speaking(offering(Agent(model)), [], stuck_at="3")
    async with market.robot(robot):
        contract = await market.demand(robot, SAYING, cost=COST)
        await market.running(contract)
        if not has_begun:
            contract = await market.demand(robot, SAYING, cost=COST + 1)
            await in_phase(robot, contract, Phase.READY)
        match who:
            case "hand-back":
                await robot.hand_back(contract.address, code)
            case "robot":
                await (await robot.contract(contract.address)).stop()
            case "customer":
                await contract.stop()
        outcome = await market.outcome(contract)
    is_paid = who == "customer" and has_begun
    assert (outcome.success, outcome.code) == (is_paid, "" if is_paid else code)
