"""`mesh.testing.run`: an agent's handlers alone."""

from __future__ import annotations

import asyncio
import threading
import time
from typing import TYPE_CHECKING, Annotated

import pytest
from msgspec import Meta, Struct

from mesh import Agent, AiraError, Empty, Job, JobFailed, ModelUnfit, pack_values
from mesh.testing import FakeJob, assert_paid, assert_refunded, run
from schemas.errors import InvalidPayload

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


class Move(Struct):
    metres: float


@pytest.fixture
def robot() -> Agent:
    return Agent()


async def test_it_gives_what_the_handlers_published_in_order(robot: Agent) -> None:
    @robot.on("/lift")
    async def lift(job: Job, metres: float) -> None:
        job.publish("/height", metres)
        job.publish("/log", {"metres": metres, "at": job.position})

    outcome = await run(robot, FakeJob([("/lift", 1.5), ("/lift", 2)]))

    assert_paid(outcome)
    assert outcome.recording.values("/height") == [1.5, 2.0]
    assert outcome.recording.published[1] == ("/log", {"metres": 1.5, "at": 0})
    assert [one.topic for one in outcome.recording.messages] == ["/lift", "/height", "/log"] * 2


async def test_messages_have_the_type_that_the_handler_declares(robot: Agent) -> None:
    handled: list[object] = []

    @robot.on("/move")
    async def move(job: Job, message: Move) -> None:
        handled.append(message)

    @robot.on("*")
    async def others(job: Job, message: Empty | int | str) -> None:
        handled.append(message)

    messages = [("/move", {"metres": 2}), ("/stop", Empty()), ("/count", 5.0), ("/say", "hello"), ("/move", Move(3.0))]
    assert_paid(await run(robot, FakeJob(messages)))

    assert handled == [Move(2.0), Empty(), 5, "hello", Move(3.0)]


async def test_a_job_with_messages_that_no_handler_takes_is_refused_before_it_is_played(robot: Agent) -> None:
    handled = []

    @robot.on("/lift")
    async def lift(job: Job, metres: Annotated[float, Meta(le=2)]) -> None:
        handled.append(metres)

    for message in (("/lift", 3.0), ("/lift", "high"), ("/drop", 1.0)):
        assert_refunded(await run(robot, FakeJob([("/lift", 1.0), message])), code="objective-unfit")
    assert handled == []


async def test_the_description_of_the_model_is_obeyed(tmp_path: Path) -> None:
    described = Agent()
    described.on("/lift", float)(lambda job, metres: None)
    model = tmp_path / "model.json"
    model.write_bytes(described.model_description("Lift").encode())
    robot = Agent(model)
    robot.on("/lift")(lambda job, anything: None)

    assert_paid(await run(robot, FakeJob([("/lift", 1.0)])))
    assert_refunded(await run(robot, FakeJob([("/lift", "high")])), code="objective-unfit")
    unfit = Agent(model)
    unfit.on("/drop")(lambda job, anything: None)
    with pytest.raises(ModelUnfit):
        await run(unfit, FakeJob([("/lift", 1.0)]))


async def test_a_failure_has_the_reason_and_the_code_of_its_exception(robot: Agent) -> None:
    class Weak(AiraError, code="weak"):
        """Tests raise it."""

    errors = {
        "failed": JobFailed("too heavy"),
        "coded": JobFailed("the battery is empty", code="battery-empty"),
        "own": Weak("no"),
        "bug": ZeroDivisionError("division by zero"),
        "cancelled": asyncio.CancelledError(),
    }

    @robot.on("/lift")
    async def lift(job: Job, how: str) -> None:
        job.publish("/height", 0.5)
        raise errors[how]

    ended = {how: await run(robot, FakeJob([("/lift", how), ("/lift", how)])) for how in errors}

    assert {how: (one.reason, one.code) for how, one in ended.items()} == {
        "failed": ("too heavy", "job-failed"),
        "coded": ("the battery is empty", "battery-empty"),
        "own": ("no", "weak"),
        "bug": ("ZeroDivisionError: division by zero", "handler-failed"),
        "cancelled": ("the handler of /lift was cancelled", "handler-cancelled"),
    }
    assert all(not one.success and one.recording.values("/height") == [0.5] for one in ended.values())


async def test_sleeping_takes_no_time_and_is_counted(robot: Agent) -> None:
    @robot.on("/lift")
    async def lift(job: Job, metres: float) -> None:
        await asyncio.gather(asyncio.sleep(3600), asyncio.sleep(10))
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(20):
                await asyncio.sleep(30)

    began = time.monotonic()
    outcome = await run(robot, FakeJob([("/lift", 1.0), ("/lift", 1.0)]))

    assert outcome.seconds == pytest.approx(2 * 3620)
    assert time.monotonic() - began < 5


async def test_time_waits_for_what_works_in_a_thread(robot: Agent) -> None:
    released = threading.Event()

    @robot.on("/sync")
    def sync(job: Job, seconds: float) -> None:
        time.sleep(seconds)
        job.publish("/slept", seconds)

    @robot.on("/thread")
    async def thread(job: Job, seconds: float) -> None:
        async with asyncio.timeout(60):
            waiting = asyncio.create_task(asyncio.to_thread(released.wait))
            await asyncio.sleep(seconds)
            released.set()
            await waiting
        await asyncio.sleep(1000)

    outcome = await run(robot, FakeJob([("/sync", 0.1), ("/thread", 0.1)]))

    assert_paid(outcome)
    assert outcome.recording.values("/slept") == [0.1]
    assert 1000.1 < outcome.seconds < 1030


async def test_time_waits_for_sockets(robot: Agent) -> None:
    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(await reader.readline())
        await writer.drain()
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]

        @robot.on("/ask")
        async def ask(job: Job, word: str) -> None:
            async with asyncio.timeout(30):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.write(f"{word}\n".encode())
                job.publish("/answer", (await reader.readline()).decode().strip())
                writer.close()
                await writer.wait_closed()

        outcome = await run(robot, FakeJob([("/ask", "hello")]))
    assert outcome.recording.values("/answer") == ["hello"]


async def test_a_handler_hears_what_it_publishes(robot: Agent) -> None:
    @robot.on("/lift")
    async def lift(job: Job, metres: float) -> None:
        heard = job.listen("/height")
        job.publish("/height", metres)
        job.publish("/heard", await anext(heard))

    assert (await run(robot, FakeJob([("/lift", 1.5)]))).recording.values("/heard") == [1.5]


async def waiting_for_a_device(job: Job) -> None:
    async for _ in job.listen("/measurements"):
        """No device says anything."""


async def polling(job: Job) -> None:
    while True:
        await asyncio.sleep(60)


@pytest.mark.parametrize("wait", [waiting_for_a_device, polling])
async def test_handlers_that_would_never_end_are_an_error(robot: Agent, wait: Callable[[Job], object]) -> None:
    @robot.on("/lift")
    async def lift(job: Job, metres: float) -> None:
        await wait(job)  # type: ignore[misc]

    with pytest.raises(AiraError) as caught:
        await run(robot, FakeJob([("/lift", 1.0)]))
    assert caught.value.code == "handler-stuck"


async def test_cancelling_the_run_cancels_the_handlers(robot: Agent) -> None:
    cancelled, began = threading.Event(), threading.Event()

    @robot.on("/lift")
    async def lift(job: Job, metres: float) -> None:
        began.set()
        try:
            await asyncio.to_thread(cancelled.wait)
        except asyncio.CancelledError:
            cancelled.set()
            raise

    running = asyncio.create_task(run(robot, FakeJob([("/lift", 1.0)])))
    await asyncio.to_thread(began.wait)
    running.cancel()
    assert await asyncio.to_thread(cancelled.wait, 30)


async def test_nothing_can_be_published_after_the_end(robot: Agent) -> None:
    jobs = []

    @robot.on("/lift")
    async def lift(job: Job, metres: float) -> None:
        jobs.append(job)

    await run(robot, FakeJob([("/lift", 1.0)]))
    with pytest.raises(AiraError) as caught:
        jobs[0].publish("/height", 1.0)
    assert caught.value.code == "closed-error"


async def test_a_file_is_played(robot: Agent, tmp_path: Path) -> None:
    heard = []
    robot.on("/say", str)(lambda job, word: heard.append(word))
    pack_values([("/say", "hello")], tmp_path / "words.mcap")

    assert_paid(await run(robot, FakeJob(tmp_path / "words.mcap")))
    assert heard == ["hello"]
    with pytest.raises(AiraError) as caught:
        await run(robot, FakeJob(tmp_path / "nothing.mcap"))
    assert caught.value.code == "not-an-objective"


async def test_what_no_message_can_be_is_an_error_at_once(robot: Agent) -> None:
    with pytest.raises(InvalidPayload):
        await run(robot, FakeJob([("/say", object())]))
