"""A job is stopped: by its customer, by the robot's account, by nobody else; and it never continues."""

from __future__ import annotations

import asyncio
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.errors import DemandDeclined
from mesh.agent.ledger import Phase
from mesh.errors import ClosedError, InputError
from mesh.network import ServiceFailed, call
from mesh.recording import open_objective
from mesh.role.local_stop import release, stop_folder
from schemas import Signer, String
from schemas.payloads import decode_value
from schemas.signing import LONGEST_WHY, StopRequest
from tests.mesh.agent.restarts import COST, WORDS, half_way, speaking, words
from tests.support.market import in_phase, offering
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from mesh.agent.agent import Agent
    from mesh.agent.contracts import Contract
    from mesh.agent.handlers import Job
    from tests.support.market import Place


async def recorded(contract: Contract) -> dict[str, list[Any]]:
    """The values of the recording of an ended contract, by topic."""
    values: dict[str, list[Any]] = {}
    for message in open_objective(await contract.recording()).messages():
        values.setdefault(message.topic, []).append(decode_value(message.payload, message.type))
    return values


async def test_a_job_that_is_stopped_half_way_is_refunded_and_its_recording_says_so(place: Place) -> None:
    said: list[str] = []
    stopped: list[tuple[str, str]] = []
    robot = speaking(offering(place.agent("robot")), said, stuck_at="3")

    @robot.on_stop
    async def make_safe(job: Job, why: str) -> None:
        stopped.append((job.liability.address, why))
        job.publish("/parked", True)

    async with place.at_work(robot) as person:
        before = await place.balance("person")
        contract = await person.demand(words(place), cost=COST)
        await until(lambda: len(said) == 3)
        await contract.stop("the lamp smokes")
        outcome = await contract.outcome()
        assert (outcome.success, outcome.code) == (False, "stopped")
        assert outcome.reason == "stopped by the customer: the lamp smokes"
        assert await place.balance("person") == before
        found = await recorded(contract)
    assert found["/said"] == [String(word) for word in WORDS[:3]]
    assert found["/parked"] == [True]
    assert found["/aira/note"] == [String("stopped by the customer: the lamp smokes [stopped]")]
    assert stopped == [(contract.address, "the lamp smokes")]


async def test_the_next_job_begins_when_the_robot_is_safe(place: Place) -> None:
    said: list[str] = []
    order: list[str] = []
    robot, safe = speaking(offering(place.agent("robot")), said, stuck_at="3"), asyncio.Event()

    @robot.on_stop
    async def make_safe(job: Job, why: str) -> None:
        await safe.wait()
        order.append("safe")

    @robot.on_liability
    async def note(phase: Phase, liability: Any) -> None:
        if phase is Phase.RUNNING:
            order.append(liability.address)

    async with place.at_work(robot) as person:
        first = await person.demand(words(place), cost=COST)
        await until(lambda: len(said) == 3)
        second = await person.demand(words(place), cost=COST + 1)
        await in_phase(robot, second, Phase.READY)
        await first.stop()
        await until(lambda: not robot.runtime.executor._playing)
        safe.set()
        assert (await first.outcome()).code == "stopped"
        await in_phase(robot, second, Phase.RUNNING)
    assert order == [first.address, "safe", second.address]


async def test_a_robot_that_its_customer_has_stopped_is_held_if_its_owner_said_so(place: Place) -> None:
    async with half_way(place, hold_when_stopped=True) as (robot, person, first):
        second = await person.demand(words(place), cost=COST + 1)
        await in_phase(robot, second, Phase.READY)
        await first.stop("smoke")
        assert (await first.outcome()).code == "stopped"
        await until(lambda: not robot.runtime.executor._stopping)
        assert robot.runtime.executor.hold.is_held
        with raises_with(DemandDeclined, code="demand-declined", match="before its owner releases it"):
            await person.demand(words(place), cost=COST + 2)
        await in_phase(robot, second, Phase.READY)
        assert release(stop_folder(robot.settings)) == 1
        await in_phase(robot, second, Phase.RUNNING)


async def test_a_stranger_can_not_stop_a_job(place: Place) -> None:
    async with half_way(place) as (robot, person, contract):
        stranger, customer = Signer(b"\7" * 32), person.address
        fields: dict[str, Any] = {"liability": contract.address, "why": "no", "time": int(time.time())}
        forged = StopRequest(by=customer, **fields)
        forged = StopRequest(by=customer, signature=stranger.sign_hash(forged._hash()).hex(), **fields)
        for request in (StopRequest(by=stranger.address, **fields).signed_by(stranger), forged):
            with raises_with(ServiceFailed, code="service-failed", match="may not stop"):
                await call(person.network.session, robot.address, "stop", request)
        assert await robot.parts.ledger.stopped(contract.address) is None
        assert contract.address in robot.runtime.executor.runs


async def test_the_robot_itself_may_stop_its_job(place: Place) -> None:
    async with half_way(place) as (robot, _, contract):
        await (await robot.contract(contract.address)).stop("a person is in the way")
        outcome = await contract.outcome()
        assert (outcome.reason, outcome.code) == (
            "stopped by the robot's side: a person is in the way",
            "robot-stopped",
        )


async def test_a_sync_handler_goes_on_but_publishes_nothing_any_more(place: Place) -> None:
    robot, begun, released, failed = offering(place.agent("robot")), threading.Event(), threading.Event(), []

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

    async with place.at_work(robot) as person:
        contract = await person.demand(words(place), cost=COST)
        await until(begun.is_set)
        await contract.stop()
        assert (await contract.outcome()).code == "stopped"
        await until(lambda: bool(failed))
        found = await recorded(contract)
    assert "/said" not in found
    assert found["/parked"] == [True]


async def test_a_handler_that_ignores_its_cancellation_does_not_keep_its_job_from_ending(place: Place) -> None:
    robot, begun, released = offering(place.agent("robot")), asyncio.Event(), asyncio.Event()

    @robot.on("/say")
    async def say(job: Job, message: str) -> None:
        begun.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            await released.wait()

    async with place.at_work(robot) as person:
        contract = await person.demand(words(place), cost=COST)
        await begun.wait()
        await contract.stop()
        assert (await contract.outcome()).code == "stopped"
        released.set()


async def test_a_job_that_has_not_begun_is_refunded_and_never_begins(place: Place) -> None:
    said: list[str] = []
    stopped: list[str] = []
    robot = speaking(offering(place.agent("robot")), said, stuck_at="3")

    @robot.on_stop
    def make_safe(job: Job, why: str) -> None:
        stopped.append(why)

    async with place.at_work(robot) as person:
        first = await person.demand(words(place), cost=COST)
        await until(lambda: len(said) == 3)
        second = await person.demand(words(place), cost=COST + 1)
        await in_phase(robot, second, Phase.READY)
        assert (await second.stop("changed my mind")).devices == ()
        assert (await second.outcome()).code == "stopped"
        assert first.address in robot.runtime.executor.runs
        await first.stop("enough")
        await first.outcome()
    assert len(said) == 3
    assert stopped == ["enough"]


async def test_a_stop_is_obeyed_that_comes_before_the_robot_has_read_of_the_contract(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, asked = speaking(offering(place.agent("robot")), [], stuck_at="3"), asyncio.Event()
    async with place.at_work(robot) as person:
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
        contract = await person.demand(words(place), cost=COST)
        await contract.stop("too late for me")
        outcome = await contract.outcome()
    assert (outcome.success, outcome.code) == (False, "stopped")


async def test_a_job_that_has_ended_can_not_be_stopped_and_stopping_twice_changes_nothing(place: Place) -> None:
    said: list[str] = []
    robot = speaking(offering(place.agent("robot")), said)
    async with place.at_work(robot) as person:
        done = await person.demand(words(place), cost=COST)
        assert (await done.outcome()).success
        with raises_with(ServiceFailed, code="service-failed", match="can't stop"):
            await done.stop()
        with pytest.raises(InputError):
            await done.stop("x" * (LONGEST_WHY + 1))


async def test_to_stop_a_job_again_changes_nothing(place: Place) -> None:
    said: list[str] = []
    stopped: list[str] = []
    robot = speaking(offering(place.agent("robot")), said, stuck_at="3")

    @robot.on_stop
    def make_safe(job: Job, why: str) -> None:
        stopped.append(why)

    async with place.at_work(robot) as person:
        contract = await person.demand(words(place), cost=COST)
        await until(lambda: len(said) == 3)
        await asyncio.gather(contract.stop("one"), contract.stop("two"))
        outcome = await contract.outcome()
        await contract.stop("three")
    assert len(stopped) == 1
    assert outcome.reason == f"stopped by the customer: {stopped[0]}"


async def test_a_stopped_job_does_not_continue_after_a_restart(place: Place) -> None:
    """The agent ends after it has answered and before the job has ended."""
    said: list[str] = []
    stopped: list[str] = []

    def stoppable(robot: Agent, forever: asyncio.Event) -> Agent:
        @robot.on_stop
        async def make_safe(job: Job, why: str) -> None:
            stopped.append(why)
            await forever.wait()
            job.publish("/parked", True)

        return speaking(robot, said, stuck_at="3")

    never, at_once = asyncio.Event(), asyncio.Event()
    at_once.set()
    async with place.provider(), place.agent("person") as person:
        async with stoppable(offering(place.agent("robot")), never):
            contract = await person.demand(words(place), cost=COST)
            await until(lambda: len(said) == 3)
            await contract.stop("smoke")
            await until(lambda: bool(stopped))
        async with stoppable(place.agent("robot"), at_once):
            outcome = await contract.outcome()
            found = await recorded(contract)
    assert outcome.code == "stopped"
    assert said == WORDS[:3]
    assert found["/said"] == [String(word) for word in WORDS[:3]]
    assert found["/parked"] == [True]
    assert stopped == ["smoke", "smoke"]
