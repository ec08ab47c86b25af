"""An agent without handlers: another program drives it over Zenoh, and is its device too."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from mesh.agent.ledger import Phase
from mesh.recording import open_objective
from schemas import Liability, String
from schemas.keys import LiabilityTopicKey, ObjectiveTopicKey
from schemas.rpc import Done, LiabilityRead, LiabilityRequest
from tests.support.agent.controls import WORDS, Control, control, controlled, ready
from tests.support.market import in_phase, offering
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    import zenoh

    from mesh.agent.agent import Agent
    from mesh.agent.contracts import Contract
    from tests.support.market import Place

__all__ = ["control"]

HOUR_NS = 3600 * 10**9


async def recorded(contract: Contract) -> list[tuple[str, str]]:
    messages = open_objective(await contract.recording()).messages()
    return [(message.topic, String.decode(message.payload).data) for message in messages]


async def test_a_job_is_started_fed_and_finished_from_elsewhere(place: Place, control: Control, person: Agent) -> None:
    before = await place.balance("robot")
    contract = await ready(control, person, place, cost=500)
    assert await control.start(contract.address) == Done(True)
    await control.played(contract.address)
    await control.say(contract.address, "/arm/state", "done")
    await control.finish(contract.address)
    outcome = await contract.outcome()
    assert outcome.success
    assert await place.balance("robot") == before + 500
    assert await recorded(contract) == [*(("/say", word) for word in WORDS), ("/arm/state", "done")]


async def test_nothing_starts_or_ends_by_itself(place: Place, control: Control, person: Agent) -> None:
    contract = await ready(control, person, place)
    await control.start(contract.address)
    await control.played(contract.address)
    read = await control.read(contract.address)
    assert read.liability is not None
    assert (read.liability.is_finalized, read.liability.result) == (False, "")


async def test_a_job_finished_without_success_is_refunded(place: Place, control: Control, person: Agent) -> None:
    before = await place.balance("person")
    contract = await ready(control, person, place, cost=500)
    await control.start(contract.address)
    await control.finish(contract.address, success=False)
    assert not (await contract.outcome()).success
    assert await place.balance("person") == before


async def test_a_job_may_be_finished_before_it_was_started(place: Place, control: Control, person: Agent) -> None:
    contract = await ready(control, person, place)
    await control.finish(contract.address, success=False)
    assert not (await contract.outcome()).success
    assert await recorded(contract) == []


async def test_a_playback_in_progress_is_ended_by_finish(place: Place) -> None:
    robot = offering(place.agent("robot", playback="recorded"))
    async with controlled(place, robot) as control, place.agent("person") as person, asyncio.timeout(60):
        contract = await ready(control, person, place, step_ns=HOUR_NS)
        await control.start(contract.address)
        await control.position(contract.address, 1)
        await control.finish(contract.address)
        assert (await contract.outcome()).success
        assert await recorded(contract) == [("/say", WORDS[0])]


async def test_restart_begins_a_fresh_recording(place: Place, control: Control, person: Agent) -> None:
    contract = await ready(control, person, place)
    await control.start(contract.address)
    await control.played(contract.address)
    await control.say(contract.address, "/state", "first try")
    assert await control.ask("restart", LiabilityRequest(contract.address)) == Done(True)
    await control.played(contract.address)
    await control.say(contract.address, "/state", "second try")
    await control.finish(contract.address)
    await contract.outcome()
    assert await recorded(contract) == [*(("/say", word) for word in WORDS), ("/state", "second try")]


async def test_a_ready_job_may_be_restarted_too(place: Place, control: Control, person: Agent) -> None:
    contract = await ready(control, person, place)
    assert await control.ask("restart", LiabilityRequest(contract.address)) == Done(True)
    await control.played(contract.address)
    await control.finish(contract.address)
    assert (await contract.outcome()).success


async def test_resume_continues_a_job_after_a_restart_of_the_agent(place: Place, person: Agent) -> None:
    async with controlled(place, offering(place.agent("robot"))) as control:
        contract = await ready(control, person, place)
        await control.start(contract.address)
        await control.played(contract.address)
        await control.say(contract.address, "/state", "before")
    async with controlled(place, place.agent("robot")) as control:
        assert await control.ask("resume", LiabilityRequest(contract.address)) == Done(True)
        await control.say(contract.address, "/state", "after")
        await control.finish(contract.address)
        assert (await contract.outcome()).success
        assert await recorded(contract) == [
            *(("/say", word) for word in WORDS),
            ("/state", "before"),
            ("/state", "after"),
        ]


async def test_a_ready_job_can_be_started_right_after_the_agent_has_come_back(place: Place, person: Agent) -> None:
    """Its objective may not have been examined again yet."""
    async with controlled(place, offering(place.agent("robot"))) as control:
        contract = await ready(control, person, place)
    robot = place.agent("robot")
    async with place.provider(), robot:
        await robot.runtime.executor.start(contract.address)
        await robot.finish(contract.address, success=True)
        assert (await contract.outcome()).success


async def test_read_returns_the_job_of_the_ledger(place: Place, control: Control, person: Agent) -> None:
    contract = await ready(control, person, place, cost=7)
    assert await control.read(contract.address) == LiabilityRead(True, contract.liability)
    await control.finish(contract.address, success=True)
    outcome = await contract.outcome()
    await in_phase(control.robot, contract, Phase.FINALIZED)
    read = await control.read(contract.address)
    assert read.liability is not None
    assert (read.liability.result, read.liability.is_success, read.liability.is_finalized) == (
        outcome.result,
        True,
        True,
    )


async def test_addresses_may_be_asked_for_in_lower_case(place: Place, control: Control, person: Agent) -> None:
    contract = await ready(control, person, place)
    address = contract.address.lower()
    assert (await control.read(address)).read
    assert (await control.start(address)).success
    await control.finish(address)
    assert (await contract.outcome()).success


async def test_events_are_on_the_agents_keys_with_the_record(place: Place, control: Control, person: Agent) -> None:
    records: list[tuple[str, Liability]] = []
    subscriber: Any = control.session.declare_subscriber(
        f"aira/agent/{control.robot.address.lower()}/liability/*/*",
        lambda sample: records.append((str(sample.key_expr), Liability.decode(sample.payload.to_bytes()))),
    )
    contract = await ready(control, person, place)
    await control.start(contract.address)
    await control.finish(contract.address)
    outcome = await contract.outcome()
    await until(lambda: len(records) == 4)
    subscriber.undeclare()
    events = f"aira/agent/{control.robot.address.lower()}/liability/{contract.address.lower()}"
    assert [key for key, _ in records] == [
        f"{events}/{event}" for event in ("incoming", "ready", "complete", "finalized")
    ]
    assert [record.address for _, record in records] == [contract.address] * 4
    assert [record.result for _, record in records] == ["", "", outcome.result, outcome.result]
    assert [record.is_finalized for _, record in records] == [False, False, False, True]


async def test_a_device_receives_the_objective_and_answers_within_the_job(
    place: Place, control: Control, person: Agent
) -> None:
    contract = await ready(control, person, place)
    said = str(LiabilityTopicKey(control.robot.address, contract.address, "/echo"))

    answered: list[str] = []

    def echo(sample: zenoh.Sample) -> None:
        control.session.put(said, sample.payload.to_bytes(), encoding=sample.encoding)
        answered.append(said)

    heard = str(ObjectiveTopicKey(control.robot.address, contract.address, "/say"))
    subscriber: Any = control.session.declare_subscriber(heard, echo)
    await until_heard(control.robot.parts.network.session, heard)
    await control.start(contract.address)
    await control.played(contract.address)
    await until(lambda: len(answered) == len(WORDS), what="the device's answers")
    await control.say(contract.address, "/end", "x")
    await control.finish(contract.address)
    subscriber.undeclare()
    echoed = [word for topic, word in await recorded(contract) if topic == "/echo"]
    assert echoed == WORDS
