"""Whole jobs by the SDK's own client: the door, a signer, a robot and a market, all real."""

from __future__ import annotations

import asyncio
import json
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
from a2a.types import (
    CancelTaskRequest,
    GetTaskRequest,
    ListTasksRequest,
    StreamResponse,
    SubscribeToTaskRequest,
    TaskPushNotificationConfig,
    TaskState,
)
from a2a.utils.errors import (
    A2AError,
    InvalidParamsError,
    TaskNotCancelableError,
    TaskNotFoundError,
    UnsupportedOperationError,
)
from aiohttp import web
from google.protobuf.json_format import MessageToDict

from bridges.a2a._door import A2A_LIMITS
from mesh.agent.hiring import Hiring
from mesh.base.http_server import HttpServer
from mesh.errors import ConfigurationError
from tests.support.a2a.clients import NOWHERE, Served, job_of, process, request, sent, serving
from tests.support.commands import aira, refused
from tests.support.signer.signers import GOOD
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.signer.client import SignerClient
    from tests.support.signer.signers import Driver, Person

TOPIC, VALUE = GOOD


@asynccontextmanager
async def at_work(person: Person, driver: Driver, **options: Any) -> AsyncIterator[tuple[Served, SignerClient]]:
    """The door of a person's signer, and the person's own client of that."""
    person.allow(driver.model)
    async with person.at_work() as (_, owner, signer), serving(signer.door, person.folder / "a2a", **options) as door:
        yield door, owner


def order(driver: Driver, **fields: Any) -> dict[str, Any]:
    """The data of an order of a good job."""
    return {"model": driver.model, "messages": [{"topic": TOPIC, "value": VALUE}], "cost": "1 XRT"} | fields


@pytest.mark.parametrize("binding", ["JSONRPC", "HTTP+JSON"])
async def test_a_job_is_quoted_ordered_streamed_and_paid(person: Person, driver: Driver, binding: str) -> None:
    async with at_work(person, driver) as (door, _), door.client(binding=binding) as client:
        skills = {skill.id: skill for skill in client._card.skills}  # type: ignore[attr-defined]
        assert "says «a driver»" in skills[driver.model].description
        asked = order(driver, operation="quote")
        del asked["cost"]
        (answer,) = await sent(client, request(asked, context="c"))
        (quote,) = MessageToDict(answer.message.parts[0].data)["quotes"]
        assert (quote["cost"]["text"], quote["verdict"]) == ("1 XRT", "allowed")
        assert quote["name"] == {"text": "Rover", "from": f"robot {quote['robot']}"}
        events = await sent(client, request(order(driver), context="c"))
        first, *later = events
        states = [event.status_update.status.state for event in later if event.HasField("status_update")]
        assert states[-1] == TaskState.TASK_STATE_COMPLETED
        assert TaskState.TASK_STATE_WORKING in states
        (artifact,) = [event.artifact_update.artifact for event in later if event.HasField("artifact_update")]
        task = await client.get_task(GetTaskRequest(id=first.task.id))
        assert (task.context_id, task.status.state) == ("c", TaskState.TASK_STATE_COMPLETED)
        assert task.artifacts[0].artifact_id == artifact.artifact_id == job_of(task)["result"]
        data, file = artifact.parts
        assert (file.url, file.filename) == (f"ipfs://{artifact.artifact_id}", f"{artifact.artifact_id}.mcap")
        topics = {one["topic"]["text"]: one for one in MessageToDict(data.data)["recording"]["topics"]}
        assert json.loads(topics["/odometry"]["last"]["text"]) == {"radius": 1.0}
        assert topics["/odometry"]["last"]["from"] == f"robot {job_of(task)['robot']}"
        (read,) = await sent(
            client, request({"operation": "recording", "jobId": task.id, "topic": "/odometry", "limit": 1})
        )
        (value,) = MessageToDict(read.message.parts[0].data)["values"]
        assert json.loads(value["value"]["text"]) == {"radius": 1.0}
        assert MessageToDict(read.message.parts[0].data)["durationSeconds"] >= 0
        (checked,) = await sent(client, request({"operation": "verify", "jobId": task.id}))
        assert MessageToDict(checked.message.parts[0].data)["holds"] is True
        listed = await client.list_tasks(ListTasksRequest(context_id="c"))
        assert [one.id for one in listed.tasks] == [task.id]
        assert not listed.tasks[0].artifacts
        with pytest.raises(TaskNotCancelableError):
            await client.cancel_task(CancelTaskRequest(id=task.id))
        with pytest.raises(UnsupportedOperationError):
            [_ async for _ in client.subscribe(SubscribeToTaskRequest(id=task.id))]
    assert await person.spent() == 10**9


async def test_the_same_message_sent_again_is_the_same_job(person: Person, driver: Driver) -> None:
    async with at_work(person, driver) as (door, _), door.client(streaming=False) as client:
        first, again = await asyncio.gather(
            *(sent(client, request(order(driver), message_id="once")) for _ in range(2))
        )
        assert first[0].task.id == again[0].task.id
        with pytest.raises(InvalidParamsError, match="idempotency-conflict"):
            await sent(client, request(order(driver, cost="2 XRT"), message_id="once"))
    assert len(driver.begun) == 1


async def test_a_job_that_fails_is_refunded(person: Person, driver: Driver) -> None:
    async with at_work(person, driver) as (door, _), door.client(streaming=False) as client:
        bad = order(driver, messages=[{"topic": TOPIC, "value": VALUE | {"label": "fail"}}])
        (answer,) = await sent(client, request(bad))
        assert answer.task.status.state == TaskState.TASK_STATE_FAILED
        assert job_of(answer.task)["state"] == "refunded"
    assert await person.spent() == 0


async def test_a_job_that_runs_is_stopped_when_its_task_is_canceled(person: Person, driver: Driver) -> None:
    driver.released.clear()
    async with at_work(person, driver) as (door, _), door.client() as client:
        asked = request(order(driver))
        asked.configuration.return_immediately = True
        streamed = aiter(client.send_message(asked))
        task = (await anext(streamed)).task
        await until(lambda: driver.begun)
        await client.cancel_task(CancelTaskRequest(id=task.id))
        last = [event async for event in streamed][-1]
        assert last.status_update.status.state == TaskState.TASK_STATE_CANCELED
    assert await person.spent() == 0


async def test_an_order_that_nobody_took_is_withdrawn_when_its_task_is_canceled(
    person: Person, driver: Driver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Hiring, "send", lambda *_: None)  # no provider gets it
    async with at_work(person, driver) as (door, _), door.client(streaming=False) as client:
        asked = request(order(driver))
        asked.configuration.return_immediately = True
        (answer,) = await sent(client, asked)
        assert answer.task.status.state == TaskState.TASK_STATE_SUBMITTED
        task = await client.cancel_task(CancelTaskRequest(id=answer.task.id))
        assert task.status.state == TaskState.TASK_STATE_CANCELED
    assert await person.spent() == 0


async def test_what_needs_a_persons_yes_waits_and_no_message_gives_it(person: Person, driver: Driver) -> None:
    async with at_work(person, driver) as (door, owner), door.client(streaming=False) as client:
        (answer,) = await sent(client, request(order(driver, cost="4 XRT")))
        assert answer.task.status.state == TaskState.TASK_STATE_AUTH_REQUIRED
        consent = job_of(answer.task)["consent"]
        assert consent["command"] in answer.task.status.message.parts[0].text
        follow_up = request({"operation": "order", "yes": True})
        follow_up.message.task_id = answer.task.id
        with pytest.raises(UnsupportedOperationError):
            await sent(client, follow_up)
        await owner.deny(consent["id"])
        task = await client.get_task(GetTaskRequest(id=answer.task.id))
        assert task.status.state == TaskState.TASK_STATE_REJECTED
    assert await person.spent() == 0


@pytest.mark.parametrize(
    ("changed", "code"),
    [
        ({"messages": [{"topic": "/arm", "value": 1}]}, "topic-not-allowed"),
        ({"messages": [{"topic": TOPIC, "value": VALUE | {"radius": 99.0}}]}, "value-not-allowed"),
        ({"cost": "50 XRT"}, "too-expensive"),
        ({"robot": "0x000000000000000000000000000000000000bEEF"}, "robot-not-allowed"),
    ],
)
async def test_the_policy_refuses_what_it_does_not_allow(
    person: Person, driver: Driver, changed: dict[str, Any], code: str
) -> None:
    person.allow(driver.model, robots=f'["{driver.agent.address}"]')
    async with (
        person.at_work() as (_, _, signer),
        serving(signer.door, person.folder / "a2a") as door,
        door.client() as client,
    ):
        with pytest.raises(InvalidParamsError, match=code):
            await sent(client, request(order(driver, **changed)))
    assert driver.begun == []


async def test_a_door_for_one_robot_hires_no_other(person: Person, driver: Driver) -> None:
    async with at_work(person, driver, robot=driver.agent.address) as (door, _), door.client() as client:
        with pytest.raises(InvalidParamsError, match="only"):
            await sent(client, request(order(driver, robot="0x000000000000000000000000000000000000bEEF")))
        events = await sent(client, request(order(driver)))
        assert events[-1].status_update.status.state == TaskState.TASK_STATE_COMPLETED


async def test_a_task_is_found_again_when_the_door_was_away(person: Person, driver: Driver) -> None:
    driver.released.clear()
    person.allow(driver.model)
    async with person.at_work() as (_, _, signer):
        async with serving(signer.door, person.folder / "a2a") as door, door.client(streaming=False) as client:
            asked = request(order(driver), context="mine")
            asked.configuration.return_immediately = True
            (answer,) = await sent(client, asked)
        async with serving(signer.door, person.folder / "a2a") as door, door.client() as client:
            task = await client.get_task(GetTaskRequest(id=answer.task.id))
            assert task.context_id == "mine"
            followed = aiter(client.subscribe(SubscribeToTaskRequest(id=task.id)))
            assert (await anext(followed)).task.id == task.id
            await until(lambda: driver.begun)
            driver.released.set()
            last = [event async for event in followed][-1]
            assert last.status_update.status.state == TaskState.TASK_STATE_COMPLETED
            with pytest.raises(TaskNotFoundError):
                await client.get_task(GetTaskRequest(id="job-0000000000000000"))


async def test_a_task_is_found_again_when_the_door_was_killed(person: Person, driver: Driver) -> None:
    driver.released.clear()
    person.allow(driver.model)
    folder = person.folder / "a2a"
    async with person.at_work() as (_, _, signer):
        async with process(signer.door, folder) as door, door.client(streaming=False) as client:
            asked = request(order(driver), message_id="once", context="mine")
            asked.configuration.return_immediately = True
            (answer,) = await sent(client, asked)
            await until(lambda: driver.begun)
        async with process(signer.door, folder) as door, door.client() as client:
            first, *_, last = await release_and_read(driver, client.send_message(asked))
            assert (first.task.id, first.task.context_id) == (answer.task.id, "mine")
            assert last.status_update.status.state == TaskState.TASK_STATE_COMPLETED
    assert len(driver.begun) == 1
    assert await person.spent() == 10**9


async def test_a_stream_goes_on_after_the_signer_was_away(person: Person, driver: Driver) -> None:
    driver.released.clear()
    person.allow(driver.model)
    async with AsyncExitStack() as first:
        _, _, signer = await first.enter_async_context(person.at_work())
        async with serving(signer.door, person.folder / "a2a") as door, door.client() as client:
            followed = aiter(client.send_message(request(order(driver))))
            await anext(followed)
            await until(lambda: driver.begun)
            await first.aclose()
            driver.released.set()
            async with person.at_work():
                last = [event async for event in followed][-1]
    assert last.status_update.status.state == TaskState.TASK_STATE_COMPLETED


async def test_a_second_door_with_the_same_state_does_not_start(tmp_path: Path) -> None:
    state = tmp_path / "a2a"
    async with process(NOWHERE, state):
        done = await asyncio.to_thread(aira, "a2a", "--http", "127.0.0.1:0", "--data-dir", state)
    refused(done, ConfigurationError, code="door-running")


async def release_and_read(driver: Driver, stream: AsyncIterator[StreamResponse]) -> list[StreamResponse]:
    """All events of a stream; the robot finishes once the first one came."""
    events = []
    async for event in stream:
        driver.released.set()
        events.append(event)
    return events


async def test_each_change_is_pushed_with_its_secrets_also_after_a_restart(person: Person, driver: Driver) -> None:
    driver.released.clear()
    got: list[tuple[dict[str, Any], dict[str, str]]] = []
    refused = 2

    async def hook(asked: web.Request) -> web.Response:
        nonlocal refused
        if refused:
            refused -= 1
            return web.Response(status=503)
        got.append((await asked.json(), dict(asked.headers)))
        return web.Response()

    app = web.Application()
    app.router.add_post("/hook", hook)
    person.allow(driver.model)
    state = person.folder / "a2a"
    async with HttpServer(app, "127.0.0.1", 0) as listener, person.at_work() as (_, _, signer):
        url = f"http://127.0.0.1:{listener.port}/hook"
        config = TaskPushNotificationConfig(url=url, token="mine", id="one")
        async with (
            serving(signer.door, state, push_anywhere=True) as door,
            door.client(streaming=False) as client,
        ):
            asked = request(order(driver))
            asked.configuration.return_immediately = True
            asked.configuration.task_push_notification_config.CopyFrom(config)
            (answer,) = await sent(client, asked)
            await until(lambda: driver.begun and got)
            last, headers = got[-1]
            assert last["task"]["id"] == answer.task.id
            assert headers["X-A2A-Notification-Token"] == "mine"
        got.clear()
        async with serving(signer.door, state, push_anywhere=True):
            driver.released.set()
            await until(lambda: got and got[-1][0]["task"]["status"]["state"] == "TASK_STATE_COMPLETED")
        async with serving(signer.door, state) as door, door.client() as client:
            config.task_id = answer.task.id
            with pytest.raises(InvalidParamsError):
                await client.create_task_push_notification_config(config)


async def test_the_streams_of_the_door_are_limited(person: Person, driver: Driver, monkeypatch: Any) -> None:
    monkeypatch.setattr("bridges.a2a._door.A2A_LIMITS", A2A_LIMITS._replace(followed=1))
    driver.released.clear()
    async with at_work(person, driver) as (door, _), door.client() as client:
        followed = aiter(client.send_message(request(order(driver))))
        task = (await anext(followed)).task
        with pytest.raises(A2AError, match="too many"):
            [_ async for _ in client.subscribe(SubscribeToTaskRequest(id=task.id))]
        driver.released.set()
        assert [event async for event in followed][-1].HasField("status_update")
