"""Services between two agents on a real router: replies, errors, missing agents, and many requests."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.errors import AiraError
from mesh.network import ServiceFailed, Services, call
from mesh.network.services import SERVICE_LIMITS
from schemas import InvalidRecord, RpcKey
from schemas.rpc import AccountBalance, Balance, Done, FinishLiability, LiabilityRead, LiabilityRequest, Nothing
from tests.support.network.services import ADDRESS, REQUEST, done, offering
from tests.support.orders import LIGHTHOUSE, PERSON, liability
from tests.support.waiting import at_most, until, until_answered

if TYPE_CHECKING:
    import zenoh

    from schemas import Record


async def test_a_request_is_handled_in_the_event_loop_of_the_agent(here: zenoh.Session, there: zenoh.Session) -> None:
    loop = asyncio.get_running_loop()

    async def start(request: LiabilityRequest) -> Done:
        return Done(asyncio.get_running_loop() is loop, request.address)

    async with offering(there, here, start=start):
        assert await call(here, ADDRESS, "start", REQUEST) == Done(True, LIGHTHOUSE)


async def test_amounts_beyond_what_json_numbers_hold_survive(here: zenoh.Session, there: zenoh.Session) -> None:
    async def balance(request: AccountBalance) -> Balance:
        return Balance(2**255)

    async with offering(there, here, eth__account_eth_balance=balance):
        reply = await call(here, ADDRESS, "eth/account_eth_balance", AccountBalance(PERSON.address))
        assert reply == Balance(2**255)


async def test_a_whole_record_travels(here: zenoh.Session, there: zenoh.Session) -> None:
    job = liability(lighthouse_fee=1, cost=2, validator=PERSON.address, validator_fee=3)

    async def read(request: LiabilityRequest) -> LiabilityRead:
        return LiabilityRead(True, job)

    async with offering(there, here, read=read):
        assert await call(here, ADDRESS, "read", LiabilityRequest(LIGHTHOUSE)) == LiabilityRead(True, job)


async def test_a_query_without_a_payload_is_an_empty_request(here: zenoh.Session, there: zenoh.Session) -> None:
    async def current_block(request: Nothing) -> Nothing:
        return request

    async with offering(there, here, eth__accounts=current_block):
        replies = await asyncio.to_thread(lambda: list(here.get(str(RpcKey(ADDRESS, "eth/accounts")))))
        assert [reply.ok is not None and reply.ok.payload.to_bytes() for reply in replies] == [b"{}"]


async def test_an_error_reaches_the_caller_with_its_hint(here: zenoh.Session, there: zenoh.Session) -> None:
    async def start(request: LiabilityRequest) -> Done:
        raise AiraError("there is no such job", hint="look at `aira status`")

    async with offering(there, here, start=start):
        with pytest.raises(ServiceFailed) as error:
            await call(here, ADDRESS, "start", REQUEST)

    failed = error.value
    assert (failed.service, failed.reason, failed.hint) == ("start", "agent-error", "look at `aira status`")
    assert str(failed) == "start: there is no such job"


@pytest.mark.parametrize("failure", ["an error", "no record"])
async def test_an_unexpected_error_stays_in_the_agents_log(
    here: zenoh.Session, there: zenoh.Session, caplog: pytest.LogCaptureFixture, failure: str
) -> None:
    async def start(request: LiabilityRequest) -> Any:
        if failure == "an error":
            raise ZeroDivisionError("a secret")

    async with offering(there, here, start=start):
        with pytest.raises(ServiceFailed) as error:
            await call(here, ADDRESS, "start", REQUEST)

    assert error.value.reason == "agent-error"
    assert "secret" not in str(error.value)
    assert [record.__dict__["event"] for record in caplog.records if record.levelname == "ERROR"] == ["service-failed"]

    assert ("ZeroDivisionError: a secret" if failure == "an error" else "AttributeError") in caplog.text


@pytest.mark.parametrize("payload", [b"", b"{}", b"[]", b"\xff", b'{"address": 1}', b'{"address": "a", "b": 1}'])
async def test_a_malformed_request_gets_an_error_reply(
    here: zenoh.Session, there: zenoh.Session, payload: bytes
) -> None:
    asked: list[Record] = []

    async def start(request: LiabilityRequest) -> Done:
        asked.append(request)
        return Done(True)

    async with offering(there, here, start=start):
        key = str(RpcKey(ADDRESS, "start"))
        (reply,) = await asyncio.to_thread(lambda: list(here.get(key, payload=payload)))

    assert reply.err is not None
    assert b"not a LiabilityRequest" in reply.err.payload.to_bytes()
    assert asked == []


async def test_a_missing_agent_is_reported_at_once(here: zenoh.Session) -> None:
    with at_most(2), pytest.raises(ServiceFailed) as error:
        await call(here, ADDRESS, "start", REQUEST)

    assert error.value.reason == "no-agent"
    assert "router" in error.value.hint


async def test_a_service_that_the_agent_does_not_offer_has_no_agent(here: zenoh.Session, there: zenoh.Session) -> None:
    async with offering(there, here, start=done):
        with pytest.raises(ServiceFailed) as error:
            await call(here, ADDRESS, "finish", FinishLiability(LIGHTHOUSE, True))

    assert (error.value.service, error.value.reason) == ("finish", "no-agent")


async def test_an_unknown_service_suggests_the_nearest(here: zenoh.Session, there: zenoh.Session) -> None:
    with pytest.raises(ServiceFailed) as error:
        await call(here, ADDRESS, "eth/acounts", Nothing())
    assert (error.value.service, error.value.reason) == ("eth/acounts", "unknown-service")
    assert error.value.hint == "did you mean 'eth/accounts'?"

    async with Services(there, ADDRESS) as services:
        with pytest.raises(ServiceFailed) as error:
            services.offer("strat", done)
    assert (error.value.service, error.value.reason) == ("strat", "unknown-service")


async def test_an_agent_that_does_not_reply_in_time(here: zenoh.Session, there: zenoh.Session) -> None:
    async def start(request: LiabilityRequest) -> Done:
        await asyncio.Event().wait()
        raise AssertionError

    async with offering(there, here, start=start):
        with at_most(3), pytest.raises(ServiceFailed) as error:
            await call(here, ADDRESS, "start", REQUEST, timeout=0.2)

    assert error.value.reason == "timeout"
    assert "0.2 s" in str(error.value)


async def test_an_unreadable_reply(here: zenoh.Session, there: zenoh.Session) -> None:
    key = str(RpcKey(ADDRESS, "start"))

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(key, b"rubbish")

    with there.declare_queryable(key, answer):
        await until_answered(here, key)
        with pytest.raises(ServiceFailed) as error:
            await call(here, ADDRESS, "start", REQUEST)

    assert error.value.reason == "unreadable-reply"
    assert isinstance(error.value.__cause__, InvalidRecord)
    assert "\n" not in str(error.value)


async def test_requests_are_handled_concurrently(here: zenoh.Session, there: zenoh.Session) -> None:
    together = asyncio.Barrier(3)

    async def start(request: LiabilityRequest) -> Done:
        await together.wait()
        return Done(True)

    async with offering(there, here, start=start), asyncio.timeout(60):
        replies = await asyncio.gather(*(call(here, ADDRESS, "start", REQUEST) for _ in range(3)))

    assert replies == [Done(True)] * 3


async def test_requests_beyond_the_limit_get_an_error_reply(here: zenoh.Session, there: zenoh.Session) -> None:
    enough = asyncio.Event()

    async def start(request: LiabilityRequest) -> Done:
        await enough.wait()
        return Done(True)

    async with offering(there, here, start=start) as services:
        key = str(RpcKey(ADDRESS, "start"))
        waiting = [here.get(key, payload=REQUEST.encode(), timeout=60) for _ in range(SERVICE_LIMITS.at_once)]
        await until(lambda: services._running[""] == SERVICE_LIMITS.at_once, what="the limit", seconds=30)
        with pytest.raises(ServiceFailed) as caught:
            await call(here, ADDRESS, "start", REQUEST)
        assert (caught.value.reason, caught.value.hint) == ("busy", "try again later")
        enough.set()
        answered = await asyncio.to_thread(lambda: [reply.ok is not None for one in waiting for reply in one])
        assert answered == [True] * SERVICE_LIMITS.at_once
        assert await call(here, ADDRESS, "start", REQUEST) == Done(True)
