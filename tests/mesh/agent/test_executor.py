"""Jobs of an agent, from the demand to the money: the executor with everything around it real."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from mesh.agent.ledger import Phase
from schemas import Empty, String, cid_of_file
from tests.mesh.agent.executions import COST, doing_nothing, heard, recorded
from tests.support.market import Place, offering
from tests.support.objectives import MILLISECOND, objective, timed
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from mesh.agent.handlers import Job
    from mesh.recording import Played
    from schemas import Liability


async def test_an_objective_is_played_in_order_to_the_handlers_and_the_robot_is_paid(place: Place) -> None:
    robot = offering(place.agent("robot"))
    done: list[object] = []

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        done.append(message)

    @robot.on("*")
    async def anything(job: Job, message: Any) -> None:
        done.append((job.playing.topic if job.playing else "", message))

    path = place.save(objective(("/go", Empty()), ("/say", "hi"), ("/go", {"speed": 2}), ("/raw", b"\x01\x02")))
    async with place.at_work(robot) as person:
        before = await place.balance("robot"), await place.balance("person")
        contract = await person.demand(path, cost=COST)
        outcome = await contract.outcome()
        assert outcome.success
        assert done == [Empty(), ("/say", String("hi")), {"speed": 2}, ("/raw", b"\x01\x02")]
        assert await place.balance("robot") == before[0] + COST
        assert await place.balance("person") == before[1] - COST
        assert contract.liability.objective == cid_of_file(path)
        assert cid_of_file(await contract.recording()) == outcome.result


async def test_the_recording_holds_the_played_messages_and_those_of_the_handler(place: Place) -> None:
    robot = offering(place.agent("robot"))

    @robot.on("/go")
    async def go(job: Job, message: String) -> None:
        job.publish("/done", f"did {message.data}")

    async with place.at_work(robot) as person:
        contract = await person.demand(place.save(objective(("/go", "one"), ("/go", "two"))))
        recording = await recorded(contract)
    assert heard(recording, "/go") == [String("one").encode(), String("two").encode()]
    assert heard(recording, "/done") == [String("did one").encode(), String("did two").encode()]
    about = recording.metadata["aira"]
    assert about["liability"] == contract.address
    assert about["agent"] == place.address("robot")
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


async def test_jobs_are_done_one_after_the_other(place: Place) -> None:
    robot = offering(place.agent("robot"))
    begun: list[str] = []
    release = asyncio.Event()

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        begun.append(job.liability.address)
        await release.wait()

    async def others_are_ready() -> bool:
        return len(await robot.parts.ledger.jobs((Phase.READY,))) == 2

    path = place.save(objective(("/go", Empty()), ("/go", Empty())))
    async with place.at_work(robot) as person:
        contracts = await asyncio.gather(*(person.demand(path, cost=cost) for cost in (1, 2, 3)))
        await until(lambda: begun)
        await until_found(others_are_ready)
        assert len(begun) == 1
        release.set()
        outcomes = await asyncio.gather(*(contract.outcome() for contract in contracts))
    assert [outcome.success for outcome in outcomes] == [True] * 3
    assert begun[0::2] == begun[1::2], "both messages of a job before any of the next"


async def test_phase_handlers_get_every_phase_in_order_with_its_record(place: Place) -> None:
    robot = doing_nothing(offering(place.agent("robot")))
    seen: list[tuple[Phase, Liability]] = []

    @robot.on_liability
    async def phase(phase: Phase, liability: Liability) -> None:
        seen.append((phase, liability))

    async with place.at_work(robot) as person:
        contract = await person.demand(place.save(objective(("/go", Empty()))), cost=COST)
        outcome = await contract.outcome()
        await until(lambda: len(seen) == 5)
    assert [phase for phase, _ in seen] == list(Phase)
    assert {liability.address for _, liability in seen} == {contract.address}
    complete, finalized = seen[3][1], seen[4][1]
    assert (complete.result, complete.is_success, complete.is_finalized) == (outcome.result, True, False)
    assert (finalized.result, finalized.is_success, finalized.is_finalized) == (outcome.result, True, True)


async def test_a_handler_may_end_its_own_job(place: Place) -> None:
    robot = offering(place.agent("robot"))
    done: list[str] = []

    @robot.on("/go")
    async def go(job: Job, message: String) -> None:
        cid = await robot.finish(job.liability.address, success=False)
        done.append(f"{message.data} {cid}")

    async with place.at_work(robot) as person, asyncio.timeout(60):
        contract = await person.demand(place.save(objective(*(("/go", str(n)) for n in range(50)), step_ns=0)))
        outcome = await contract.outcome()
        assert not outcome.success
        await until(lambda: done)
        second = await person.demand(place.save(objective(("/go", "again")), "second.mcap"))
        await second.outcome()
        await until(lambda: len(done) == 2)
    assert done[0] == f"0 {outcome.result}"
    assert len(done) == 2, "nothing is played after the end"


async def test_a_phase_handler_may_end_the_job_that_has_just_started(place: Place) -> None:
    robot = doing_nothing(offering(place.agent("robot")))

    @robot.on_liability
    async def phase(phase: Phase, liability: Liability) -> None:
        if phase is Phase.RUNNING:
            await robot.finish(liability.address, success=False)

    async with place.at_work(robot) as person, asyncio.timeout(60):
        contract = await person.demand(place.save(objective(("/go", Empty()))))
        assert not (await contract.outcome()).success


async def test_only_the_chosen_topics_are_recorded(place: Place) -> None:
    robot = offering(place.agent("robot", recording_topics="/go, /led"))

    @robot.on("*")
    async def anything(job: Job, message: Any) -> None:
        job.publish("/led", "on")
        job.publish("/camera", b"a picture")

    async with place.at_work(robot) as person:
        contract = await person.demand(place.save(objective(("/go", Empty()), ("/quietly", Empty()))))
        recording = await recorded(contract)
    assert {topic.name for topic in recording.topics} == {"/go", "/led"}


async def test_an_agent_without_executor_does_no_jobs(place: Place) -> None:
    robot = doing_nothing(offering(place.agent("robot", enable_executor=False)))
    async with place.at_work(robot) as person:
        contract = await person.demand(place.save(objective(("/go", Empty()))))
        head = await place.chains["robot"].block_number()
        await until(lambda: robot.parts.chain_head.head >= head)
        assert [job.phase for job in await robot.parts.ledger.jobs()] == [Phase.INCOMING]
        assert not (await place.chains["person"].liabilities.get(contract.address)).is_finalized


async def test_played_messages_are_on_the_mesh(place: Place) -> None:
    robot = doing_nothing(offering(place.agent("robot")))
    played: list[tuple[str, bytes, str]] = []
    async with place.at_work(robot) as person:
        listener: Any = person.parts.network.session.declare_subscriber(
            f"aira/agent/{place.address('robot').lower()}/liability/*/objective/**",
            lambda sample: played.append(
                (str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding)),
            ),
        )
        contract = await person.demand(place.save(objective(("/arm/left", "up"), ("/arm/left", "down"))))
        await contract.outcome()
        await until(lambda: len(played) == 2)
        listener.undeclare()
    key = f"aira/agent/{place.address('robot').lower()}/liability/{contract.address.lower()}/objective/arm/left"
    assert played == [(key, String(word).encode(), "ros1;std_msgs/String") for word in ("up", "down")]


async def test_a_burst_of_played_messages_is_recorded_whole_and_heard_in_order(place: Place) -> None:
    """Who listens on the mesh may miss messages of a burst, since Zenoh drops some; the recording misses none."""
    robot = doing_nothing(offering(place.agent("robot")))
    heard_by_listener: list[bytes] = []
    words = [String(str(number)).encode() for number in range(500)]
    async with place.at_work(robot) as person:
        listener: Any = person.parts.network.session.declare_subscriber(
            f"aira/agent/{place.address('robot').lower()}/liability/*/objective/say",
            lambda sample: heard_by_listener.append(sample.payload.to_bytes()),
        )
        contract = await person.demand(place.save(timed([("/say", String.decode(word), 0) for word in words])))
        recording = await recorded(contract)
        await until(lambda: heard_by_listener)
        listener.undeclare()
    assert heard(recording, "/say") == words
    positions = [words.index(word) for word in heard_by_listener]
    assert positions == sorted(set(positions))


async def test_a_late_device_message_of_a_played_topic_keeps_its_role(place: Place) -> None:
    """The recording distinguishes played messages from device messages of the same topic."""
    robot = offering(place.agent("robot"))

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        job.publish("/go", "gone")

    async with place.at_work(robot) as person:
        contract = await person.demand(place.save(objective(("/go", "go"))))
        messages: list[Played] = list((await recorded(contract)).messages())
    assert [String.decode(message.payload).data for message in messages] == ["go", "gone"]
