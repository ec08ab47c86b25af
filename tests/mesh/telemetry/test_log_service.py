"""The service `logs` of roles, over real routers: whose events they return, and who has the right to read them."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.agent import Agent
from mesh.base.log_context import LogSource, liability_context, source_context
from mesh.network import Endpoints, Network, ServiceFailed, Services, call
from mesh.ops.identity import Member
from mesh.telemetry.logs import LogHandler, LogService, keep_log
from mesh.watching.presence import LogReader
from schemas import RpcKey
from schemas.status import LogsRead, ReadLogs
from tests.support.market import offering
from tests.support.objectives import objective
from tests.support.orders import OBJECTIVE, PERSON, ROBOT, STRANGER
from tests.support.sites import Site
from tests.support.waiting import until, until_answered, until_found

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.ops.identity.roster import Role
    from schemas import Signer
    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter

log = logging.getLogger(__name__)


@pytest.fixture
def kept(caplog: pytest.LogCaptureFixture, request: pytest.FixtureRequest) -> Iterator[LogHandler]:
    """This process keeps its log, in addition to pytest's own capture."""
    caplog.set_level(logging.INFO)
    keep_log(max_events=getattr(request, "param", 2_000))
    root = logging.getLogger()
    (handler,) = [handler for handler in root.handlers if isinstance(handler, LogHandler)]
    yield handler
    root.removeHandler(handler)


async def logs(place: Place, role: str, **asked: Any) -> LogsRead:
    """The events that a role serves."""
    async with Network(Endpoints(connect=(place.endpoint,))) as network:
        await until_answered(network.session, str(RpcKey(place.address(role), "logs")))
        reply = await call(network.session, place.address(role), "logs", ReadLogs(**asked))
    assert isinstance(reply, LogsRead)
    return reply


def talkative(robot: Agent) -> Agent:
    """Have it log from its handlers, one of them in a thread."""

    @robot.on("*")
    async def work(job: Any, message: Any) -> None:
        log.info("the lamp is on")
        await asyncio.to_thread(log.info, "the lamp is off")

    @robot.on_liability
    async def phase(phase: Any, liability: Any) -> None:
        log.info("it is %s", phase)

    return offering(robot)


async def test_agent_and_provider_serve_the_events_of_a_liability(place: Place, kept: LogHandler) -> None:
    robot = talkative(place.agent("robot"))

    async with place.at_work(robot) as person:
        contract = await person.demand(place.save(objective(("/go", "x"))), cost=1)
        assert (await contract.outcome()).success

        async def is_told() -> bool:
            reply = await logs(place, "robot", liability=contract.address)
            return reply.entries[-1].message == "it is finalized"

        await until_found(is_told, what="the end of the job", seconds=30)
        reply = await logs(place, "robot", liability=contract.address)

        async def is_noted() -> bool:
            return len((await logs(place, "provider", liability=contract.address)).entries) > 1

        await until_found(is_noted, what="the end in the provider's log", seconds=60)
        provided = await logs(place, "provider", liability=contract.address)
        asked = await logs(place, "person", liability=contract.address)
    words = [entry.message for entry in reply.entries]
    assert {"the lamp is on", "the lamp is off"} <= set(words)
    events = [entry.event for entry in reply.entries if entry.event]
    assert events == [
        "order-matched",
        "job-accepted",
        "job-ready",
        "job-started",
        "job-finished",
        "job-finalized",
    ]
    assert [one for one in words if one.startswith("it is")] == [
        f"it is {phase}" for phase in ("incoming", "ready", "running", "complete", "finalized")
    ]
    assert {(entry.role, entry.address, entry.liability) for entry in reply.entries} == {
        ("agent", place.address("robot"), contract.address)
    }
    assert [entry.event for entry in provided.entries] == ["contract-created", "contract-finalized"]
    assert {(entry.role, entry.address) for entry in provided.entries} == {("provider", place.address("provider"))}
    assert {entry.lighthouse for entry in (*reply.entries, *provided.entries)} == {
        place.market.deployment.lighthouse_name
    }
    created, ended = asked.entries
    assert (created.event, ended.event) == ("order-matched", "contract-ended")
    assert created.facts["order"] == provided.entries[0].facts["demand"]


async def test_a_rejected_order_is_logged_with_its_hash(place: Place, kept: LogHandler) -> None:
    async with place.provider() as provider, place.agent("robot") as robot:
        order = await robot.offer(objective=OBJECTIVE, cost=1)
        await until(lambda: len(provider.book), what="the order in the book")
        (message,) = provider.book.orders()
        provider.settlement.rejections.reject(message, "expired", "too late")
        (event,) = (await logs(place, "provider", level="warning")).entries
    assert (event.facts["order"], event.facts["reason"]) == (order, "expired")


async def test_a_program_that_keeps_no_log_says_so(place: Place) -> None:
    async with place.agent("robot"):
        with pytest.raises(ServiceFailed) as caught:
            await logs(place, "robot")
    assert (caught.value.service, caught.value.reason) == ("logs", "agent-error")


async def test_an_unknown_level_is_refused(place: Place, kept: LogHandler) -> None:
    async with place.agent("robot"):
        with pytest.raises(ServiceFailed) as caught:
            await logs(place, "robot", level="loud")
    assert (caught.value.service, caught.value.reason) == ("logs", "agent-error")


@pytest.mark.parametrize("kept", [20], indirect=True)
async def test_the_reader_says_how_many_events_it_missed(router: EmbeddedRouter, kept: LogHandler) -> None:
    async with (
        Network(Endpoints(connect=(router.endpoint,))) as network,
        Services(network.session, ROBOT.address) as services,
        Network(Endpoints(connect=(router.endpoint,))) as elsewhere,
    ):
        services.offer("logs", LogService("agent", ROBOT.address).logs)
        key = str(RpcKey(ROBOT.address, "logs"))
        await until_answered(elsewhere.session, key)
        reader = LogReader(elsewhere.session, key, lines=0)
        assert (await reader.poll()).events == []
        with source_context(LogSource("agent", ROBOT.address)), liability_context(STRANGER.address):
            for number in range(50):
                log.info("number %d", number)
        look = await reader.poll()
        assert [event.message for event in look.events] == [f"number {number}" for number in range(30, 50)]
        assert look.missed == 30
        assert (await reader.poll()).events == []


async def test_several_processes_on_one_key_are_followed_separately(router: EmbeddedRouter, kept: LogHandler) -> None:
    """Two processes with one account; here the other one is a queryable with a log of its own."""
    other = LogHandler()

    class Other(LogService):
        def read(self, asked: ReadLogs) -> LogsRead:
            return other.buffer.read(asked)

    async with (
        Network(Endpoints(connect=(router.endpoint,))) as network,
        Network(Endpoints(connect=(router.endpoint,))) as second,
        Services(network.session, ROBOT.address) as services,
        Services(second.session, ROBOT.address) as others,
        Network(Endpoints(connect=(router.endpoint,))) as elsewhere,
    ):
        services.offer("logs", LogService("agent", ROBOT.address).logs)
        others.offer("logs", Other("provider", ROBOT.address).logs)
        reader = LogReader(elsewhere.session, str(RpcKey(ROBOT.address, "logs")), lines=5)

        async def both_answer() -> bool:
            await reader.poll()
            return len(reader.instances) == 2

        await until_found(both_answer, what="the answers of both")
        log.info("of one")
        other.emit(logging.makeLogRecord({"name": "t", "msg": "of the other", "levelno": 20}))
        look = await reader.poll()
    assert sorted(event.message for event in look.events) == ["of one", "of the other"]


async def test_on_a_closed_site_operators_may_ask_and_agents_may_not(tmp_path: Path, kept: LogHandler) -> None:
    site = Site(tmp_path)
    people: dict[str, tuple[Signer, Role]] = {
        "robot": (ROBOT, "agent"),
        "person": (PERSON, "agent"),
        "watch": (STRANGER, "operator"),
    }
    folders = {
        name: site.enlist(Member(name=name, address=signer.address.lower(), roles=(role,)))
        for name, (signer, role) in people.items()
    }
    with site.open_router("wheel"):
        async with (
            Network(site.client(folders["robot"])) as robot,
            Services(robot.session, ROBOT.address) as services,
            Network(site.client(folders["watch"])) as operator,
            Network(site.client(folders["person"])) as person,
        ):
            services.offer("logs", LogService("agent", ROBOT.address).logs)
            log.info("a secret of the site")
            await until_answered(operator.session, str(RpcKey(ROBOT.address, "logs")))
            reply = await call(operator.session, ROBOT.address, "logs", ReadLogs(lines=1))
            assert [entry.message for entry in reply.entries] == ["a secret of the site"]
            with pytest.raises(ServiceFailed) as caught:
                await call(person.session, ROBOT.address, "logs", ReadLogs(), timeout=3)
            assert caught.value.reason == "no-agent"


async def test_an_agent_without_an_account_logs_without_an_address(place: Place, kept: LogHandler) -> None:
    async with Agent(settings=place.settings("watcher")):
        (event,) = [entry for entry in kept.buffer.read(ReadLogs()).entries if entry.message.startswith("watching")]
    assert (event.role, event.address) == ("agent", "")
