"""Answers without a contract: asked by a demand that pays nothing, given by a Result that names the asker."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from mesh import Demand, InputError, Result, Unanswered, Verified
from mesh.agent.orders import lifetime_of
from mesh.network.readings import LARGEST_READING
from schemas import cid_of_bytes, verify_message
from tests.support.market import MODEL
from tests.support.objectives import objective
from tests.support.orders import demand as someones_demand
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh import Agent
    from tests.support.market import Place

ARGUMENTS = cid_of_bytes(b"what is asked")


def answering(robot: Agent) -> Agent:
    """A robot that answers with the demand's objective."""

    @robot.on_demand
    async def answer(demand: Verified[Demand]) -> None:
        await robot.answer(demand, {"asked": demand.message.objective}, topic="/said")

    return robot


async def test_a_question_is_answered_by_a_robot_that_starts_later_and_no_contract_is_made(place: Place) -> None:
    async with place.provider(), place.agent("person") as person:
        asking = asyncio.create_task(person.ask(objective=ARGUMENTS))
        async with answering(place.agent("robot")) as robot:
            answer = await asking
            bare = await person.ask(MODEL, agent=robot.address)
        assert person.orders() == []
    assert (answer.value, answer.agent) == ({"asked": ARGUMENTS}, place.address("robot"))
    assert [message.topic for message in answer.messages] == ["/said"]
    assert bare.value == {"asked": MODEL}


async def test_a_text_is_answered_as_a_text(place: Place) -> None:
    robot = place.agent("robot")

    @robot.on_demand
    async def answer(demand: Verified[Demand]) -> None:
        await robot.answer(demand, "it rains")

    async with robot, place.agent("person") as person:
        given = await person.ask()
    assert (given.value, given.values) == ("it rains", ("it rains",))


async def test_nobody_answers(place: Place) -> None:
    async with place.agent("person") as person:
        with pytest.raises(Unanswered) as caught:
            await person.ask(timeout=0.5)
    assert caught.value.model == MODEL


async def test_an_answer_that_is_too_large_is_refused_at_once(place: Place) -> None:
    async with place.agent("robot") as robot:
        with raises_with(InputError, code="reading-too-large"):
            await robot.answer(verify_message(someones_demand()), bytes(LARGEST_READING + 1))


async def answer_from(robot: Agent, person: Agent, *results: str, until: Callable[[], bool]) -> None:
    """Send these results to the asker again and again, as a stranger or a legacy robot may."""
    async with asyncio.timeout(30):
        while not until():
            for result in results:
                robot.send(Result(liability=person.address, result=result, success=True))
            await asyncio.sleep(0.1)


async def test_what_is_no_answer_is_passed_over_and_a_legacy_answer_is_taken(place: Place) -> None:
    async with place.agent("robot") as robot, place.agent("person") as person:
        to_another_question = await robot.answer(verify_message(someones_demand()), "wrong")
        unreadable = await robot.add(place.save(b"no recording"))
        legacy = await robot.add(place.save(objective(("/measurements", "0.5 1.0"))))
        asking = asyncio.create_task(person.ask())
        wrong, counted = (ARGUMENTS, unreadable, to_another_question), person.drops.totals
        await answer_from(robot, person, *wrong, until=lambda: "answer-unreadable" in counted())
        await answer_from(robot, person, *wrong, legacy, until=asking.done)
        answer = await asking
    assert (answer.value, answer.result) == ("0.5 1.0", legacy)


async def test_an_answer_that_nobody_had_is_fetched_when_it_is_sent_again(place: Place) -> None:
    late = place.save(objective(("/measurements", "0.5 1.0")))
    async with place.agent("robot") as robot, place.agent("person", fetch_timeout=0.1) as person:
        asking, cid = asyncio.create_task(person.ask()), cid_of_bytes(late.read_bytes())
        await answer_from(robot, person, cid, until=lambda: "answer-unreadable" in person.drops.totals())
        await robot.add(late)
        await answer_from(robot, person, cid, until=asking.done)
        assert (await asking).result == cid


async def test_only_the_named_agent_is_believed(place: Place) -> None:
    async with place.agent("robot") as robot, place.agent("provider") as other, place.agent("person") as person:
        cid = await other.add(place.save(objective(("/said", "by another"))))
        asking = asyncio.create_task(person.ask(agent=robot.address, timeout=2))
        await answer_from(other, person, cid, until=asking.done)
        with pytest.raises(Unanswered):
            await asking


async def test_a_question_lives_as_long_as_its_asker_waits(place: Place) -> None:
    """Answered, given up or cancelled: no provider has it any more, and a robot that starts later sees none of them."""
    robot, seen = place.agent("robot"), list[str]()

    @robot.on_demand
    async def note(demand: Verified[Demand]) -> None:
        seen.append(demand.message.objective)

    async with place.provider() as provider, place.agent("person") as person:
        async with answering(place.agent("provider")):
            assert (await person.ask(objective=ARGUMENTS)).value == {"asked": ARGUMENTS}
        with pytest.raises(Unanswered):
            await person.ask(timeout=3)  # long enough to ask it twice
        asking = asyncio.create_task(person.ask())
        await until(lambda: len(provider.book) == 1, what="the last question")
        asking.cancel()
        await asyncio.wait([asking])
        await until(lambda: len(provider.book) == 0, what="no open question")
        async with robot:
            order = await person.order(cid_of_bytes(b"something to be done"))
            await until(lambda: order.message.objective in seen)
        assert seen == [order.message.objective]


async def test_a_question_of_a_process_that_was_killed_expires_with_its_patience(place: Place) -> None:
    async with place.provider() as provider, place.agent("person") as person:
        asking = asyncio.create_task(person.ask(timeout=20))
        await until(lambda: len(provider.book) == 1)
        [question] = provider.book.orders()
        head = await place.chains["person"].block_number()
        assert question.message.deadline <= head + await lifetime_of(place.chains["person"], 20)
        asking.cancel()
        await asyncio.wait([asking])
