"""The owner of a robot is told what happens to it, by HTTP and by programs, and no job waits for that."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import json
import secrets
from collections import Counter
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from aiohttp import web

from mesh import Agent, ConfigurationError, Empty, JobFailed, Settings
from mesh.agent._notifications import DELIVERY_LIMITS, PARTS, RECENT, Notifier, OwnerWatch
from mesh.base.retry import RetryPolicy
from mesh.chain import Account
from mesh.network import Endpoints, Network
from schemas.keys import PRESENT, DeviceTopicKey
from tests.support.log_events import logged_facts
from tests.support.market import MODEL, Place, offering
from tests.support.ports import free_port
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.agent.handlers import Job
    from tests.support.routers import EmbeddedRouter

ROBOT = "0x000000000000000000000000000000000000bEEF"
QUICK = RetryPolicy(initial=0.01, ceiling=0.05, attempts=200)
SECRET = b"a secret of more than 16 bytes"


class Receiver:
    """A real HTTP server. While `broken` is set it answers with this status; it keeps what it has taken."""

    def __init__(self) -> None:
        self.port = free_port()
        self.broken = 0
        self.taken: list[dict[str, Any]] = []
        self.requests: list[tuple[dict[str, str], bytes]] = []
        self._runner: web.AppRunner | None = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/hook/of-the-owner"

    async def start(self) -> None:
        application = web.Application()
        application.router.add_post("/hook/of-the-owner", self._take)
        application.router.add_post("/elsewhere", self._take)
        self._runner = web.AppRunner(application)
        await self._runner.setup()
        await web.TCPSite(self._runner, "127.0.0.1", self.port).start()

    async def stop(self) -> None:
        if self._runner is not None:
            await self._runner.cleanup()

    async def _take(self, request: web.Request) -> web.Response:
        body = await request.read()
        self.requests.append((dict(request.headers), body))
        if self.broken:
            return web.Response(status=self.broken, headers={"Location": "/elsewhere"})
        self.taken.append(json.loads(body))
        return web.Response(status=204)

    def kinds(self) -> list[str]:
        """The events that it has taken, in order."""
        return [event["type"].removeprefix("aira.") for event in self.taken]


@pytest.fixture
async def receiver() -> AsyncIterator[Receiver]:
    receiver = Receiver()
    await receiver.start()
    yield receiver
    await receiver.stop()


def working(place: Place, **options: Any) -> Agent:
    """A robot that offers for all demands, does `/go`, and fails at `/fail`."""
    robot = place.agent("robot", **options)

    @robot.on("/go")
    async def go(job: Job, message: Empty) -> None:
        pass

    @robot.on("/fail")
    async def fail(job: Job, message: Empty) -> None:
        raise JobFailed("the arm is stuck")

    return offering(robot)


@asynccontextmanager
async def notifying(tmp_path: Path, *targets: str, **options: Any) -> AsyncIterator[Notifier]:
    async with Notifier(Settings(notify=targets, **options), ROBOT, retry=QUICK) as notifier:
        yield notifier


async def test_the_owner_is_told_what_becomes_of_each_job(place: Place, receiver: Receiver) -> None:
    robot = working(place, notify=(receiver.url,))
    async with place.at_work(robot) as person:
        done = await person.demand([("/go", Empty())], cost=5)
        assert (await done.outcome()).success
        failed = await person.demand([("/fail", Empty())], cost=7)
        assert not (await failed.outcome()).success
        await until(lambda: receiver.kinds()[-1:] == ["job-refunded"])
        control = await robot.control()

    assert receiver.kinds() == [
        *("job-offered", "job-begun", "job-paid"),
        *("job-offered", "job-begun", "job-failed", "job-refunded"),
    ]
    for event in receiver.taken:
        assert (event["specversion"], event["source"]) == ("1.0", f"/aira/agent/{place.address('robot')}")
        assert event["data"]["customer"] == place.address("person")
        assert event["datacontenttype"] == "application/json"
    assert [event["subject"] for event in receiver.taken[1:3]] == [done.address] * 2
    assert [event["data"]["cost"] for event in receiver.taken] == ["5"] * 3 + ["7"] * 4
    assert (receiver.taken[5]["data"]["reason"], receiver.taken[5]["data"]["code"]) == (
        "the arm is stuck",
        "job-failed",
    )
    assert len({event["id"] for event in receiver.taken}) == 7
    assert [(one.event, one.about) for one in control.events[1:3]] == [
        ("job-begun", done.address),
        ("job-paid", done.address),
    ]
    assert (control.events[5].event, control.events[5].detail) == ("job-failed", "the arm is stuck")
    assert [(one.target, one.waiting) for one in control.notify] == [("127.0.0.1", 0)]


async def test_the_latest_events_are_remembered_also_if_nobody_is_told(tmp_path: Path) -> None:
    async with notifying(tmp_path, notify_events=("job-paid", "robot-unreachable")) as notifier:
        notifier.notify("job-begun", {}, about="0x1")
        for number in range(RECENT):
            notifier.notify("job-paid", {}, about=f"0x{number}")
        notifier.notify("robot-unreachable", {"part": "device arm" * 100})
        assert notifier.targets() == ()
        assert len(notifier.recent) == RECENT
        assert (notifier.recent[0].event, notifier.recent[0].about) == ("job-paid", "0x1")
        assert (notifier.recent[-1].event, len(notifier.recent[-1].detail)) == ("robot-unreachable", 200)


async def test_offers_that_strangers_cause_push_out_no_other_event(tmp_path: Path) -> None:
    async with notifying(tmp_path) as notifier:
        notifier.notify("job-offered", {}, about="first")
        notifier.notify("low-on-gas", {"balance": "7"})
        for number in range(3 * RECENT):
            notifier.notify("job-offered", {}, about=f"{number}")
        events = [(one.event, one.about) for one in notifier.recent]
        assert events[0] == ("low-on-gas", "")
        assert events[-1] == ("job-offered", f"{3 * RECENT - 1}")
        for number in range(RECENT):
            notifier.notify("job-paid", {}, about=f"{number}")
        assert [one.event for one in notifier.recent] == ["job-paid"] * RECENT
        assert notifier.recent[-1].about == f"{RECENT - 1}"


async def test_the_owner_sees_what_a_target_has_not_got(tmp_path: Path, receiver: Receiver) -> None:
    receiver.broken = 503
    async with notifying(tmp_path, receiver.url) as notifier:
        notifier.notify("job-begun", {})
        notifier.notify("job-paid", {})
        await until(lambda: receiver.requests)
        assert [(one.target, one.waiting) for one in notifier.targets()] == [("127.0.0.1", 2)]
        receiver.broken = 0
        await until(lambda: receiver.kinds() == ["job-begun", "job-paid"])
        await until(lambda: notifier.targets()[0].waiting == 0)


async def test_a_server_that_fails_gets_each_event_when_it_has_recovered_and_no_job_waits(
    place: Place, receiver: Receiver
) -> None:
    receiver.broken = 503
    async with place.at_work(working(place, notify=(receiver.url,), notify_events=("job-begun", "job-paid"))) as person:
        outcome = await (await person.demand([("/go", Empty())])).outcome()
        assert outcome.success
        assert receiver.taken == []
        await receiver.stop()
        outcome = await (await person.demand([("/go", Empty())], cost=1)).outcome()
        assert outcome.success
        receiver.broken = 0
        await receiver.start()
        await until(lambda: len(receiver.taken) == 4)
    assert receiver.kinds() == ["job-begun", "job-paid"] * 2
    ids = [headers for headers, _ in receiver.requests]
    assert len(ids) > 4, "what failed was sent again"


@pytest.mark.parametrize("encode", [lambda secret: secret, lambda secret: b"whsec_" + base64.b64encode(secret)])
async def test_a_post_is_signed_with_the_secret_of_the_file(tmp_path: Path, receiver: Receiver, encode: Any) -> None:
    file = tmp_path / "secret"
    file.write_bytes(encode(SECRET) + b"\n")
    async with notifying(tmp_path, receiver.url, notify_secret_file=str(file)) as notifier:
        notifier.notify("job-paid", {"cost": "1"}, about="0x12")
        await until(lambda: receiver.taken)
    [(headers, body)] = receiver.requests
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    expected = base64.b64encode(hmac.new(SECRET, signed, hashlib.sha256).digest()).decode()
    assert headers["webhook-signature"] == f"v1,{expected}"
    assert headers["Content-Type"] == "application/cloudevents+json"
    assert headers["webhook-id"] == receiver.taken[0]["id"] == "job-paid-0x12"


async def test_a_redirect_is_not_followed(tmp_path: Path, receiver: Receiver) -> None:
    receiver.broken = 307
    async with notifying(tmp_path, receiver.url) as notifier:
        notifier.notify("job-paid", {})
        await until(lambda: len(receiver.requests) > 3)
        receiver.broken = 0
        await until(lambda: receiver.taken)
    assert len(receiver.taken) == 1


async def test_a_program_gets_the_event_on_its_standard_input_until_it_succeeds(tmp_path: Path) -> None:
    said, tries, program = tmp_path / "said", tmp_path / "tries", tmp_path / "say"
    program.write_text(f"#!/bin/sh\necho >> {tries}\n[ $(wc -l < {tries}) -ge 3 ] || exit 1\ncat >> {said}\n")
    program.chmod(0o700)
    async with notifying(tmp_path, str(program)) as notifier:
        notifier.notify("job-paid", {"cost": "1"}, about="0x12")
        notifier.notify("job-begun", {}, about="0x13")
        await until(lambda: said.exists() and said.read_text().count("\n") == 2)
    first, second = map(json.loads, said.read_text().splitlines())
    assert (first["type"], first["subject"], first["data"]) == ("aira.job-paid", "0x12", {"cost": "1"})
    assert second["type"] == "aira.job-begun"


async def test_a_program_that_hangs_is_killed_with_what_it_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("mesh.agent._notifications.DELIVERY_LIMITS", DELIVERY_LIMITS._replace(program=0.2))
    program, pids = tmp_path / "hang", tmp_path / "pids"
    program.write_text(f"#!/bin/sh\nsleep 1000 &\necho $! >> {pids}\nwait\n")
    program.chmod(0o700)
    once = RetryPolicy(initial=0.01, attempts=1)
    async with Notifier(Settings(notify=(str(program),)), ROBOT, retry=once) as notifier:
        notifier.notify("job-paid", {})
        await until(lambda: logged_facts(caplog, "notifications-lost"))
    child = int(pids.read_text().split()[0])
    await until(lambda: _is_dead(child), what="the end of the program's child")


def _is_dead(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as status:
            return status.read().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


async def test_only_the_named_events_are_told(tmp_path: Path, receiver: Receiver) -> None:
    async with notifying(tmp_path, receiver.url, notify_events=("job-failed",)) as notifier:
        for event in ("job-offered", "job-begun", "job-paid", "job-failed", "low-on-gas"):
            notifier.notify(event, {})
        await until(lambda: receiver.taken)
    assert receiver.kinds() == ["job-failed"]


async def test_a_target_that_is_down_costs_bounded_memory_and_the_newest_events_remain(
    tmp_path: Path, receiver: Receiver, caplog: pytest.LogCaptureFixture
) -> None:
    receiver.broken = 500
    async with notifying(tmp_path, receiver.url) as notifier:
        for number in range(DELIVERY_LIMITS.waiting + 10):
            notifier.notify("job-paid", {}, about=str(number))
        receiver.broken = 0
        await until(lambda: receiver.kinds() and receiver.taken[-1]["subject"] == str(DELIVERY_LIMITS.waiting + 9))
    assert len(receiver.taken) <= DELIVERY_LIMITS.waiting
    assert [facts["count"] for facts in logged_facts(caplog, "notifications-lost")] == ["10"]


async def test_a_target_that_is_down_does_not_hold_up_another_one(tmp_path: Path, receiver: Receiver) -> None:
    gone = f"http://127.0.0.1:{free_port()}/"
    async with notifying(tmp_path, gone, receiver.url) as notifier:
        for number in range(5):
            notifier.notify("job-paid", {}, about=str(number))
        await until(lambda: len(receiver.taken) == 5)


async def test_neither_the_log_nor_an_error_has_the_path_of_a_url(
    tmp_path: Path, receiver: Receiver, caplog: pytest.LogCaptureFixture
) -> None:
    receiver.broken = 500
    async with notifying(tmp_path, receiver.url) as notifier:
        notifier.notify("job-paid", {})
        await until(lambda: logged_facts(caplog, "notification-failed"))
        receiver.broken = 0
        await until(lambda: receiver.taken)
    assert "of-the-owner" not in caplog.text
    with pytest.raises(ConfigurationError) as caught:
        Notifier(Settings(notify=("https:///token-of-the-owner",)), ROBOT)
    assert "of-the-owner" not in f"{caught.value} {caught.value.hint}"


@pytest.mark.parametrize("target", ["http://", "https://:0/x", "say", "ftp://host/x", "/no/such/program", __file__])
def test_a_target_that_can_not_work_is_refused(target: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        Notifier(Settings(notify=(target,)), ROBOT)
    assert caught.value.code == "invalid-notify"


@pytest.mark.parametrize("content", [b"", b"short", b"whsec_not base64!", b"whsec_c2hvcnQ="])
def test_a_secret_that_protects_nothing_is_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "secret"
    file.write_bytes(content)
    for path in (file, tmp_path / "missing"):
        with pytest.raises(ConfigurationError) as caught:
            Notifier(Settings(notify=("https://localhost/",), notify_secret_file=str(path)), ROBOT)
        assert caught.value.code == "invalid-notify"
        assert content == b"" or content.decode() not in str(caught.value)


@asynccontextmanager
async def watched(place: Place, receiver: Receiver, *, grace: float) -> AsyncIterator[Agent]:
    """A robot whose owner is told after a short grace what it can't reach."""
    async with place.agent("robot") as robot:
        settings = Settings(notify=(receiver.url,), notify_events=("robot-unreachable",))
        async with Notifier(settings, robot.address, retry=QUICK) as notifier, asyncio.TaskGroup() as tasks:
            watch = OwnerWatch(robot.parts, notifier, grace=grace)
            running = [tasks.create_task(work) for _, work in watch.tasks()]
            yield robot
            for task in running:
                task.cancel()


async def test_devices_of_strangers_that_are_gone_are_reported_up_to_a_limit(place: Place, receiver: Receiver) -> None:
    async with watched(place, receiver, grace=0.3) as robot, Network(Endpoints(connect=(place.endpoint,))) as board:
        sees, declare = robot.network.session.liveliness(), board.session.liveliness().declare_token
        keys = [str(DeviceTopicKey(robot.address, f"arm{number}", PRESENT)) for number in range(PARTS + 20)]
        tokens = [declare(key) for key in keys]
        await until(lambda: all(any(reply.ok for reply in sees.get(key)) for key in keys[-1:]))
        for token in tokens:
            token.undeclare()  # type: ignore[no-untyped-call]
        await until(lambda: len(receiver.taken) == PARTS)
        await asyncio.sleep(0.5)
    assert len(receiver.taken) == PARTS


async def test_a_device_that_is_gone_for_longer_than_the_grace_is_reported_once(
    place: Place, receiver: Receiver
) -> None:
    async with watched(place, receiver, grace=0.3) as robot, Network(Endpoints(connect=(place.endpoint,))) as board:
        key = str(DeviceTopicKey(robot.address, "arm", PRESENT))
        robot_sees = robot.network.session.liveliness()
        for _ in range(2):  # a device that comes back in time is no event
            token = board.session.liveliness().declare_token(key)
            await until(lambda: any(reply.ok for reply in robot_sees.get(key)))
            token.undeclare()  # type: ignore[no-untyped-call]
        await until(lambda: receiver.taken)
        await asyncio.sleep(0.5)
    assert [event["data"]["part"] for event in receiver.taken] == ["device arm"]


async def test_a_lost_router_is_reported_and_not_its_devices(
    place: Place, receiver: Receiver, router: EmbeddedRouter
) -> None:
    async with watched(place, receiver, grace=0.5) as robot, Network(Endpoints(connect=(place.endpoint,))) as board:
        key = str(DeviceTopicKey(robot.address, "arm", PRESENT))
        token = board.session.liveliness().declare_token(key)
        await until(lambda: any(reply.ok for reply in robot.network.session.liveliness().get(key)))
        router.stop()
        await until(lambda: receiver.taken)
        router.start()
        await until(lambda: robot.network.connected)
    assert [event["data"]["part"] for event in receiver.taken] == ["router"], token


async def test_the_balance_is_looked_at_rarely_if_nobody_is_told(tmp_path: Path, receiver: Receiver) -> None:
    looks = Counter[str]()

    def counting(who: str) -> Any:
        async def retrying(_question: object, **_: object) -> tuple[int, int]:
            looks[who] += 1
            return 1, 0

        return SimpleNamespace(chain=SimpleNamespace(retrying=retrying), outages=None)

    gas: Any = {"notify_events": ("low-on-gas",)}
    async with (
        notifying(tmp_path, receiver.url, **gas) as told,
        notifying(tmp_path, **gas) as untold,
        asyncio.TaskGroup() as tasks,
    ):
        watches = [OwnerWatch(counting("told"), told, gas_interval=0.02)]
        watches.append(OwnerWatch(counting("untold"), untold, gas_interval=0.02))
        running = [tasks.create_task(work) for watch in watches for _, work in watch.tasks()]
        await until(lambda: looks["told"] >= 30)
        for task in running:
            task.cancel()
    assert 1 <= looks["untold"] <= 10, looks


async def test_an_account_with_little_gas_is_reported_once(place: Place, receiver: Receiver) -> None:
    poor = Account(secrets.token_bytes(32))
    await place.chains["provider"].tokens.send_eth(poor.address, 1000)
    settings = place.settings("poor", notify=(receiver.url,), notify_events=("low-on-gas",))
    async with place.chain_of(poor, 3) as chain:
        robot = Agent(MODEL, settings=settings, account=poor, chain=chain)
        robot.on_demand(lambda _demand: None)  # only robots are watched
        async with robot:
            await until(lambda: receiver.taken)
            watch = OwnerWatch(robot.parts, robot.runtime.notifier, gas_interval=0.05)
            [(_, work)] = watch.tasks()
            task = asyncio.create_task(work)
            await until(lambda: len(receiver.taken) == 2)
            await asyncio.sleep(0.5)  # ten more looks
            task.cancel()
    assert receiver.kinds() == ["low-on-gas"] * 2, "once by the agent, once by the watch"
    assert receiver.taken[0]["data"]["balance"] == "1000"
    assert int(receiver.taken[0]["data"]["needed"]) > 1000
