"""Those who wait for a job see what happens: offers, the contract, the playback, the result, the payment."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from mesh import Agent, JobFailed, Phase, Progress
from mesh.agent import jobs
from mesh.agent.contracts import _report_presence
from mesh.testing import assert_paid
from schemas import EventKey, PlaybackPosition, ProgressKey
from tests.support.agent.trades import JOB, job, working
from tests.support.log_events import logged_facts
from tests.support.market import MODEL, in_phase, offering
from tests.support.objectives import objective
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    import pytest

    from mesh.agent.handlers import Job
    from mesh.testing import Market
    from tests.support.market import Place


def kinds(heard: list[Progress]) -> list[str]:
    """The kinds in their order, without repetitions."""
    return list(dict.fromkeys(progress.kind for progress in heard))


async def test_a_person_sees_a_job_from_the_offer_to_the_payment(place: Place) -> None:
    heard: list[Progress] = []
    robot, watched = offering(place.agent("robot")), asyncio.Event()

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        await watched.wait()

    async with robot, place.agent("person") as person:
        async with place.provider():
            contract = await person.demand(place.save(objective(*[("/go", "on")] * 5)), on_progress=heard.append)
        ending = asyncio.create_task(contract.outcome(on_progress=heard.append))
        await until_heard(robot.parts.network.session, str(ProgressKey(robot.address, contract.address)))
        watched.set()
        await until(lambda: "result" in kinds(heard))
        async with place.provider():
            outcome = await ending
        assert [kind for kind in kinds(heard) if kind != "offer"] == ["contract", "ready", "playing", "result", "paid"]
        assert {progress.agent for progress in heard} == {robot.address}
        said = {progress.kind: progress for progress in heard}
        assert said["contract"].detail == contract.address
        assert (said["playing"].position, said["playing"].total) == (5, 5)
        assert said["result"].detail == outcome.result


async def test_a_person_sees_why_a_job_failed(place: Place) -> None:
    heard: list[Progress] = []
    robot, watched = offering(place.agent("robot")), asyncio.Event()

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        await watched.wait()
        raise JobFailed("the lamp is broken")

    async with robot, place.agent("person") as person:
        async with place.provider():
            contract = await person.demand(job(place))
        ending = asyncio.create_task(contract.outcome(on_progress=heard.append))
        await until_heard(robot.parts.network.session, str(ProgressKey(robot.address, contract.address)))
        watched.set()
        await until(lambda: "result" in kinds(heard))
        async with place.provider():
            await ending
        said = {progress.kind: progress for progress in heard}
        assert said["result"].code == "failed"
        assert (said["refunded"].code, said["refunded"].detail) == ("job-failed", "the lamp is broken")


async def test_an_offer_with_other_terms_says_which(market: Market) -> None:
    person, heard = await market.person(), list[Progress]()
    cid = person.parts.store.put_bytes(objective(*JOB))
    async with market.robot(working(Agent(MODEL))) as robot:
        await robot.offer(objective=cid, cost=7)
        demand = asyncio.create_task(person.demand(cid, model=MODEL, cost=5, on_progress=heard.append))
        other = Progress(kind="offer", agent=robot.address, code="other-cost", detail="7")
        await until(lambda: other in heard)
        await demand
        assert heard.count(other) == 1


async def test_the_position_of_a_playback_is_published_while_it_changes(market: Market) -> None:
    said: list[PlaybackPosition] = []
    robot, person = offering(Agent(MODEL)), await market.person()

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        await asyncio.sleep(jobs.JOB_PACE.publishing)

    def hear(sample: Any) -> None:
        said.append(PlaybackPosition.decode(sample.payload.to_bytes()))

    async with market.robot(robot):
        selector = f"aira/agent/{robot.address.lower()}/liability/*/progress"
        with person.network.session.declare_subscriber(selector, hear):
            assert_paid(await market.order(robot, JOB * 4))
            await until(lambda: said and said[-1].position == 4)
    assert {playback.total for playback in said} == {4}
    positions = [playback.position for playback in said]
    assert positions == sorted(positions)
    assert len(set(positions)) >= 3


def until_set(done: asyncio.Event) -> Agent:
    """A robot whose jobs end when that is set."""
    robot = offering(Agent(MODEL))

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        await done.wait()

    return robot


async def test_what_others_say_of_a_job_is_not_reported(market: Market) -> None:
    """On the keys of another agent or another liability, or unreadable."""
    heard, done = list[Progress](), asyncio.Event()
    person, other = await market.person(), await market.person()
    async with market.robot(until_set(done)) as robot:
        contract = await market.demand(robot, JOB, by=person)
        outcome = asyncio.create_task(contract.outcome(on_progress=heard.append))
        own, session = str(ProgressKey(robot.address, contract.address)), other.network.session
        playback = PlaybackPosition(position=1, total=3)

        def is_heard() -> bool:
            session.put(str(ProgressKey(person.address, contract.address)), b'{"position":9,"total":9}')
            session.put(str(ProgressKey(robot.address, person.address)), b'{"position":9,"total":9}')
            session.put(own, b"nonsense")
            session.put(str(EventKey(robot.address, contract.address, "complete")), b"nonsense")
            session.put(own, playback.encode())
            return any(progress.total == 3 for progress in heard)

        await until(is_heard)
        assert all(progress.total != 9 for progress in heard)
        assert "result" not in kinds(heard)
        done.set()
        await outcome


async def test_a_person_sees_that_the_robot_is_gone(market: Market) -> None:
    heard, done = list[Progress](), asyncio.Event()
    async with market.robot(until_set(done)) as robot:
        contract = await market.demand(robot, JOB)
    outcome = asyncio.create_task(contract.outcome(on_progress=heard.append))
    await until(lambda: "gone" in kinds(heard), seconds=30)
    async with market.robot(robot):
        await until(lambda: "back" in kinds(heard), seconds=30)
        done.set()
        assert_paid(await outcome)


async def test_an_agent_that_was_never_present_is_not_said_to_be_gone(place: Place) -> None:
    """As one of the legacy network, which works there."""
    heard: list[Progress] = []
    async with place.agent("person") as person:
        watch = asyncio.create_task(_report_presence(person.parts, place.address("robot"), heard.append))
        await until(lambda: kinds(heard) == ["gone"], seconds=30)
        watch.cancel()
    assert [one.code for one in heard] == ["unseen"]


async def test_a_callback_that_fails_ends_nothing(market: Market, caplog: pytest.LogCaptureFixture) -> None:
    def fail(progress: Progress) -> None:
        raise RuntimeError("broken")

    person = await market.person()
    async with market.robot(working(Agent(MODEL))):
        contract = await person.demand(JOB, model=MODEL, on_progress=fail)
        assert_paid(await contract.outcome(on_progress=fail))
    assert {facts["kind"] for facts in logged_facts(caplog, "progress-not-reported")} >= {"contract", "paid"}


async def test_who_comes_late_is_told_the_present_phase(market: Market) -> None:
    """The job has been ready, and then played for a while, before anybody listens."""
    heard = dict[str, list[Progress]](ready=[], playing=[])
    async with market.robot(offering(Agent(MODEL))) as robot:
        contract = await market.demand(robot, JOB)
        await in_phase(robot, contract, Phase.READY)
        waiting = [asyncio.create_task(contract.outcome(on_progress=heard["ready"].append))]
        await until(lambda: kinds(heard["ready"]) == ["ready"])
        await robot.runtime.executor.start(contract.address)
        await until(lambda: heard["ready"][-1].position == 1)
        waiting.append(asyncio.create_task(contract.outcome(on_progress=heard["playing"].append)))
        await until(lambda: kinds(heard["playing"]) == ["ready", "playing"])
        assert (heard["playing"][-1].position, heard["playing"][-1].total) == (1, 1)
        await robot.finish(contract.address, success=True)
        assert all(outcome.success for outcome in await asyncio.gather(*waiting))
