"""What programs may use of a signer's sockets, tried with sockets."""

from __future__ import annotations

import asyncio
import json
from contextlib import AsyncExitStack
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import pytest

from mesh.base.door import DoorLimits
from mesh.errors import AiraError
from mesh.signer.client import CALL_LIMITS
from mesh.signer.protocol import DOOR_SOCKET, LARGEST_REQUEST, OWNER_SOCKET, SignerError
from mesh.signer.service import REQUEST_LIMITS
from tests.support.signer.signers import GOOD
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.signer.signers import Driver, Person

CONNECTIONS = 4


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few connections are too many."""
    sockets = {DOOR_SOCKET: CONNECTIONS, OWNER_SOCKET: CONNECTIONS}
    monkeypatch.setattr("mesh.signer.service.CONNECTIONS", MappingProxyType(sockets))


async def said(reader: asyncio.StreamReader) -> tuple[int, dict[str, Any]]:
    """The status and the error of an answer."""
    async with asyncio.timeout(20):
        head = await reader.readuntil(b"\r\n\r\n")
        length = int(head.lower().partition(b"content-length:")[2].split(b"\r\n")[0])
        return int(head.split()[1]), json.loads(await reader.readexactly(length))["error"]


async def connected(path: Path, stack: AsyncExitStack) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """A connection to a socket, which is closed in the end."""
    reader, writer = await asyncio.open_unix_connection(str(path))
    stack.callback(writer.close)
    return reader, writer


@pytest.mark.usefixtures("few")
async def test_one_connection_too_many_is_told_so_and_the_others_go_on(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    driver.released.clear()
    async with person.at_work() as (door, owner, signer), asyncio.TaskGroup() as tasks:
        job = await door.order(model=driver.model, messages=[GOOD], cost="4 XRT", idempotency_key="k")
        looks = [
            tasks.create_task(door.job(job.job_id, revision=job.revision, wait_seconds=30)) for _ in range(CONNECTIONS)
        ]
        waiting = asyncio.Event()
        await until(lambda: len(signer._changed.get(job.job_id, waiting)._waiters) == CONNECTIONS, what="all looks")
        for _ in range(3):
            with pytest.raises(SignerError) as caught:
                await door.balance()
            assert caught.value.code == "too-many-connections"
            assert f"{CONNECTIONS} connections" in str(caught.value)
            assert "same key" in caught.value.hint
        assert not any(look.done() for look in looks)
        assert (await owner.consents())[0].job_id == job.job_id, "the owner's socket has places of its own"
        assert job.consent is not None
        await owner.deny(job.consent.id)
        assert {(await look).state for look in looks} == {"denied"}
        assert (await door.balance()).jobs == 0


@pytest.mark.usefixtures("few")
async def test_connections_that_ask_nothing_make_room_for_those_that_do(
    person: Person, driver: Driver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mesh.signer.service.DoorLimits", lambda **given: DoorLimits(head=600, **given))
    person.allow(driver.model)
    async with person.at_work() as (door, _, signer), AsyncExitStack() as stack:
        silent = [await connected(signer.door, stack) for _ in range(3 * CONNECTIONS)]
        assert (await door.balance()).jobs == 0
        async with asyncio.timeout(20):
            ended = [await reader.read() for reader, _ in silent[: 2 * CONNECTIONS]]
        assert set(ended) == {b""}


async def test_a_connection_that_does_not_say_its_request_is_ended(
    person: Person, driver: Driver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "mesh.signer.service.DoorLimits", lambda **given: DoorLimits(head=0.2, idle=0.2, grace=0.2, **given)
    )
    person.allow(driver.model)
    requests = (b"", b"POST /v1/balance HT", b"POST /v1/balance HTTP/1.1\r\nHost: s\r\nContent-Length: 90\r\n\r\n{")
    async with person.at_work() as (door, _, signer), AsyncExitStack() as stack:
        for request in requests:
            reader, writer = await connected(signer.door, stack)
            writer.write(request)
            async with asyncio.timeout(20):
                await reader.read()
        assert (await door.balance()).jobs == 0


async def test_a_request_that_is_too_large_is_refused_with_what_to_do(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    async with person.at_work() as (door, _, signer), AsyncExitStack() as stack:
        large = [("/drive", {"label": "x" * LARGEST_REQUEST})]
        with pytest.raises(SignerError) as caught:
            await door.order(model=driver.model, messages=large, cost="1 XRT", idempotency_key="k")
        assert caught.value.code == "request-too-large"
        assert "CID" in caught.value.hint
        reader, writer = await connected(signer.door, stack)
        writer.write(b"POST /v1/balance HTTP/1.1\r\nHost: s\r\nTransfer-Encoding: chunked\r\n\r\n")
        for _ in range(3):
            writer.write(b"80000\r\n" + b" " * 0x80000 + b"\r\n")
        status, error = await said(reader)
        assert (status, error["code"]) == (413, "request-too-large")


async def test_one_call_too_many_of_a_client_is_refused_before_it_is_sent(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    async with person.at_work() as (door, _, signer), AsyncExitStack() as stack:
        for _ in range(REQUEST_LIMITS.at_a_time):
            await signer._places.acquire()
            stack.callback(signer._places.release)
        async with asyncio.TaskGroup() as tasks:
            calls = [tasks.create_task(door.balance()) for _ in range(CALL_LIMITS.calls)]
            await until(lambda: door._in_progress[False] == CALL_LIMITS.calls)
            with pytest.raises(AiraError) as caught:
                async with asyncio.timeout(20):
                    await door.balance()
            assert caught.value.code == "too-many-calls"
            with pytest.raises(SignerError, match="no such job"):
                await door.job("job-0000000000000000")
            await stack.aclose()
        assert len([await call for call in calls]) == CALL_LIMITS.calls
