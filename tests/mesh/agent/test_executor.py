"""Jobs of an agent, from the demand to the money: the executor with everything around it real."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from mesh import Agent, Settings
from mesh.agent.ledger import Phase
from mesh.recording import open_objective
from mesh.testing import assert_paid, assert_refunded
from schemas import Empty, String, cid_of_file
from tests.support.agent.restarts import COST
from tests.support.agent.trades import doing_nothing
from tests.support.market import MODEL, Place, offering
from tests.support.objectives import MILLISECOND, objective, timed
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.handlers import Job
    from mesh.testing import Market
    from schemas import Liability


async def test_an_objective_is_played_in_order_to_the_handlers_and_the_robot_is_paid(
    market: Market, tmp_path: Path
) -> None:
    robot, done = offering(Agent(MODEL)), list[object]()

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        done.append(message)

    @robot.on("*")
    async def anything(job: Job, message: Any) -> None:
        done.append((job.playing.topic if job.playing else "", message))

    path = tmp_path / "objective.mcap"
    path.write_bytes(objective(("/go", Empty()), ("/say", "hi"), ("/go", {"speed": 2}), ("/raw", b"\x01\x02")))
    async with market.robot(robot):
        person = await market.person()
        before = await market.balance(robot), await market.balance(person)
        contract = await market.demand(MODEL, path, by=person, cost=COST)
        outcome = await market.outcome(contract)
        assert_paid(outcome)
        assert done == [Empty(), ("/say", String("hi")), {"speed": 2}, ("/raw", b"\x01\x02")]
        assert await market.balance(robot) == before[0] + COST
        assert await market.balance(person) == before[1] - COST
        assert contract.liability.objective == cid_of_file(path)
        assert cid_of_file(await contract.recording()) == outcome.result


async def test_the_recording_holds_the_played_messages_and_those_of_the_handler(market: Market) -> None:
    robot = offering(Agent(MODEL))

    @robot.on("/go")
    async def go(job: Job, message: String) -> None:
        job.publish("/done", f"did {message.data}")

    async with market.robot(robot):
        contract = await market.demand(MODEL, [("/go", "one"), ("/go", "two")])
        recording = (await market.outcome(contract)).recording
        assert [message.value for message in recording.messages if message.role == "objective"] == ["one", "two"]
        assert recording.published == [("/done", "did one"), ("/done", "did two")]
        about = open_objective(await contract.recording()).metadata["aira"]
        assert about["liability"] == contract.address
        assert about["agent"] == robot.address
        assert about["objective"] == contract.liability.objective


async def test_messages_are_played_at_their_recorded_times(place: Place) -> None:
    robot = offering(place.agent("robot", playback="recorded"))
    times: list[float] = []

    @robot.on_liability
    async def begin(phase: Phase, liability: Liability) -> None:
        if phase is Phase.RUNNING:
            times.append(asyncio.get_running_loop().time())

    @robot.on("/tick")
    async def tick(job: Job, message: Empty) -> None:
        times.append(asyncio.get_running_loop().time())

    path = place.save(timed([("/tick", Empty(), at * MILLISECOND) for at in (0, 150, 200)]))
    async with place.at_work(robot) as person:
        assert (await (await person.demand(path)).outcome()).success
    began, first, second, third = times
    assert first >= began
    assert second - began > 0.149, "a busy machine may only be late"
    assert third - began > 0.199


async def test_at_once_means_without_waiting_for_recorded_times(place: Place) -> None:
    robot = doing_nothing(offering(place.agent("robot", playback="at-once")))
    path = place.save(timed([("/tick", Empty(), hour * 3600 * 1000 * MILLISECOND) for hour in range(3)]))
    async with place.at_work(robot) as person, asyncio.timeout(60):
        assert (await (await person.demand(path)).outcome()).success


async def test_jobs_are_done_one_after_the_other(market: Market) -> None:
    robot, begun, release = offering(Agent(MODEL)), list[str](), asyncio.Event()

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        begun.append(job.liability.address)
        await release.wait()

    async def others_are_ready() -> bool:
        return len(await robot.parts.ledger.jobs((Phase.READY,))) == 2

    async with market.robot(robot):
        person, work = await market.person(), [("/go", Empty()), ("/go", Empty())]
        contracts = await asyncio.gather(*(market.demand(MODEL, work, by=person, cost=cost) for cost in (1, 2, 3)))
        await until(lambda: begun)
        await until_found(others_are_ready)
        assert len(begun) == 1
        release.set()
        for contract in contracts:
            assert_paid(await market.outcome(contract))
    assert begun[0::2] == begun[1::2], "both messages of a job before any of the next"


async def test_phase_handlers_get_every_phase_in_order_with_its_record(market: Market) -> None:
    robot = doing_nothing(offering(Agent(MODEL)))
    seen: list[tuple[Phase, Liability]] = []

    @robot.on_liability
    async def phase(phase: Phase, liability: Liability) -> None:
        seen.append((phase, liability))

    async with market.robot(robot):
        contract = await market.demand(MODEL, [("/go", Empty())], cost=COST)
        outcome = await market.outcome(contract)
        await until(lambda: len(seen) == 5)
    assert [phase for phase, _ in seen] == list(Phase)
    assert {liability.address for _, liability in seen} == {contract.address}
    complete, finalized = seen[3][1], seen[4][1]
    assert (complete.result, complete.is_success, complete.is_finalized) == (outcome.result, True, False)
    assert (finalized.result, finalized.is_success, finalized.is_finalized) == (outcome.result, True, True)


async def test_a_handler_may_end_its_own_job(market: Market) -> None:
    robot, done = offering(Agent(MODEL)), list[str]()

    @robot.on("/go")
    async def go(job: Job, message: String) -> None:
        cid = await robot.finish(job.liability.address, success=False)
        done.append(f"{message.data} {cid}")

    async with market.robot(robot):
        outcome = await market.order(MODEL, [("/go", str(number)) for number in range(50)])
        assert_refunded(outcome)
        await until(lambda: done)
        assert_refunded(await market.order(MODEL, [("/go", "again")]))
        await until(lambda: len(done) == 2)
    assert done[0] == f"0 {outcome.result}"
    assert len(done) == 2, "nothing is played after the end"


async def test_a_phase_handler_may_end_the_job_that_has_just_started(market: Market) -> None:
    robot = doing_nothing(offering(Agent(MODEL)))

    @robot.on_liability
    async def phase(phase: Phase, liability: Liability) -> None:
        if phase is Phase.RUNNING:
            await robot.finish(liability.address, success=False)

    async with market.robot(robot):
        assert_refunded(await market.order(MODEL, [("/go", Empty())]))


async def test_only_the_chosen_topics_are_recorded_and_all_are_played(market: Market) -> None:
    robot, played = offering(Agent(MODEL, settings=Settings(recording_topics=" /go,/led ,"))), list[str]()

    @robot.on("*")
    async def anything(job: Job, message: Any) -> None:
        assert job.playing is not None
        played.append(job.playing.topic)
        job.publish("/led", "on")
        job.publish("/camera", b"a picture")

    async with market.robot(robot):
        outcome = await market.order(MODEL, [("/go", Empty()), ("/quietly", Empty())])
    assert {message.topic for message in outcome.recording.messages} == {"/go", "/led"}
    assert played == ["/go", "/quietly"]


async def test_an_agent_without_executor_does_no_jobs(market: Market) -> None:
    robot = doing_nothing(offering(Agent(MODEL, settings=Settings(enable_executor=False))))
    async with market.robot(robot):
        contract = await market.demand(MODEL, [("/go", Empty())])
        head = await robot.chain.block_number()
        await until(lambda: robot.parts.chain_head.head >= head)
        assert [job.phase for job in await robot.parts.ledger.jobs()] == [Phase.INCOMING]
        assert not (await robot.chain.liabilities.get(contract.address)).is_finalized


async def test_played_messages_are_on_the_mesh(market: Market) -> None:
    robot, played = doing_nothing(offering(Agent(MODEL))), list[tuple[str, bytes, str]]()
    async with market.robot(robot):
        person = await market.person()
        listener: Any = person.network.session.declare_subscriber(
            f"aira/agent/{robot.address.lower()}/liability/*/objective/**",
            lambda sample: played.append(
                (str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding)),
            ),
        )
        contract = await market.demand(MODEL, [("/arm/left", "up"), ("/arm/left", "down")], by=person)
        await market.outcome(contract)
        await until(lambda: len(played) == 2)
        listener.undeclare()
        key = f"aira/agent/{robot.address.lower()}/liability/{contract.address.lower()}/objective/arm/left"
    assert played == [(key, String(word).encode(), "ros1;std_msgs/String") for word in ("up", "down")]


async def test_a_burst_of_played_messages_is_recorded_whole_and_heard_in_order(market: Market, tmp_path: Path) -> None:
    """Who listens on the mesh may miss messages of a burst, since Zenoh drops some; the recording misses none."""
    robot, heard_by_listener = doing_nothing(offering(Agent(MODEL))), list[bytes]()
    words = [String(str(number)).encode() for number in range(500)]
    path = tmp_path / "objective.mcap"
    path.write_bytes(timed([("/say", String.decode(word), 0) for word in words]))
    async with market.robot(robot):
        person = await market.person()
        listener: Any = person.network.session.declare_subscriber(
            f"aira/agent/{robot.address.lower()}/liability/*/objective/say",
            lambda sample: heard_by_listener.append(sample.payload.to_bytes()),
        )
        outcome = await market.order(MODEL, path, by=person)
        await until(lambda: heard_by_listener)
        listener.undeclare()
    assert [message.payload for message in outcome.recording.messages] == words
    positions = [words.index(word) for word in heard_by_listener]
    assert positions == sorted(set(positions))


async def test_a_late_device_message_of_a_played_topic_keeps_its_role(market: Market) -> None:
    """The recording distinguishes played messages from device messages of the same topic."""
    robot = offering(Agent(MODEL))
    robot.on("/go")(lambda job, message: job.publish("/go", "gone"))
    async with market.robot(robot):
        outcome = await market.order(MODEL, [("/go", "go")])
    said = [(message.role, String.decode(message.payload).data) for message in outcome.recording.messages]
    assert said == [("objective", "go"), ("device", "gone")]
