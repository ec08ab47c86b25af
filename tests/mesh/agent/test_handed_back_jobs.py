"""A robot hands a job back: in any phase before its end, only itself, and it is never paid for it."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.ledger import Phase, WrongPhase
from mesh.errors import InputError
from mesh.network import ServiceFailed, call
from schemas import Signer, String, cid_of_bytes
from schemas.signing import LONGEST_WHY, StopRequest
from tests.mesh.agent.restarts import COST, WORDS, half_way, speaking, words
from tests.mesh.agent.test_stopped_jobs import recorded
from tests.support.market import in_phase, offering, offering_unseen
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from mesh.agent.agent import Agent
    from mesh.agent.handlers import Job
    from schemas import Liability
    from tests.support.market import Place


async def test_a_job_that_is_handed_back_half_way_is_refunded_and_the_next_one_begins(place: Place) -> None:
    said: list[str] = []
    parked: list[str] = []
    robot = speaking(offering(place.agent("robot", hold_when_stopped=True)), said, stuck_at="3")

    @robot.on_stop
    async def make_safe(job: Job, why: str) -> None:
        parked.append(job.liability.address)
        job.publish("/parked", True)

    async with place.at_work(robot) as person:
        before = await place.balance("person")
        first = await person.demand(words(place), cost=COST)
        await until(lambda: len(said) == 3)
        second = await person.demand(words(place), cost=COST + 1)
        await in_phase(robot, second, Phase.READY)
        await robot.hand_back(first.address, "arm-broken", "the arm is broken")
        outcome = await first.outcome()
        assert (outcome.success, outcome.code) == (False, "arm-broken")
        assert outcome.reason == "handed back by the robot: the arm is broken"
        assert await place.balance("person") == before - COST - 1
        await in_phase(robot, second, Phase.RUNNING)
        found = await recorded(first)
    assert found["/said"] == [String(word) for word in WORDS[:3]]
    assert found["/parked"] == [True]
    assert found["/aira/note"] == [String("handed back by the robot: the arm is broken [arm-broken]")]
    assert parked == [first.address]


async def test_a_job_that_is_handed_back_while_it_waits_never_begins(place: Place) -> None:
    said: list[str] = []
    parked: list[str] = []
    robot = speaking(offering(place.agent("robot")), said, stuck_at="3")

    @robot.on_stop
    def make_safe(job: Job, why: str) -> None:
        parked.append(why)

    async with place.at_work(robot) as person:
        first = await person.demand(words(place), cost=COST)
        await until(lambda: len(said) == 3)
        second = await person.demand(words(place), cost=COST + 1)
        await in_phase(robot, second, Phase.READY)
        assert (await robot.hand_back(second.address, "too-late")).devices == ()
        outcome = await second.outcome()
        assert (outcome.reason, outcome.code) == ("handed back by the robot", "too-late")
        assert robot.runtime.executor.at_hand == {first.address}
    assert (len(said), parked) == (3, [])


async def test_a_job_can_be_handed_back_as_soon_as_it_comes(place: Place) -> None:
    said: list[str] = []
    robot = speaking(offering(place.agent("robot")), said)

    @robot.on_liability
    async def refuse(phase: Phase, liability: Liability) -> None:
        if phase is Phase.INCOMING:
            await robot.hand_back(liability.address, "wrong-hall", "it is in another hall")

    async with place.at_work(robot) as person:
        contract = await person.demand(words(place), cost=COST)
        assert (await contract.outcome()).code == "wrong-hall"
        await until(lambda: not robot.runtime.executor.preparing)
        assert not robot.runtime.executor.at_hand
    assert said == []


async def test_an_objective_that_nobody_serves_does_not_hold_up_a_job_that_is_handed_back(place: Place) -> None:
    robot = speaking(offering_unseen(place.agent("robot", fetch_timeout=300.0)), [])
    async with place.at_work(robot) as person:
        contract = await person.demand(cid_of_bytes(b"nobody has this"), cost=COST)
        await until(lambda: bool(robot.runtime.executor.preparing))
        await robot.hand_back(contract.address, "no-objective")
        assert (await contract.outcome()).code == "no-objective"
        await until(lambda: not robot.runtime.executor.preparing)


async def test_a_handler_that_hands_back_its_own_job_is_cancelled(place: Place) -> None:
    robot, after = offering(place.agent("robot")), []

    @robot.on("/say")
    async def say(job: Job, message: str) -> None:
        await robot.hand_back(job.liability.address, "no-paint", "the can is empty")
        after.append(message)

    async with place.at_work(robot) as person:
        for cost in (COST, COST + 1):
            contract = await person.demand(words(place), cost=cost)
            outcome = await contract.outcome()
            assert (outcome.reason, outcome.code) == ("handed back by the robot: the can is empty", "no-paint")
    assert after == []


async def test_to_hand_a_job_back_twice_changes_nothing_and_after_its_end_it_fails(place: Place) -> None:
    parked: list[str] = []
    said: list[str] = []
    robot = speaking(offering(place.agent("robot")), said, stuck_at="3")

    @robot.on_stop
    def make_safe(job: Job, why: str) -> None:
        parked.append(why)

    async with place.at_work(robot) as person:
        contract = await person.demand(words(place), cost=COST)
        await until(lambda: len(said) == 3)
        await asyncio.gather(
            robot.hand_back(contract.address, "one", "first"), robot.hand_back(contract.address, "two", "second")
        )
        outcome = await contract.outcome()
        assert (outcome.code, parked) == ("one", ["first"])
        await robot.hand_back(contract.address, "three")
        assert (await (await person.contract(contract.address)).outcome()).code == "one"

    robot = speaking(place.agent("robot"), said)
    async with place.at_work(offering(robot)) as person:
        done = await person.demand(words(place), cost=COST)
        assert (await done.outcome()).success
        with raises_with(WrongPhase, code="wrong-phase", match="can't hand back"):
            await robot.hand_back(done.address, "late")
        with raises_with(WrongPhase, code="wrong-phase", match="not a job of this agent"):
            await person.hand_back(done.address, "late")


async def test_a_job_that_its_customer_has_stopped_can_not_be_handed_back_any_more(place: Place) -> None:
    async with half_way(place) as (robot, _, contract):
        await contract.stop("no need")
        await robot.hand_back(contract.address, "arm-broken")
        assert (await contract.outcome()).reason == "stopped by the customer: no need"


async def test_a_job_is_handed_back_by_a_robot_that_was_restarted(place: Place) -> None:
    parked: list[str] = []
    said: list[str] = []

    def working(robot: Agent) -> Agent:
        @robot.on_stop
        def make_safe(job: Job, why: str) -> None:
            parked.append(why)

        return speaking(robot, said, stuck_at="3")

    async with place.provider(), place.agent("person") as person:
        async with working(offering(place.agent("robot"))):
            contract = await person.demand(words(place), cost=COST)
            await until(lambda: len(said) == 3)
        async with working(place.agent("robot")) as robot:
            await robot.hand_back(contract.address, "power-lost", "the power was away")
            outcome = await contract.outcome()
            found = await recorded(contract)
    assert outcome.code == "power-lost"
    assert parked == ["the power was away"]
    assert found["/said"][:3] == [String(word) for word in WORDS[:3]]


async def test_neither_a_stranger_nor_the_customer_can_hand_a_job_back(place: Place) -> None:
    async with half_way(place) as (robot, person, contract):
        stranger, customer = Signer(b"\7" * 32), person.parts.signer
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


@pytest.mark.parametrize("code", ["", "Two Words", "a/b", "x" * 65, "stopped", "robot-stopped"])
async def test_a_job_is_not_handed_back_with_a_code_that_is_no_word_of_its_own(place: Place, code: str) -> None:
    async with half_way(place) as (robot, _, contract):
        with raises_with(InputError, code="invalid-code"):
            await robot.hand_back(contract.address, code)
        with raises_with(InputError, code="why-too-long"):
            await robot.hand_back(contract.address, "no", "x" * (LONGEST_WHY + 1))
        assert await robot.parts.ledger.stopped(contract.address) is None


async def test_a_job_can_not_be_handed_back_as_if_its_customer_had_stopped_it(place: Place) -> None:
    """Its own signature would else be worth the pay of a job that its customer stopped."""
    async with half_way(place) as (robot, _, contract):
        request = StopRequest(liability=contract.address, by=robot.address, why="", time=0, code="stopped")
        with raises_with(ServiceFailed, code="service-failed", match="can't have the code stopped"):
            await call(robot.network.session, robot.address, "stop", request.signed_by(robot.parts.signer))
        assert await robot.parts.ledger.stopped(contract.address) is None


async def test_what_a_job_is_handed_back_for_shows_neither_paths_nor_keys(place: Place) -> None:
    why = "/home/robot/arm.log says that https://node.example/v3/SECRETKEY refused"
    async with half_way(place) as (robot, _, contract):
        await robot.hand_back(contract.address, "arm-broken", why)
        outcome = await contract.outcome()
        found = await recorded(contract)
    assert outcome.reason == "handed back by the robot: … says that https://node.example refused"
    assert found["/aira/note"] == [String(f"{outcome.reason} [arm-broken]")]


@pytest.mark.parametrize("has_begun", [True, False])
@pytest.mark.parametrize("who", ["hand-back", "robot", "customer"])
async def test_of_what_ends_a_job_early_only_its_customers_stop_is_paid(
    place: Place, who: str, has_begun: bool
) -> None:
    """With a description that says so, and if the job had begun."""
    said: list[str] = []
    kinds = speaking(place.agent("robot"), [])
    path = place.folder / "model.json"
    path.write_bytes(kinds.model_description("A lamp", on_stop="paid").encode())
    robot = speaking(offering(place.agent("robot", model=path)), said, stuck_at="3")
    async with place.at_work(robot) as person:
        first = await person.demand(words(place), cost=COST, model=robot.model)
        await until(lambda: len(said) == 3)
        contract = first
        if not has_begun:
            contract = await person.demand(words(place), cost=COST + 1, model=robot.model)
            await in_phase(robot, contract, Phase.READY)
        match who:
            case "hand-back":
                await robot.hand_back(contract.address, "arm-broken")
            case "robot":
                await (await robot.contract(contract.address)).stop()
            case "customer":
                await contract.stop()
        outcome = await contract.outcome()
    is_paid = who == "customer" and has_begun
    code = {"hand-back": "arm-broken", "robot": "robot-stopped", "customer": "stopped"}[who]
    assert (outcome.success, outcome.code) == (is_paid, "" if is_paid else code)
