"""A run: an objective played, and all that is said on the job's topics recorded."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
import zenoh

from mesh.errors import ClosedError
from mesh.recording import AtOnce, RecordedTimes, Recorder, RecordingAbout, json_type, open_objective
from mesh.work.run import AHEAD, FLUSH, NOTE_TOPIC, HandlerCancelled, Plan, Run
from schemas import Empty, InvalidPayload, String
from tests.mesh.work.samples import liability
from tests.support.bags import Bag, Sent
from tests.support.objectives import objective
from tests.support.routers import EmbeddedRouter, client_config
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator
    from pathlib import Path

    from mesh.recording import Objective, Played

AGENT = "0x" + "ab" * 20
AT_ONCE = AtOnce()
TOPICS = f"aira/agent/{AGENT}/liability/{liability().address.lower()}/topic"


@pytest.fixture
def session(router: EmbeddedRouter) -> Iterator[zenoh.Session]:
    """The agent's session."""
    with zenoh.open(client_config(router.endpoint)) as opened:
        yield opened


@pytest.fixture
def device(router: EmbeddedRouter) -> Iterator[zenoh.Session]:
    """The session of a device, elsewhere in the mesh."""
    with zenoh.open(client_config(router.endpoint)) as opened:
        yield opened


class Making:
    """Makes runs in a folder."""

    def __init__(self, session: zenoh.Session, folder: Path) -> None:
        self._session = session
        self._folder = folder
        self.path = folder / "run.mcap"

    def run(
        self,
        content: bytes = b"",
        *,
        position: int = 0,
        topics: frozenset[str] | None = None,
        pace: AtOnce | RecordedTimes = AT_ONCE,
    ) -> Run:
        """A run of the objective in `content`, not yet open."""
        played: Objective | None = None
        if content:
            (self._folder / "objective.mcap").write_bytes(content)
            played = open_objective(self._folder / "objective.mcap")
        plan = Plan(liability=liability(), objective=played, pace=pace, position=position, topics=topics)
        return Run(self._session, AGENT, plan, Recorder(self.path, RecordingAbout()))

    def recorded(self) -> list[tuple[str, bytes, str]]:
        """What is in the closed recording: topic, payload, type."""
        messages = open_objective(self.path).messages()
        return [(message.topic, message.payload, message.type.zenoh_encoding) for message in messages]


@pytest.fixture
def making(session: zenoh.Session, tmp_path: Path) -> Making:
    return Making(session, tmp_path)


class Performing:
    """A performer that calls a function with each message."""

    topics = None

    def __init__(self, function: Callable[[Run, Played], Awaitable[object]]) -> None:
        self._function = function

    def obstacle(self, topic: str, said: Any) -> str:
        return ""

    async def perform(self, run: Run, message: Played) -> None:
        await self._function(run, message)


class Positions(list[int]):
    """Takes note of a run's progress."""

    async def __call__(self, position: int) -> None:
        self.append(position)


async def test_what_the_agent_publishes_is_recorded_with_its_type(making: Making) -> None:
    run = making.run()
    run.open()
    run.publish("/led", "on")
    run.publish("/camera/left", b"\x01")
    run.publish("/pose", {"x": 1})
    run.publish("/tick", Empty())
    summary = await run.close()
    assert summary.messages == 4
    assert making.recorded() == [
        ("/led", String("on").encode(), "ros1;std_msgs/String"),
        ("/camera/left", b"\x01", "application/octet-stream"),
        ("/pose", b'{"x":1}', "application/json"),
        ("/tick", b"", "ros1;std_msgs/Empty"),
    ]


class Wheel(msgspec.Struct):
    """What a wheel says."""

    turns: int


async def test_a_struct_is_recorded_with_the_schema_of_its_class(making: Making) -> None:
    run = making.run()
    run.open()
    run.publish("/wheel", Wheel(3))
    await run.close()
    (topic,) = open_objective(making.path).topics
    assert topic.type == json_type(Wheel)
    assert making.recorded() == [("/wheel", b'{"turns":3}', "application/json;Wheel")]


async def test_a_type_that_the_objective_describes_is_recorded_with_that_description(making: Making) -> None:
    scan = Sent("/scan", b"\0", 1, type="my/Scan", definition="float32 angle\n")
    run = making.run(Bag([scan]).encode())
    run.open()
    making._session.put(f"{TOPICS}/scanned", b"\1", encoding="ros1;my/Scan")
    await run.close()
    (topic,) = open_objective(making.path).topics
    assert (topic.name, topic.type.schema_data) == ("/scanned", b"float32 angle\n")


async def test_what_another_session_puts_before_the_end_is_recorded(making: Making, device: zenoh.Session) -> None:
    run = making.run()
    run.open()
    await until_heard(device, f"{TOPICS}/wheel")
    for number in range(500):
        device.put(f"{TOPICS}/wheel", b"%d" % number, encoding="application/json")
    device.put(f"{TOPICS}/unknown/type", b"?", encoding="ros1;wheels/Wheel")
    # The agent has it all when what came after has arrived.
    arrived: list[object] = []
    with making._session.declare_subscriber("after", arrived.append):
        await until_heard(device, "after")
        device.put("after", b"")
        await until(lambda: arrived)
    await run.close()
    recorded = making.recorded()
    assert recorded[:500] == [("/wheel", b"%d" % number, "application/json") for number in range(500)]
    assert recorded[500] == ("/unknown/type", b"?", "ros1;wheels/Wheel")


async def test_closing_waits_until_all_that_was_published_is_recorded(making: Making) -> None:
    run = making.run()
    run.open()
    for number in range(5000):
        run.publish("/count", {"n": number})
    assert (await run.close()).messages == 5000


async def test_a_forged_end_mark_of_another_session_does_not_cut_the_recording(
    making: Making, device: zenoh.Session
) -> None:
    run = making.run()
    run.open()
    await until_heard(device, f"{TOPICS}/x")
    device.put(f"{TOPICS}{NOTE_TOPIC}", b"", encoding=FLUSH)
    device.put(f"{TOPICS}{NOTE_TOPIC}", b"forged", encoding=FLUSH)
    with making._session.declare_subscriber(f"{TOPICS}/**", zenoh.handlers.RingChannel(8)) as copies:
        await until_heard(device, "aira/agent/*/liability/*/topic/y")
        device.put(f"{TOPICS}/x", b"arrived")
        await until(copies.try_recv)
    assert not run._flushed.is_set()
    await run.close()
    assert (b"arrived") in [payload for _, payload, _ in making.recorded()]


async def test_what_can_not_be_recorded_is_counted_and_the_rest_recorded(making: Making, device: zenoh.Session) -> None:
    run = making.run()
    run.open()
    await until_heard(device, f"{TOPICS}/good")
    device.put(f"{TOPICS}/bad topic", b"")
    device.put(f"{TOPICS}/good", b"good")
    await until(lambda: run.refused)
    await run.close()
    assert run.refused == 1
    assert [topic for topic, _, _ in making.recorded()] == ["/good"]


async def test_only_chosen_topics_are_recorded_and_all_are_played(making: Making) -> None:
    run = making.run(objective(("/a", "a"), ("/b", "b")), topics=frozenset({"/a", "/said"}))
    run.open()
    run.publish("/said", "x")
    run.publish("/unsaid", "y")
    performed: list[str] = []

    async def note(_: Run, message: Played) -> None:
        performed.append(message.topic)

    await run.play(Performing(note), progress=Positions())
    await run.close()
    assert performed == ["/a", "/b"]
    assert sorted(topic for topic, _, _ in making.recorded()) == ["/a", "/said"]


async def test_progress_counts_what_is_done_with(making: Making) -> None:
    run = making.run(objective(("/a", "0"), ("/a", "1"), ("/a", "2")), position=1)
    run.open()
    positions = Positions()
    await run.play(None, progress=positions)
    await run.close()
    assert positions == [2, 3]
    assert run.position == 3
    assert [payload for _, payload, _ in making.recorded()] == [String("1").encode(), String("2").encode()]


async def test_the_handler_gets_one_message_after_the_other_and_sees_which(making: Making) -> None:
    run = making.run(objective(("/a", "0"), ("/b", "1")))
    run.open()
    busy = 0

    async def slow(run: Run, message: Played) -> None:
        nonlocal busy
        assert busy == 0
        busy += 1
        assert run.playing is message
        await asyncio.sleep(0.02)
        busy -= 1

    await run.play(Performing(slow), progress=Positions())
    await run.close()


async def test_a_failing_handler_stops_the_playing_with_its_error_and_its_cause(making: Making) -> None:
    run = making.run(objective(*(("/a", str(number)) for number in range(5)), step_ns=10**10))
    run.open()

    async def fail(_: Run, message: Played) -> None:
        raise ValueError("no") from KeyError("why")

    with pytest.raises(ValueError, match="no") as caught:
        await run.play(Performing(fail), progress=Positions())
    assert isinstance(caught.value.__cause__, KeyError)
    assert run.position == 0
    await run.close()


async def test_a_handler_that_ends_cancelled_is_a_failure_and_not_the_end(making: Making) -> None:
    run = making.run(objective(("/a", "0"), ("/a", "1")))
    run.open()

    async def wait_for_what_is_cancelled(_: Run, message: Played) -> None:
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        future.cancel()
        await future

    with pytest.raises(HandlerCancelled):
        await run.play(Performing(wait_for_what_is_cancelled), progress=Positions())
    await run.close()


async def test_cancelling_the_playing_cancels_the_handler_and_counts_what_was_done(making: Making) -> None:
    run = making.run(objective(("/a", "0"), ("/a", "1"), ("/a", "2")))
    run.open()
    ended: list[str] = []

    async def stay_at_the_second(_: Run, message: Played) -> None:
        if message.payload == String("1").encode():
            try:
                await asyncio.sleep(60)
            except asyncio.CancelledError:
                ended.append("cancelled")
                raise

    playing = asyncio.create_task(run.play(Performing(stay_at_the_second), progress=Positions()))
    await until(lambda: run.position == 1)
    playing.cancel()
    with pytest.raises(asyncio.CancelledError):
        await playing
    assert ended == ["cancelled"]
    assert run.position == 1
    await run.close()


async def test_a_handler_may_close_its_own_run_and_is_the_last_to_be_called(making: Making) -> None:
    run = making.run(objective(*(("/a", str(number)) for number in range(AHEAD + 100)), step_ns=0))
    run.open()
    calls = 0

    async def close(run: Run, message: Played) -> None:
        nonlocal calls
        calls += 1
        await run.close("enough")

    async with asyncio.timeout(10):
        await run.play(Performing(close), progress=Positions())
    assert calls == 1
    assert making.recorded()[-1] == (NOTE_TOPIC, String("enough").encode(), "ros1;std_msgs/String")


async def test_a_run_that_is_closed_while_its_handler_waits_for_a_message_ends(making: Making) -> None:
    run = making.run(objective(("/a", "now"), ("/a", "much later"), step_ns=10**12), pace=RecordedTimes())
    run.open()
    playing = asyncio.create_task(run.play(None, progress=Positions()))
    await until(lambda: run.position == 1)
    await run.close()
    async with asyncio.timeout(10):
        await playing
    assert run.position == 1


async def test_a_note_is_the_last_message(making: Making) -> None:
    run = making.run()
    run.open()
    run.publish("/led", "on")
    await run.close("the lamp is broken")
    assert [topic for topic, _, _ in making.recorded()] == ["/led", NOTE_TOPIC]


async def test_a_run_that_was_never_opened_can_be_closed_with_a_note(making: Making) -> None:
    assert (await making.run().close("nothing was done")).messages == 1


async def test_nothing_can_be_published_before_opening_or_after_closing(making: Making) -> None:
    run = making.run()
    with pytest.raises(ClosedError):
        run.publish("/led", "on")
    run.open()
    await run.close()
    with pytest.raises(ClosedError, match="is not open"):
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
    await asyncio.to_thread(making._session.close)
    async with asyncio.timeout(10):
        await run.close("the network is gone")
