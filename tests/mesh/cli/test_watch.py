"""`aira watch`: a market, a line or a JSON object an event."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh.cli.watch import watch
from mesh.network import Channel, Endpoints, Network, Reading, message_key
from mesh.recording import open_objective
from mesh.watching import JobEvent, ReadingFetcher
from schemas import ReadingKey, RejectKey, Result, encode, message_hash, verify_message
from schemas.payloads import decode_value
from schemas.signing import Rejection
from tests.mesh.watching.test_market import EVENT, JOB
from tests.support.commands import AIRA, environment
from tests.support.jurors import Juror
from tests.support.log_events import logged_events
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.orders import CONTRACT, MARKET, PERSON, ROBOT, STRANGER, demand, result
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from mesh.agent.agent import Agent
    from mesh.settings import Settings
    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter

NOON = "2026-01-01T12:00:00.000Z"
WATCHING = f"watching {MARKET}; Ctrl-C stops it\n"
SECONDS = 60.0


class PrintedOutput:
    """The output so far."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.out = self.err = ""

    def read(self) -> str:
        new = self._capsys.readouterr()
        self.out, self.err = self.out + new.out, self.err + new.err
        return self.out

    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.read().splitlines()]


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> PrintedOutput:
    return PrintedOutput(capsys)


@asynccontextmanager
async def watching(settings: Settings, model: str | None = None, *, json: bool = False) -> AsyncIterator[None]:
    """The command at work in this process, ended as a signal does."""
    work = asyncio.create_task(watch(settings, model, with_open=True, as_json=json))
    yield
    work.cancel()
    with pytest.raises(asyncio.CancelledError):
        await work


async def test_a_job_is_printed_from_the_demand_to_the_payment(place: Place, printed: PrintedOutput) -> None:
    kinds = ["demand", "offer", "incoming", "ready", "complete", "result", "finalized"]
    async with place.at_work(offering(robot(place))) as person, watching(place.settings("watcher"), json=True):
        # Nobody else listens on such a key, and the market's were declared before it.
        await until_heard(person.parts.network.session, EVENT)
        contract = await person.demand(place.save(objective(("/go", "there"))), cost=5 * 10**9)
        outcome = await contract.outcome()
        await until(lambda: {event["event"] for event in printed.events()} >= set(kinds), what="all events")
    events = {event["event"]: event for event in printed.events()}
    assert events["demand"]["signer"] == place.address("person")
    assert events["offer"]["signer"] == place.address("robot")
    assert {events[kind]["model"] for kind in ("demand", "offer")} == {MODEL}
    assert {events[kind]["cost"] for kind in ("demand", "offer")} == {"5000000000"}
    assert (events["result"]["liability"], events["result"]["result"]) == (contract.address, outcome.result)
    assert events["finalized"]["liability"]["isSuccess"] is True
    assert events["finalized"]["agent"] == place.address("robot")


async def test_validators_are_printed_as_they_come_and_go(place: Place, printed: PrintedOutput) -> None:
    lighthouse = place.market.deployment.lighthouse_name
    first, second = (
        Juror(endpoint=place.endpoint, lighthouse=lighthouse, signer=place.market.accounts[role].signer)
        for role in ("provider", "robot")
    )
    async with first, watching(place.settings("watcher")):
        await until(lambda: f"present    validator {first.signer.address}\n" in printed.read(), what="the first")
        async with second:
            await until(lambda: f"present    validator {second.signer.address}\n" in printed.read(), what="the second")
        await until(lambda: f"gone       validator {second.signer.address}\n" in printed.read(), what="the end")
    assert f"gone       validator {first.signer.address}" not in printed.out


def robot(place: Place) -> Agent:
    robot = place.agent("robot")

    @robot.on("/go")
    async def go(job: object, message: object) -> None:
        """It is done."""

    return robot


async def test_costs_are_printed_in_xrt_when_the_provider_names_the_token(place: Place, printed: PrintedOutput) -> None:
    async with place.provider(), place.agent("person") as person:
        demanding = asyncio.create_task(person.demand(place.save(objective(("/go", "x"))), cost=2_500_000_000))
        async with watching(place.settings("watcher")):
            await until(lambda: "demand " in printed.read(), what="the open demand")
        demanding.cancel()
    assert f"{place.address('person')} pays 2.5 XRT, model {MODEL[:6]}…{MODEL[-4:]}, objective " in printed.out


async def test_an_order_that_was_open_before_is_printed_when_asked_for(place: Place, printed: PrintedOutput) -> None:
    async with place.provider(), place.agent("person") as person:
        demanding = asyncio.create_task(person.demand(place.save(objective(("/go", "x"))), cost=1))
        async with watching(place.settings("watcher"), MODEL, json=True):
            await until(lambda: [event["event"] for event in printed.events()] == ["demand"], what="it")
        demanding.cancel()


@pytest.fixture
def process(router: EmbeddedRouter) -> Iterator[subprocess.Popen[str]]:
    """`aira watch` as another process, and its output in pipes."""
    with subprocess.Popen(
        [*AIRA, "watch"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment({"AIRA_CONNECT": router.endpoint}),
    ) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == WATCHING
        yield process
        process.kill()


async def publish_to(router: EmbeddedRouter) -> None:
    """One demand, one that is forged, one rejection."""
    order = demand()
    async with Network(Endpoints(connect=(router.endpoint,))) as network, Channel(network.session, MARKET) as channel:
        forged = msgspec.structs.replace(demand(), signature="11" * 65)
        await until_heard(network.session, message_key(MARKET, forged))
        await until_heard(network.session, str(RejectKey(MARKET, PERSON.address)))
        channel.put(message_key(MARKET, forged), encode(forged))
        channel.publish(order)
        rejected = Rejection(
            order=message_hash(order).hex(), reason="expired", detail="too late", provider=ROBOT.address
        )
        channel.put(str(RejectKey(MARKET, PERSON.address)), rejected.signed_by(ROBOT).encode())


def test_lines_are_printed_at_once_and_the_counters_at_the_end(
    router: EmbeddedRouter, process: subprocess.Popen[str]
) -> None:
    asyncio.run(publish_to(router))
    assert process.stdout is not None
    assert {process.stdout.readline().split()[1] for _ in range(2)} == {"demand", "rejected"}
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=SECONDS)
    assert (process.returncode, output) == (0, "")
    assert errors == "3 messages received, 0 duplicate, 1 invalid (1 signature)\n"


def test_a_signal_prints_the_counters(router: EmbeddedRouter, process: subprocess.Popen[str]) -> None:
    assert process.stderr is not None
    process.send_signal(signal.SIGUSR1)
    assert process.stderr.readline() == "0 messages received, 0 duplicate, 0 invalid\n"
    process.send_signal(signal.SIGTERM)
    assert process.wait(SECONDS) == 0


def test_it_ends_silently_when_its_output_is_closed(router: EmbeddedRouter, process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.wait(SECONDS) == 1
    assert process.stderr.read() == ""


def test_the_loss_and_return_of_the_router_are_printed(router: EmbeddedRouter, process: subprocess.Popen[str]) -> None:
    assert process.stderr is not None
    router.stop()
    assert process.stderr.readline() == "aira: lost the router; waiting for it\n"
    router.start()
    assert process.stderr.readline() == "aira: connected to the router again\n"


async def test_the_readings_of_a_result_without_a_contract_are_printed(place: Place, printed: PrintedOutput) -> None:
    readings = objective(("/measurements", "0.5 1.0"), ("/measurements", "0.6 1.1"))
    work = asyncio.create_task(watch(place.settings("watcher"), None, with_open=False, readings=True, as_json=True))
    async with place.at_work(offering(robot(place))) as sensor:
        await until_heard(sensor.parts.network.session, EVENT)
        cid = sensor.parts.store.put_file(place.save(readings))
        signed = sensor.parts.signer.sign(Result(liability=place.address("robot"), result=cid, success=True))
        sensor.channel.publish(signed)
        await until(lambda: len(printed.events()) >= 3, what="the Result and two readings")
    work.cancel()
    with pytest.raises(asyncio.CancelledError):
        await work
    shown = [event for event in printed.events() if event["event"] == "reading"]
    assert [event["value"] for event in shown] == ["0.5 1.0", "0.6 1.1"]
    assert {(event["signer"], event["result"], event["topic"]) for event in shown} == {
        (place.address("person"), cid, "/measurements")
    }


async def test_the_readings_of_agents_are_printed_and_recorded(
    place: Place, printed: PrintedOutput, tmp_path: Path
) -> None:
    out = tmp_path / "readings.mcap"
    options: dict[str, Any] = {"with_open": False, "as_json": True, "readings": True, "out": out}
    work = asyncio.create_task(watch(place.settings("watcher"), None, **options))
    async with place.agent("robot") as robot:
        await until_heard(robot.network.session, str(ReadingKey(robot.address, "/battery")))
        stranger = str(ReadingKey(STRANGER.address, "/battery"))
        robot.network.session.put(stranger, b"1.5", encoding="application/json")  # is not present on the market
        for volts in (98.5, 98.25):
            robot.publish("/battery", volts)
        await until(lambda: len(printed.events()) >= 2, what="the readings")
    work.cancel()
    with pytest.raises(asyncio.CancelledError):
        await work
    shown = [{name: event[name] for name in ("event", "agent", "topic", "value")} for event in printed.events()]
    common = {"event": "reading", "agent": place.address("robot"), "topic": "/battery"}
    assert shown == [common | {"value": 98.5}, common | {"value": 98.25}]
    recorded = list(open_objective(out).messages())
    assert {message.topic for message in recorded} == {f"/{place.address('robot').lower()}/battery"}
    assert [decode_value(message.payload, message.type) for message in recorded] == [98.5, 98.25]
    assert f"{out}: 2 readings" in printed.err
    assert "1 invalid (1 reading)" in printed.err


async def test_a_result_that_cannot_be_fetched_is_logged_and_blocks_nothing(
    router: EmbeddedRouter, printed: PrintedOutput, caplog: pytest.LogCaptureFixture
) -> None:
    readings: list[Reading] = []
    async with (
        Network(Endpoints(connect=(router.endpoint,))) as network,
        ReadingFetcher(network.session, readings.append, timeout=0.5) as fetcher,
    ):
        fetcher.handle(verify_message(result(liability=CONTRACT)))
        await until(lambda: "result-unreadable" in logged_events(caplog), what="the warning")
        fetcher.handle(JobEvent(ROBOT.address, "incoming", JOB))
        fetcher.handle(verify_message(result(liability=CONTRACT)))
        assert fetcher.pending == 0
    assert readings == []
