"""Which messages on the topics of a job a run records."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
import zenoh

from mesh.agent.jobs import FLUSH
from mesh.recording import NOTE_TOPIC, json_type, open_objective
from mesh.recording._recorder import PartialFile
from schemas import Empty, String
from tests.support.agent.runs import AGENT, Making, making, session
from tests.support.agent.samples import liability
from tests.support.bags import Bag, BagMessage
from tests.support.objectives import objective
from tests.support.routers import EmbeddedRouter, client_config
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.agent.handlers import Job
    from mesh.recording import Played

__all__ = ["making", "session"]

TOPICS = f"aira/agent/{AGENT}/liability/{liability().address.lower()}/topic"


@pytest.fixture
def device(router: EmbeddedRouter) -> Iterator[zenoh.Session]:
    """The session of a device, elsewhere in the mesh."""
    with zenoh.open(client_config(router.endpoint)) as opened:
        yield opened


async def test_messages_of_the_agent_are_recorded_with_their_type(making: Making) -> None:
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
        ("/pose", b'{"x":1}', "application/json;pose"),
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
    scan = BagMessage("/scan", b"\0", 1, type="my/Scan", definition="float32 angle\n")
    run = making.run(Bag([scan]).encode())
    run.open()
    making.session.put(f"{TOPICS}/scanned", b"\1", encoding="ros1;my/Scan")
    await run.close()
    (topic,) = open_objective(making.path).topics
    assert (topic.name, topic.type.schema_data) == ("/scanned", b"float32 angle\n")


async def test_playing_waits_for_a_slow_disk_and_loses_nothing(making: Making, monkeypatch: pytest.MonkeyPatch) -> None:
    add, waiting = PartialFile.add, list[int]()

    def slowly(self: PartialFile, messages: list[Any]) -> Any:
        waiting.append(len(messages))
        time.sleep(0.02)
        return add(self, messages)

    monkeypatch.setattr(PartialFile, "add", slowly)
    run = making.run(objective(*(("/blob", bytes(1000)) for _ in range(300))), queue_bytes=20_000)
    run.open()
    await run.play(None)
    summary = await run.close()
    assert (summary.messages, summary.lost) == (300, 0)
    assert max(waiting) <= 20


async def test_a_sync_has_what_was_handled_and_what_the_handlers_published(making: Making) -> None:
    run = making.run(objective(*(("/say", str(number)) for number in range(100))))
    run.open()
    synced: list[tuple[int, int]] = []

    async def say(job: Job, message: Played) -> None:
        job.publish("/said", message.payload)
        if job.position == 50:
            synced.append(await run.sync())

    await run.play(say)
    ((position, messages),) = synced
    assert position == 50
    assert messages >= 101, "fifty were handled and answered, the next was played"
    assert await run.sync() == (100, 200)
    await run.close()
    assert await run.sync() == (100, 200)


async def test_messages_of_another_session_before_the_end_are_recorded(making: Making, device: zenoh.Session) -> None:
    run = making.run()
    run.open()
    await until_heard(device, f"{TOPICS}/wheel")
    for number in range(500):
        device.put(f"{TOPICS}/wheel", b"%d" % number, encoding="application/json")
    device.put(f"{TOPICS}/unknown/type", b"?", encoding="ros1;wheels/Wheel")
    # The agent has it all when what came after has arrived.
    arrived: list[object] = []
    with making.session.declare_subscriber("after", arrived.append):
        await until_heard(device, "after")
        device.put("after", b"")
        await until(lambda: arrived)
    await run.close()
    recorded = making.recorded()
    assert recorded[:500] == [("/wheel", b"%d" % number, "application/json;wheel") for number in range(500)]
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
    with making.session.declare_subscriber(f"{TOPICS}/**", zenoh.handlers.RingChannel(8)) as copies:
        await until_heard(device, "aira/agent/*/liability/*/topic/y")
        device.put(f"{TOPICS}/x", b"arrived")
        await until(lambda: (copy := copies.try_recv()) is not None and copy.payload.to_bytes() == b"arrived")
    run.publish("/last", b"mine")
    await run.close()
    assert (b"mine") in [payload for _, payload, _ in making.recorded()]
    assert (b"arrived") in [payload for _, payload, _ in making.recorded()]


async def test_unrecordable_messages_are_counted_and_the_others_recorded(making: Making, device: zenoh.Session) -> None:
    run = making.run()
    run.open()
    await until_heard(device, f"{TOPICS}/good")
    device.put(f"{TOPICS}/bad topic", b"")
    device.put(f"{TOPICS}/good", b"good")
    device.put(f"{TOPICS}/bad topic", b"")
    await until(lambda: run.unrecordable == 2)
    await run.close()
    assert [topic for topic, _, _ in making.recorded()] == ["/good"]
