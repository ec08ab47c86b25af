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

from mesh.cli.watch import EventFormatter, watch
from mesh.cli.watch import event_json as facts
from mesh.cli.watch import format_counters as told
from mesh.errors import InvalidCid, NetworkUnavailable
from mesh.network import Channel, Endpoints, Network, message_key
from mesh.settings import Settings
from mesh.watching import JobEvent, MarketCounters, ReadingFetcher, SensorReading
from schemas import Empty, RejectKey, Result, String, encode, message_hash, verify_message
from schemas.signing import Rejection
from tests.mesh.watching.test_market import EVENT, JOB
from tests.support.commands import AIRA, environment, invoke, refused
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.orders import CONTRACT, MARKET, RECORDING, ROBOT, TOKEN, demand, offer, result
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from mesh.agent import Agent
    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter

NOON = "2026-01-01T12:00:00.000Z"
WATCHING = f"watching {MARKET}; Ctrl-C ends it\n"
SECONDS = 60.0


class Said:
    """What was printed so far."""

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
def said(capsys: pytest.CaptureFixture[str]) -> Said:
    return Said(capsys)


@asynccontextmanager
async def watching(settings: Settings, model: str | None = None, *, json: bool = False) -> AsyncIterator[None]:
    """The command at work in this process, ended as a signal does."""
    work = asyncio.create_task(watch(settings, model, with_open=True, as_json=json))
    yield
    work.cancel()
    with pytest.raises(asyncio.CancelledError):
        await work


async def test_a_job_is_told_from_the_demand_to_the_payment(place: Place, said: Said) -> None:
    kinds = ["demand", "offer", "incoming", "ready", "complete", "result", "finalized"]
    async with place.at_work(offering(robot(place))) as person, watching(place.settings("watcher"), json=True):
        # Nobody else listens on such a key, and the market's were declared before it.
        await until_heard(person.parts.network.session, EVENT)
        contract = await person.demand(place.save(objective(("/go", "there"))), cost=5 * 10**9)
        outcome = await contract.outcome()
        await until(lambda: {event["event"] for event in said.events()} >= set(kinds), what="all events", seconds=30)
    events = {event["event"]: event for event in said.events()}
    assert events["demand"]["signer"] == place.address("person")
    assert events["offer"]["signer"] == place.address("robot")
    assert {events[kind]["model"] for kind in ("demand", "offer")} == {MODEL}
    assert {events[kind]["cost"] for kind in ("demand", "offer")} == {"5000000000"}
    assert (events["result"]["liability"], events["result"]["result"]) == (contract.address, outcome.result)
    assert events["finalized"]["liability"]["isSuccess"] is True
    assert events["finalized"]["agent"] == place.address("robot")


def robot(place: Place) -> Agent:
    robot = place.agent("robot")

    @robot.on("/go")
    async def go(job: object, message: object) -> None:
        """It is done."""

    return robot


async def test_xrt_is_what_the_markets_provider_says_it_is(place: Place, said: Said) -> None:
    async with place.provider(), place.agent("person") as person:
        demanding = asyncio.create_task(person.demand(place.save(objective(("/go", "x"))), cost=2_500_000_000))
        async with watching(place.settings("watcher")):
            await until(lambda: "demand " in said.read(), what="the open demand", seconds=30)
        demanding.cancel()
    assert f"{place.address('person')} pays 2.5 XRT, model {MODEL[:6]}…{MODEL[-4:]}, objective " in said.out


async def test_an_open_order_is_shown_to_who_comes_late_and_asks(place: Place, said: Said) -> None:
    async with place.provider(), place.agent("person") as person:
        demanding = asyncio.create_task(person.demand(place.save(objective(("/go", "x"))), cost=1))
        async with watching(place.settings("watcher"), MODEL, json=True):
            await until(lambda: [event["event"] for event in said.events()] == ["demand"], what="it", seconds=30)
        demanding.cancel()


async def test_a_model_that_is_none_is_an_error() -> None:
    with pytest.raises(InvalidCid):
        await watch(Settings(), "blink", with_open=False, as_json=False)


def words(message: Any) -> str:
    return EventFormatter(TOKEN).line(message)


def test_an_order_in_words() -> None:
    order = verify_message(demand(cost=1_500_000_000, deadline=12_345))
    line = words(order)
    assert line.startswith(f"demand     {order.hash.hex()[:8]}  {order.signer} pays 1.5 XRT, model Qm")
    assert line.endswith(", until block 12,345")
    assert "works for 1.5 XRT and 2 XRT to the provider, model" in words(
        verify_message(offer(cost=1_500_000_000, lighthouse_fee=2 * 10**9))
    )


def test_a_token_that_is_not_known_counts_in_its_units() -> None:
    line = EventFormatter(None).line(verify_message(demand(cost=1500)))
    assert f"pays 1,500 units of {TOKEN[:6]}…{TOKEN[-4:]}, " in line


def test_a_result_in_words_has_its_cid_whole() -> None:
    line = words(verify_message(result(liability=CONTRACT, success=False)))
    signer = f"{ROBOT.address[:6]}…{ROBOT.address[-4:]}"
    assert line == f"result     {RECORDING}  not done, for {CONTRACT}, signed by {signer}"


def test_a_contract_in_words_has_its_address_whole() -> None:
    ended = msgspec.structs.replace(JOB, result=RECORDING, is_success=True)
    assert words(JobEvent(ROBOT.address, "incoming", JOB)).startswith(f"incoming   {CONTRACT}  {ROBOT.address[:6]}…")
    assert words(JobEvent(ROBOT.address, "complete", ended)).endswith(f", done: {RECORDING}")


def test_what_a_provider_says_does_not_steer_the_terminal() -> None:
    rejection = Rejection(order="ab" * 32, reason="x", detail="\x1b[2J" + "y" * 500, provider=ROBOT.address)
    line = words(rejection)
    assert line.startswith("rejected   abababab by 0x")
    assert "\x1b" not in line
    assert len(line) < 300


def test_a_rejection_for_programs() -> None:
    rejection = Rejection(order="ab" * 32, reason="expired", detail="too late", provider=ROBOT.address)
    assert facts(rejection, time=NOON) == {
        "time": NOON,
        "event": "rejected",
        "order": "ab" * 32,
        "provider": ROBOT.address,
        "reason": "expired",
        "detail": "too late",
    }


def test_the_tally_in_words() -> None:
    tally = MarketCounters(received=1_234, refused={"signature": 2, "event": 1}, duplicate=3, lost=0)
    assert told(tally) == "1,234 messages came by, 3 of them again, 3 refused (1 event, 2 signature)"
    assert told(msgspec.structs.replace(tally, lost=9)).endswith("), 9 lost as this reader was too slow")


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
        channel.put(message_key(MARKET, forged), encode(forged))
        channel.publish(order)
        rejected = Rejection(
            order=message_hash(order).hex(), reason="expired", detail="too late", provider=ROBOT.address
        )
        channel.put(str(RejectKey(MARKET, rejected.order, ROBOT.address)), rejected.signed_by(ROBOT).encode())


def test_lines_come_at_once_and_what_was_refused_at_the_end(
    router: EmbeddedRouter, process: subprocess.Popen[str]
) -> None:
    asyncio.run(publish_to(router))
    assert process.stdout is not None
    assert {process.stdout.readline().split()[1] for _ in range(2)} == {"demand", "rejected"}
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=SECONDS)
    assert (process.returncode, output) == (0, "")
    assert errors == "3 messages came by, 0 of them again, 1 refused (1 signature)\n"


def test_what_was_refused_is_said_when_it_is_asked_for(router: EmbeddedRouter, process: subprocess.Popen[str]) -> None:
    assert process.stderr is not None
    process.send_signal(signal.SIGUSR1)
    assert process.stderr.readline() == "0 messages came by, 0 of them again, 0 refused\n"
    process.send_signal(signal.SIGTERM)
    assert process.wait(SECONDS) == 0


def test_it_ends_without_a_word_when_nobody_reads_it(router: EmbeddedRouter, process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.wait(SECONDS) == 1
    assert process.stderr.read() == ""


def test_the_loss_of_the_router_is_said(router: EmbeddedRouter, process: subprocess.Popen[str]) -> None:
    assert process.stderr is not None
    router.stop()
    assert process.stderr.readline() == "aira: the router is gone; waiting for it\n"
    router.start()
    assert process.stderr.readline() == "aira: the router is back\n"


@pytest.mark.parametrize("command", [["watch"], ["peers"], ["status"], ["rpc", CONTRACT, "eth/accounts"]])
def test_without_a_router_it_is_one_clear_line(command: list[str]) -> None:
    done = invoke(*command, AIRA_CONNECT="tcp/127.0.0.1:1", AIRA_CONNECT_TIMEOUT="0.3")
    assert "aira router" in refused(done, NetworkUnavailable, "tcp/127.0.0.1:1", "0.3 s")


async def test_what_a_result_without_a_contract_holds_is_shown(place: Place, said: Said) -> None:
    readings = objective(("/measurements", "0.5 1.0"), ("/measurements", "0.6 1.1"))
    work = asyncio.create_task(watch(place.settings("watcher"), None, with_open=False, readings=True, as_json=True))
    async with place.at_work(offering(robot(place))) as sensor:
        await until_heard(sensor.parts.network.session, EVENT)
        cid = sensor.parts.store.put_file(place.save(readings))
        signed = sensor.parts.signer.sign(Result(liability=place.address("robot"), result=cid, success=True))
        sensor.channel.publish(signed)
        await until(lambda: len(said.events()) >= 3, what="the Result and two readings", seconds=30)
    work.cancel()
    with pytest.raises(asyncio.CancelledError):
        await work
    shown = [event for event in said.events() if event["event"] == "reading"]
    assert [event["value"] for event in shown] == ["0.5 1.0", "0.6 1.1"]
    assert {(event["signer"], event["result"], event["topic"]) for event in shown} == {
        (place.address("person"), cid, "/measurements")
    }


def events(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [getattr(record, "event", "") for record in caplog.records]


async def test_a_result_that_nobody_has_is_told_and_holds_up_nothing(
    router: EmbeddedRouter, said: Said, caplog: pytest.LogCaptureFixture
) -> None:
    told: list[SensorReading] = []
    async with (
        Network(Endpoints(connect=(router.endpoint,))) as network,
        ReadingFetcher(network.session, told.append, timeout=0.5) as looking,
    ):
        looking.handle(verify_message(result(liability=CONTRACT)))
        await until(
            lambda: "result-unreadable" in [getattr(record, "event", "") for record in caplog.records],
            what="the warning",
            seconds=30,
        )
        looking.handle(JobEvent(ROBOT.address, "incoming", JOB))
        looking.handle(verify_message(result(liability=CONTRACT)))
        assert looking.pending == 0
    assert told == []


def test_a_reading_in_words_does_not_steer_the_terminal() -> None:
    line = words(SensorReading(ROBOT.address, RECORDING, "/air", String("\x1b[2J" + "y" * 500)))
    assert line.startswith("reading    /air  ")
    assert "\x1b" not in line
    assert len(line) < 300
    assert words(SensorReading(ROBOT.address, RECORDING, "/air", {"CO": 1})).startswith(
        'reading    /air  {"CO":1}, from 0x'
    )
    assert words(SensorReading(ROBOT.address, RECORDING, "/air", Empty())).startswith("reading    /air  null, from 0x")
    assert words(SensorReading(ROBOT.address, RECORDING, "/air", b"ab")).startswith('reading    /air  "YWI=", from 0x')
