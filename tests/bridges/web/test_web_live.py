"""The page's server while robots work: what they publish comes as samples, and is bounded."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

import msgspec

from bridges.web import _live
from bridges.web._live import Readings, Samples
from mesh import Job, String  # noqa: TC001  handlers are read at run time
from mesh.recording import Played
from schemas.payloads import PayloadType
from tests.bridges.web.test_page_server import DATA
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.waiting import until_found

if TYPE_CHECKING:
    import pytest
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


async def test_readings_are_kept_before_anybody_looks(place: Place, serve: Any) -> None:
    async with place.agent("robot") as robot, serve() as browser, serve() as witness:
        path = f"agents/{robot.address}/readings"
        assert (await browser.get(path))["readings"] == {}
        async with witness.session.ws_connect(f"{witness.server.url}/api/v1/stream") as socket:
            await socket.send_json({"subscribe": [f"readings/{robot.address}"]})
            await socket.receive()
            for battery in (80, 81, 82):
                robot.publish("/battery", battery)
            await received(socket, f"readings/{robot.address}", 3)

        async def of_battery() -> Any:
            kept = (await browser.get(path))["readings"].get("/battery", ())
            return [sample["value"] for sample in kept] if kept and kept[-1]["value"] == 82 else None

        # Of what came within a few seconds, while nobody looked here, the first and the last.
        assert await until_found(of_battery, what="the readings") == [80, 82]
        async with browser.session.ws_connect(f"{browser.server.url}/api/v1/stream") as socket:
            await socket.send_json({"subscribe": [f"readings/{robot.address}", "readings/nobody", "live/nothing"]})
            await socket.receive()

            robot.publish("/battery", 81.5)
            (told,) = await received(socket, f"readings/{robot.address}", 1)
            assert told["value"] == 81.5
            readings = (await browser.get(path))["readings"]
            assert readings["/battery"][-1]["numbers"] == [["", 81.5]]
            for number in range(20):
                robot.publish(f"/sensor/{number}", float("nan"))
            many = "/sensor/14"

            async def full() -> Any:
                return many in (await browser.get(path))["readings"]

            await until_found(full, what="more readings")
            readings = (await browser.get(path))["readings"]
            assert len(readings) == _live.LIVE_READING_LIMITS.topics
            assert readings[many][0]["numbers"] == []
            # Who was away gets no live values of that time, and is told so.
            await socket.send_json({"subscribe": [f"readings/{robot.address}"], "after": 0, "stream": "another"})
            async with asyncio.timeout(30):
                while not any(event["kind"] == "gap" for event in json.loads((await socket.receive()).data)):
                    pass


async def test_a_flood_of_one_robot_is_cut(place: Place, serve: Any) -> None:
    async with place.agent("robot") as robot, serve() as browser:
        path = f"agents/{robot.address}/readings"
        drops = browser.server.components.drops
        for number in range(3_000):
            robot.publish("/flood", number)
            if number < 50:
                robot.publish("/picture", PNG)

        async def cut() -> Any:
            return drops.totals().get("live-overflow")

        await until_found(cut, what="a drop")
        readings = (await browser.get(path))["readings"]
        assert len(readings["/flood"]) <= _live.LIVE_READING_LIMITS.readings
        assert len(readings.get("/picture", [])) < 20


def reading(topic: str, second: float, payload: bytes = b"1") -> Played:
    at = int(second * 1e9)
    return Played(topic, payload, at, at, 0, PayloadType("json"), "device")


def seconds_of(readings: Readings, robot: str) -> list[float]:
    return [one.log_time_ns / 1e9 for one in readings.of(robot)["/battery"]]


def test_readings_that_nobody_looks_at_are_sparse_and_those_somebody_looks_at_are_not() -> None:
    viewed = set[str]()
    readings = Readings(viewed.__contains__)
    for second in range(13):
        readings.add("arm", reading("/battery", second))
    assert seconds_of(readings, "arm") == [0, 5, 10, 12]
    viewed.add("arm")
    for second in (13, 14):
        readings.add("arm", reading("/battery", second))
    assert seconds_of(readings, "arm") == [0, 5, 10, 12, 13, 14]
    readings.add("arm", reading("/battery", 13 + _live.LIVE_READING_LIMITS.age))
    assert seconds_of(readings, "arm") == [13, 14, 613]


def test_the_readings_of_many_robots_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    readings = Readings({"0"}.__contains__)
    for number in range(_live.LIVE_READING_LIMITS.robots + 1):
        readings.add(str(number), reading("/battery", number))
    assert readings.of("0")  # somebody looks at it
    assert not readings.of("1")
    assert readings.of("2")
    for topic in range(_live.LIVE_READING_LIMITS.topics + 1):
        readings.add("2", reading(f"/sensor/{topic}", 1))
    assert len(readings.of("2")) == _live.LIVE_READING_LIMITS.topics
    limits = _live.LIVE_READING_LIMITS._replace(size_in_all=readings.size + 10_000)
    monkeypatch.setattr(_live, "LIVE_READING_LIMITS", limits)
    readings.add("3", reading("/picture", 1, bytes(9_000)))
    assert readings.of("3")
    readings.add("4", reading("/battery", 1, bytes(9_500)))
    assert not readings.of("4")  # it had the most
    readings.add("4", reading("/battery", 1, bytes(500)))
    assert readings.of("4")
    assert readings.size == sum(
        len(one.payload) + _live.LIVE_READING_LIMITS.overhead
        for robot in range(_live.LIVE_READING_LIMITS.robots + 1)
        for kept in readings.of(str(robot)).values()
        for one in kept
    )


def test_samples_are_the_latest_ones_in_number_and_bytes() -> None:
    samples = Samples(3, 10)
    for text in (b"1", b"2", b"3", b"4"):
        samples.add(msgspec.Raw(text))
    assert [bytes(one) for one in samples] == [b"2", b"3", b"4"]
    samples.add(msgspec.Raw(b'"12345678"'))
    assert [bytes(one) for one in samples] == [b'"12345678"']
    samples.add(msgspec.Raw(b'"a long one is kept"'))
    assert [bytes(one) for one in samples] == [b'"a long one is kept"']
