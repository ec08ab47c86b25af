"""The market, an agent and a job at a real market, as a viewer sees them."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

from bridges.foxglove.server import FoxgloveServer
from bridges.foxglove.sources import show_agent, show_job_until_end, show_market, show_recording
from bridges.web.components import opened
from mesh import Agent, Job, String
from mesh.base.background import Background
from mesh.errors import InputError
from mesh.role.composition import watching
from mesh.testing import assert_paid
from schemas.keys import DeviceTopicKey, ReadingKey
from schemas.payloads import Payload, PayloadType, SentDefinitions
from tests.support.foxglove.viewer import PLAY, viewing
from tests.support.market import MODEL, offering
from tests.support.raising import raises_with
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.testing import Market

BLINK = [("/blink", "on")]
OWN = PayloadType("ros1", "my_msgs/Own", "ros1msg", b"uint8 a\n")
SAID = PayloadType("ros1", "my_msgs/Said", "ros1msg", b"uint8 a\n")


def blinking() -> Agent:
    """A robot that says on `/blinked` what it plays, and on `/own` something of a type of its own."""
    robot = offering(Agent())

    @robot.on("/blink")
    async def blink(job: Job, message: String) -> None:
        job.publish("/blinked", message.data)
        job.publish("/own", Payload(b"\x07", SAID))

    return robot


@asynccontextmanager
async def showing_market(market: Market, front: Any) -> AsyncIterator[str]:
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        view = await enter(front())
        network, channel = await enter(watching(market.settings("viewer")))
        server = await enter(FoxgloveServer(view, "market"))
        tasks = await enter(Background())
        tasks.start(show_market(server, network.session, channel), "market")
        yield view.url


async def test_the_market_is_seen_as_a_stream(market: Market, front: Any) -> None:
    robot = blinking()
    async with showing_market(market, front) as url, viewing(url) as viewer, market.robot(robot):
        person = await market.person()
        outcome = await market.order(MODEL, BLINK, by=person, cost=100)
        (demand, *_) = await viewer.until_seen("/market/demand")
        assert (demand["signer"], demand["cost"]) == (person.address, "100")
        (result, *_) = await viewer.until_seen("/market/result")
        assert result["liability"] == outcome.contract
        await until(lambda: "complete" in {job["event"] for job in viewer.values("/market/job")})
        robot.publish("/battery", 0.5)
        await viewer.until_seen(f"/{robot.address.lower()}/battery")
        await until(lambda: any(counts["reading"] for counts in viewer.values("/aira/counts")))
        await until(
            lambda: any(outcome.contract in line["message"] for line in viewer.values("/aira/log")),
            what="the contract in the log",
        )


async def test_an_agent_is_seen_with_its_devices_and_its_jobs(market: Market, front: Any) -> None:
    robot = blinking()
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        view = await enter(front())
        network, channel = await enter(watching(market.settings("viewer")))
        server = await enter(FoxgloveServer(view, "agent"))
        await enter(market.robot(robot))
        tasks = await enter(Background())
        shown = show_agent(server, network.session, robot.address, channel.lighthouse)
        tasks.start(shown, "agent")
        viewer = await enter(viewing(view.url))
        (status, *_) = await viewer.until_seen("/aira/status")
        assert status["address"] == robot.address
        for heard in (ReadingKey(robot.address, "/battery"), DeviceTopicKey(robot.address, "arm", "/angle")):
            await until_heard(robot.parts.network.session, str(heard))
        robot.publish("/battery", 0.5)
        assert (await viewer.until_seen("/reading/battery"))[0].data == 0.5
        key = str(DeviceTopicKey(robot.address, "arm", "/angle"))
        robot.parts.network.session.put(key, b'{"degrees": 3}', encoding="application/json")
        assert await viewer.until_seen("/device/arm/angle") == [{"degrees": 3}]
        key = str(DeviceTopicKey(robot.address, "arm", "/own"))
        defined = SentDefinitions().attachment(b"", "", OWN, 0.0)
        robot.parts.network.session.put(key, b"\x05", encoding=OWN.zenoh_encoding, attachment=defined)
        assert [value.a for value in await viewer.until_seen("/device/arm/own")] == [5]
        await market.order(robot, BLINK)
        assert (await viewer.until_seen("/job/blinked"))[0].data == "on"
        assert [value.a for value in await viewer.until_seen("/job/own")] == [7]
        await until(lambda: "complete" in {job["event"] for job in viewer.values("/aira/job")})
        await until(lambda: viewer.values("/aira/log"))


async def test_a_job_is_seen_live_and_then_played_from_its_recording(market: Market, front: Any) -> None:
    robot, released = offering(Agent()), asyncio.Event()

    @robot.on("/blink")
    async def blink(job: Job, message: String) -> None:
        await released.wait()
        job.publish("/blinked", message.data)

    async def show(parts: Any, view: Any, address: str) -> None:
        await show_recording(parts, view, await show_job_until_end(parts, view, address))

    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        view = await enter(front())
        parts = await enter(opened(market.settings("viewer"), chain=(await market.person()).chain))
        await enter(market.robot(robot))
        contract = await market.demand(robot, [("/blink", f"{number}") for number in range(100)])
        tasks = await enter(Background())
        tasks.start(show(parts, view, contract.address), "job")
        await until(lambda: view.inner)
        live = view.inner
        async with viewing(view.url) as viewer:
            assert viewer.info["capabilities"] == []
            released.set()
            await until(lambda: any(message.data == "99" for message in viewer.values("/blinked")))
            assert (await viewer.until_seen("/aira/progress"))[0]["total"] == 100
        assert_paid(await market.outcome(contract))
        await until(lambda: view.inner not in ("", live), what="the playback")
        async with viewing(view.url) as viewer:
            assert "playbackControl" in viewer.info["capabilities"]
            await viewer.control(PLAY, request="play", speed=10)
            played = [message.data for message in await viewer.until_seen("/blink", 100)]
            assert sorted(set(played), key=int) == [f"{number}" for number in range(100)]
            assert {message.data for message in await viewer.until_seen("/blinked", 100)} == set(played)


async def test_a_job_without_a_recording_is_told(market: Market, front: Any) -> None:
    person = await market.person()
    async with front() as view, opened(market.settings("viewer"), chain=person.chain) as parts:

        class Ended:
            result, address = "", person.address

        ended: Any = Ended()
        with raises_with(InputError, code="no-recording"):
            await show_recording(parts, view, ended)
