"""A run: an objective played, message by message, to a handler."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.handlers import HANDLER_LIMITS, Job
from mesh.agent.jobs import QUEUED
from mesh.errors import ClosedError, InvalidKey
from mesh.recording import NOTE_TOPIC
from schemas import InvalidPayload, LiabilityTopicKey, String
from tests.support.agent.runs import AGENT, Making, making, session
from tests.support.objectives import objective
from tests.support.waiting import until

if TYPE_CHECKING:
    from mesh.recording import Played

__all__ = ["making", "session"]


async def test_the_position_counts_the_handled_messages(making: Making) -> None:
    run = making.run(objective(("/a", "0"), ("/a", "1"), ("/a", "2")), position=1)
    run.open()
    positions: list[int] = []

    async def note(run: Job, _: Played) -> None:
        positions.append(run.position)

    await run.play(note)
    await run.close()
    assert positions == [1, 2]
    assert run.position == 3
    assert [payload for _, payload, _ in making.recorded()] == [String("1").encode(), String("2").encode()]


async def test_the_handler_gets_one_message_after_the_other_and_sees_which(making: Making) -> None:
    run = making.run(objective(("/a", "0"), ("/b", "1")))
    run.open()
    busy = 0

    async def slow(run: Job, message: Played) -> None:
        nonlocal busy
        assert busy == 0
        busy += 1
        assert run.playing is message
        await asyncio.sleep(0.02)
        busy -= 1

    await run.play(slow)
    await run.close()


async def test_a_failing_handler_stops_the_playback_with_its_error_and_its_cause(making: Making) -> None:
    run = making.run(objective(*(("/a", str(number)) for number in range(5)), step_ns=10**10))
    run.open()

    async def fail(_: Job, message: Played) -> None:
        raise ValueError("no") from KeyError("why")

    with pytest.raises(ValueError, match="no") as caught:
        await run.play(fail)
    assert isinstance(caught.value.__cause__, KeyError)
    assert run.position == 0
    await run.close()


async def test_cancelling_the_playback_cancels_the_handler_and_counts_handled_messages(making: Making) -> None:
    run = making.run(objective(("/a", "0"), ("/a", "1"), ("/a", "2")))
    run.open()
    begun: list[str] = []
    ended: list[str] = []

    async def stay_at_the_second(_: Job, message: Played) -> None:
        if message.payload == String("1").encode():
            begun.append("the second")
            try:
                await asyncio.sleep(60)
            except asyncio.CancelledError:
                ended.append("cancelled")
                raise

    playing = asyncio.create_task(run.play(stay_at_the_second))
    await until(lambda: begun)
    playing.cancel()
    with pytest.raises(asyncio.CancelledError):
        await playing
    assert ended == ["cancelled"]
    assert run.position == 1
    await run.close()


async def test_a_handler_may_close_its_own_run_and_is_the_last_to_be_called(making: Making) -> None:
    run = making.run(objective(*(("/a", str(number)) for number in range(QUEUED + 100)), step_ns=0))
    run.open()
    calls = 0

    async def close(_: Job, message: Played) -> None:
        nonlocal calls
        calls += 1
        await run.close("enough")

    async with asyncio.timeout(60):
        await run.play(close)
    assert calls == 1
    assert making.recorded()[-1] == (NOTE_TOPIC, String("enough").encode(), "ros1;std_msgs/String")


async def test_a_run_that_is_closed_while_its_handler_waits_for_a_message_ends(making: Making) -> None:
    run = making.run(objective(("/a", "now"), ("/a", "much later"), step_ns=10**12), speed=1.0)
    run.open()
    playing = asyncio.create_task(run.play(None))
    await until(lambda: run.position == 1)
    await run.close()
    async with asyncio.timeout(60):
        await playing
    assert run.position == 1


async def test_a_run_that_was_never_opened_can_be_closed_with_a_note(making: Making) -> None:
    assert (await making.run().close("nothing was done")).messages == 1


async def test_nothing_can_be_published_before_opening_or_after_closing(making: Making) -> None:
    run = making.run()
    with pytest.raises(ClosedError):
        run.publish("/led", "on")
    run.open()
    await run.close()
    with pytest.raises(ClosedError):
        run.publish("/led", "on")


@pytest.mark.parametrize("value", [object(), {1: object()}, float])
async def test_a_value_that_can_not_travel_is_refused(making: Making, value: Any) -> None:
    run = making.run()
    run.open()
    with pytest.raises(InvalidPayload):
        run.publish("/led", value)
    await run.close()


async def test_closing_works_when_the_session_has_broken(making: Making) -> None:
    run = making.run()
    run.open()
    run.publish("/led", "on")
    await asyncio.to_thread(making.session.close)
    async with asyncio.timeout(60):
        await run.close("the network is gone")


async def test_a_handler_hears_what_comes_on_a_topic_until_the_job_ends(making: Making) -> None:
    run = making.run(objective(("/go", "a"), ("/go", "b")))
    with pytest.raises(ClosedError):
        run.listen("/answers")
    run.open()
    with pytest.raises(InvalidKey):
        run.listen("answers")
    heard = run.listen("/answers")
    key = str(LiabilityTopicKey(AGENT, run.liability.address, "/answers"))

    async def answer(job: Job, message: Played) -> None:
        run.publish("/others", "not listened to")
        making.session.put(key, b"{", encoding="application/json")
        making.session.put(key, b'{"to": 1}', encoding="application/json")
        assert await asyncio.wait_for(anext(heard), 30) == {"to": 1}

    await run.play(answer)
    run.publish("/answers", None)
    run.publish("/answers", "the last")
    await run.close()
    assert [message async for message in heard] == [None, "the last"]
    with pytest.raises(ClosedError):
        run.listen("/answers")


async def test_of_too_many_messages_that_nobody_takes_the_oldest_are_left_out(making: Making) -> None:
    run = making.run(objective(("/go", "a")))
    run.open()
    heard = run.listen("/count")
    for number in range(HANDLER_LIMITS.messages + 10):
        run.publish("/count", number)
    await run.close()
    assert [message async for message in heard] == list(range(10, HANDLER_LIMITS.messages + 10))
    assert heard.dropped == 10
