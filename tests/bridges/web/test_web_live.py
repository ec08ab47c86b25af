"""The page's server while robots work: what they publish comes as samples, and is bounded."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

import msgspec

from bridges.web import _live
from bridges.web._live import Samples
from mesh import Job, String  # noqa: TC001  handlers are read at run time
from tests.bridges.web.test_page_server import DATA
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from aiohttp import ClientWebSocketResponse

    from tests.support.market import Place

PNG = b"\x89PNG\r\n\x1a\n" + bytes(100)


async def received(socket: ClientWebSocketResponse, topic: str, number: int) -> list[Any]:
    """The samples of devices in the first events of a topic."""
    found: list[Any] = []
    async with asyncio.timeout(30):
        while len(found) < number:
            events = json.loads((await socket.receive()).data)
            told = [event["data"] for event in events if event.get("topic") == topic and event["kind"] == "message"]
            found += [sample for sample in told if sample["role"] == "device"]
    return found[:number]


async def test_what_a_job_publishes_is_seen_while_it_runs_and_afterwards(place: Place, serve: Any) -> None:
    robot, may_work = offering(place.agent("robot")), asyncio.Event()

    @robot.on("/blink")
    async def blink(job: Job, message: String) -> None:
        await may_work.wait()
        job.publish("/position", {"x": 1.5, "y": [2, 3], "name": "arm"})
        job.publish("/camera", PNG)
        job.publish("/raw", bytes([1, 2, 3]))

    async with place.provider(), robot, serve("person") as browser, serve() as stranger:
        made = await browser.post("objectives", objective(("/blink", "on")), headers=DATA)
        wanted = {"model": MODEL, "objective": made["cid"], "cost": "0"}
        posted = await browser.post("local/orders", wanted, status=202)

        async def matched() -> Any:
            return (await browser.get(f"orders/{posted['order']['hash']}"))["liability"]

        address = await until_found(matched, what="a contract")
        await stranger.get(f"liabilities/{address}/live")  # from now on it is followed there, too
        async with stranger.session.ws_connect(f"{stranger.server.url}/api/v1/stream") as socket:
            await socket.send_json({"subscribe": [f"live/{address}"]})
            await socket.receive()
            may_work.set()
            position, camera, raw = await received(socket, f"live/{address}", 3)
        assert (position["topic"], position["role"], position["cut"]) == ("/position", "device", False)
        assert position["value"] == {"x": 1.5, "y": [2, 3], "name": "arm"}
        assert position["numbers"] == [["x", 1.5], ["y[0]", 2], ["y[1]", 3]]
        assert camera["image"].startswith("data:image/png;base64,")
        assert (camera["value"], camera["size"]) == (None, len(PNG))
        assert raw["value"] == "AQID"

        async def paid() -> Any:
            job = await browser.get(f"liabilities/{address}")
            return job["liability"]["state"] == "paid"

        await until_found(paid, what="a payment")
        for one in (browser, stranger):  # who comes later sees the same
            samples = (await one.get(f"liabilities/{address}/live"))["samples"]
            assert [sample["topic"] for sample in samples][-3:] == ["/position", "/camera", "/raw"]
        async with serve() as late:
            assert (await late.get(f"liabilities/{address}/live"))["samples"] == []
        await browser.get(f"liabilities/{place.address('robot')}/live", status=404)


async def test_readings_are_kept_from_the_first_question_on(place: Place, serve: Any) -> None:
    async with place.agent("robot") as robot, serve() as browser:
        path = f"agents/{robot.address}/readings"
        assert (await browser.get(path))["readings"] == {}
        async with browser.session.ws_connect(f"{browser.server.url}/api/v1/stream") as socket:
            await socket.send_json({"subscribe": [f"readings/{robot.address}", "readings/nobody", "live/nothing"]})
            await socket.receive()

            async def heard() -> Any:
                robot.publish("/battery", 81.5)
                return (await browser.get(path))["readings"]

            readings = await until_found(heard, what="a reading")
            assert readings["/battery"][0]["numbers"] == [["", 81.5]]
            (told,) = await received(socket, f"readings/{robot.address}", 1)
            assert told["value"] == 81.5
            for number in range(20):
                robot.publish(f"/sensor/{number}", float("nan"))
            many = "/sensor/14"

            async def full() -> Any:
                return many in (await browser.get(path))["readings"]

            await until_found(full, what="more readings")
            readings = (await browser.get(path))["readings"]
            assert len(readings) == _live.TOPICS
            assert readings[many][0]["numbers"] == []
            # Who was away gets no live values of that time, and is told so.
            await socket.send_json({"subscribe": [f"readings/{robot.address}"], "after": 0, "stream": "another"})
            async with asyncio.timeout(30):
                while not any(event["kind"] == "gap" for event in json.loads((await socket.receive()).data)):
                    pass


async def test_a_flood_of_one_robot_is_cut(place: Place, serve: Any) -> None:
    async with place.agent("robot") as robot, serve() as browser:
        path = f"agents/{robot.address}/readings"
        await browser.get(path)

        async def heard() -> Any:
            robot.publish("/first", 1)
            return (await browser.get(path))["readings"]

        await until_found(heard, what="a reading")
        drops = browser.server.components.drops
        for number in range(3_000):
            robot.publish("/flood", number)
            if number < 50:
                robot.publish("/picture", PNG)

        async def cut() -> Any:
            return drops.totals().get("live-overflow")

        await until_found(cut, what="a drop")
        readings = (await browser.get(path))["readings"]
        assert len(readings["/flood"]) <= _live.READINGS
        assert len(readings.get("/picture", [])) < 20


def test_samples_are_the_latest_ones_in_number_and_bytes() -> None:
    samples = Samples(3, 10)
    for text in (b"1", b"2", b"3", b"4"):
        samples.add(msgspec.Raw(text))
    assert [bytes(one) for one in samples] == [b"2", b"3", b"4"]
    samples.add(msgspec.Raw(b'"12345678"'))
    assert [bytes(one) for one in samples] == [b'"12345678"']
    samples.add(msgspec.Raw(b'"a long one is kept"'))
    assert [bytes(one) for one in samples] == [b'"a long one is kept"']
