"""Services between two agents on a real router: answers, errors that travel, and nobody there."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.errors import AiraError
from mesh.network import ServiceFailed, Services, call
from mesh.network.services import AT_ONCE
from schemas import RpcKey
from schemas.rpc import (
    AccountBalance,
    Balance,
    Done,
    FinishLiability,
    LiabilityRead,
    Nothing,
    ReadLiability,
    StartLiability,
)
from tests.mesh.network.offers import ADDRESS, REQUEST, done, offering
from tests.support.orders import LIGHTHOUSE, PERSON, liability
from tests.support.waiting import at_most, until, until_answered

if TYPE_CHECKING:
    import zenoh

    from schemas import Record


async def test_a_question_is_answered_in_the_loop_of_who_offers(here: zenoh.Session, there: zenoh.Session) -> None:
    loop = asyncio.get_running_loop()

    async def start(request: StartLiability) -> Done:
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

    async def read(request: ReadLiability) -> LiabilityRead:
        return LiabilityRead(True, job)

    async with offering(there, here, read=read):
        assert await call(here, ADDRESS, "read", ReadLiability(LIGHTHOUSE)) == LiabilityRead(True, job)


async def test_a_question_without_a_payload_is_an_empty_request(here: zenoh.Session, there: zenoh.Session) -> None:
    async def current_block(request: Nothing) -> Nothing:
        return request

    async with offering(there, here, eth__accounts=current_block):
        replies = await asyncio.to_thread(lambda: list(here.get(str(RpcKey(ADDRESS, "eth/accounts")))))
        assert [reply.ok is not None and reply.ok.payload.to_bytes() for reply in replies] == [b"{}"]


async def test_an_error_travels_with_what_to_do_about_it(here: zenoh.Session, there: zenoh.Session) -> None:
    async def start(request: StartLiability) -> Done:
        raise AiraError("there is no such job", hint="look at `aira status`")

    async with offering(there, here, start=start):
        with pytest.raises(ServiceFailed, match=r"^start: there is no such job$") as error:
            await call(here, ADDRESS, "start", REQUEST)

    assert (error.value.service, error.value.hint) == ("start", "look at `aira status`")


@pytest.mark.parametrize("failure", ["an error", "no record"])
async def test_a_failure_of_the_agents_own_stays_in_its_log(
    here: zenoh.Session, there: zenoh.Session, caplog: pytest.LogCaptureFixture, failure: str
) -> None:
    async def start(request: StartLiability) -> Any:
        if failure == "an error":
            raise ZeroDivisionError("a secret")

    async with offering(there, here, start=start):
        with pytest.raises(ServiceFailed, match=r"^start: the agent failed; its log says why$"):
            await call(here, ADDRESS, "start", REQUEST)

    assert ("ZeroDivisionError: a secret" if failure == "an error" else "AttributeError") in caplog.text


@pytest.mark.parametrize("payload", [b"", b"{}", b"[]", b"\xff", b'{"address": 1}', b'{"address": "a", "b": 1}'])
async def test_a_malformed_request_is_answered_with_what_is_wrong(
    here: zenoh.Session, there: zenoh.Session, payload: bytes
) -> None:
    asked: list[Record] = []

    async def start(request: StartLiability) -> Done:
        asked.append(request)
        return Done(True)

    async with offering(there, here, start=start):
        key = str(RpcKey(ADDRESS, "start"))
        (reply,) = await asyncio.to_thread(lambda: list(here.get(key, payload=payload)))

    assert reply.err is not None
    assert b"not a StartLiability" in reply.err.payload.to_bytes()
    assert asked == []


async def test_nobody_there_is_one_clear_error_at_once(here: zenoh.Session) -> None:
    with at_most(2), pytest.raises(ServiceFailed, match=r"^start: nobody answers$") as error:
        await call(here, ADDRESS, "start", REQUEST)

    assert "router" in error.value.hint


async def test_a_service_that_this_agent_does_not_offer_is_nobodys(here: zenoh.Session, there: zenoh.Session) -> None:
    async with offering(there, here, start=done):
        with pytest.raises(ServiceFailed, match=r"^finish: nobody answers$"):
            await call(here, ADDRESS, "finish", FinishLiability(LIGHTHOUSE, True))


async def test_a_service_that_there_is_not_names_the_nearest(here: zenoh.Session, there: zenoh.Session) -> None:
    with pytest.raises(ServiceFailed, match=r"^eth/acounts: there is no such service$") as error:
        await call(here, ADDRESS, "eth/acounts", Nothing())
    assert error.value.hint == "did you mean 'eth/accounts'?"

    async with Services(there, ADDRESS) as services:
        with pytest.raises(ServiceFailed, match=r"^strat: there is no such service$"):
            services.offer("strat", done)


async def test_an_agent_that_does_not_answer_in_time_is_given_up(here: zenoh.Session, there: zenoh.Session) -> None:
    async def start(request: StartLiability) -> Done:
        await asyncio.Event().wait()
        raise AssertionError

    async with offering(there, here, start=start):
        with at_most(3), pytest.raises(ServiceFailed, match=r"^start: no answer within 0\.2 s$"):
            await call(here, ADDRESS, "start", REQUEST, timeout=0.2)


async def test_an_answer_that_can_not_be_read_says_so(here: zenoh.Session, there: zenoh.Session) -> None:
    key = str(RpcKey(ADDRESS, "start"))

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(key, b"rubbish")

    with there.declare_queryable(key, answer):
        await until_answered(here, key)
        with pytest.raises(ServiceFailed, match=r"^start: the answer can't be read: not a Done: [^\n]+$"):
            await call(here, ADDRESS, "start", REQUEST)


async def test_questions_are_answered_side_by_side(here: zenoh.Session, there: zenoh.Session) -> None:
    together = asyncio.Barrier(3)

    async def start(request: StartLiability) -> Done:
        await together.wait()
        return Done(True)

    async with offering(there, here, start=start), asyncio.timeout(5):
        replies = await asyncio.gather(*(call(here, ADDRESS, "start", REQUEST) for _ in range(3)))

    assert replies == [Done(True)] * 3


async def test_whoever_asks_too_much_is_told_to_come_again(here: zenoh.Session, there: zenoh.Session) -> None:
    enough = asyncio.Event()

    async def start(request: StartLiability) -> Done:
        await enough.wait()
        return Done(True)

    async with offering(there, here, start=start) as services:
        key = str(RpcKey(ADDRESS, "start"))
        waiting = [here.get(key, payload=REQUEST.encode(), timeout=60) for _ in range(AT_ONCE)]
        await until(lambda: len(services._answers) == AT_ONCE, what="a full house", seconds=30)
        with pytest.raises(ServiceFailed, match="too many questions") as caught:
            await call(here, ADDRESS, "start", REQUEST)
        assert caught.value.hint == "ask again later"
        enough.set()
        answered = await asyncio.to_thread(lambda: [reply.ok is not None for one in waiting for reply in one])
        assert answered == [True] * AT_ONCE
        assert await call(here, ADDRESS, "start", REQUEST) == Done(True)
