"""Watching a market: the events of its stream, the messages it refuses, and the filter by model."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh.network import Channel, Endpoints, Network, message_key
from mesh.watching import JobEvent, MarketWatch
from schemas import (
    DeclineKey,
    EventKey,
    ProgressKey,
    RejectKey,
    ReportKey,
    Signer,
    Verified,
    encode,
    message_hash,
)
from schemas.signing import Decline, Rejection
from tests.support.jurors import Juror
from tests.support.orders import (
    CONTRACT,
    LIGHTHOUSE,
    MARKET,
    MODEL,
    OTHER_MODEL,
    PERSON,
    RECORDING,
    ROBOT,
    STRANGER,
    demand,
    liability,
    offer,
    result,
)
from tests.support.waiting import until, until_found, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.support.routers import EmbeddedRouter

JOB = liability()
EVENT = str(EventKey(ROBOT.address, CONTRACT, "incoming"))


class Market:
    """A writer on a channel, and a watcher of it."""

    def __init__(self, watch: MarketWatch, channel: Channel, writer: Network) -> None:
        self.watch = watch
        self.channel = channel
        self.session = writer.session

    async def heard(self) -> None:
        """Wait until messages on every kind of key are received."""
        rejection = RejectKey(MARKET, PERSON.address)
        decline = DeclineKey(MARKET, PERSON.address)
        for key in (
            str(rejection),
            str(decline),
            str(ReportKey(MARKET, PERSON.address)),
            EVENT,
            *(str(self.key(message)) for message in (demand(), offer(), result())),
        ):
            await until_heard(self.session, key)

    def key(self, message: Any) -> str:
        return message_key(MARKET, message)

    async def next(self) -> Any:
        async with asyncio.timeout(30):
            return await anext(self.watch)

    def reject(self, order: str, *, signer: Any = ROBOT, **changes: str) -> None:
        word = Rejection(order=order, reason="expired", detail="too late", provider=ROBOT.address).signed_by(signer)
        key = str(RejectKey(MARKET, PERSON.address))
        self.channel.put(key, msgspec.structs.replace(word, **changes).encode())

    def decline(self, order: str, *, agent: Signer = ROBOT, **changes: str) -> None:
        word = Decline(order=order, code="busy", detail="later", agent=agent.address).signed_by(agent)
        key = str(DeclineKey(MARKET, PERSON.address))
        self.channel.put(key, msgspec.structs.replace(word, **changes).encode())

    async def refused(self, reason: str, count: int = 1) -> None:
        await until(lambda: self.watch.counters().refused.get(reason) == count, what=f"{count} refused for {reason}")


@asynccontextmanager
async def watched(router: EmbeddedRouter, model: str = "*") -> AsyncIterator[Market]:
    endpoints = Endpoints(connect=(router.endpoint,))
    async with (
        Network(endpoints) as writer,
        Channel(writer.session, MARKET) as channel,
        Network(endpoints) as reader,
        Channel(reader.session, MARKET) as watched_channel,
    ):
        channel.announce("agent", ROBOT.address)
        async with MarketWatch(reader.session, watched_channel, model=model) as watch:
            market = Market(watch, channel, writer)
            await market.heard()
            yield market


@pytest.fixture
async def market(router: EmbeddedRouter) -> AsyncIterator[Market]:
    async with watched(router) as market:
        yield market


async def test_orders_and_results_come_as_they_are_published(market: Market) -> None:
    for message in (demand(), offer(), result(), result(liability=PERSON.address)):
        market.channel.publish(message)
        seen = await market.next()
        assert isinstance(seen, Verified)
        assert (seen.message, seen.hash) == (message, message_hash(message))
    assert market.watch.counters().received == 4


async def test_a_message_with_a_forged_signature_is_counted_and_not_shown(market: Market) -> None:
    forged = msgspec.structs.replace(demand(), signature="11" * 65)
    market.channel.put(market.key(forged), encode(forged))
    await market.refused("signature")
    market.channel.publish(real := demand())
    assert (await market.next()).message == real


async def test_a_rejection_is_shown_once_and_only_when_its_provider_has_signed_it(market: Market) -> None:
    order = message_hash(demand()).hex()
    market.reject(order, detail="somebody else's words")
    await market.refused("rejection")
    market.reject(order)
    market.reject(order)
    market.reject("ab" * 32)
    assert [(await market.next()).order for _ in range(2)] == [order, "ab" * 32]


async def test_a_decline_is_shown_once_and_only_of_a_present_agent_that_has_signed_it(market: Market) -> None:
    order = message_hash(demand()).hex()
    market.decline(order, detail="somebody else's words")
    await market.refused("decline")
    market.decline(order, agent=STRANGER)
    await market.refused("decline", 2)
    market.decline(order)
    market.decline(order)
    market.decline("ab" * 32)
    assert [(await market.next()).order for _ in range(2)] == [order, "ab" * 32]


async def test_a_report_is_shown_once_and_only_of_a_present_juror_that_has_signed_it(market: Market) -> None:
    def put(juror: Signer, party: str, contract: str = CONTRACT, **changes: Any) -> Any:
        like = Juror(endpoint="", lighthouse=MARKET, signer=juror, validator=STRANGER.address)
        report = like.report(msgspec.structs.replace(JOB, address=contract), RECORDING, success=False)
        report = msgspec.structs.replace(report, **changes)
        market.channel.put(str(ReportKey(MARKET, party)), report.encode())
        return report

    put(ROBOT, PERSON.address, judged_at=1)
    await market.refused("report")
    put(STRANGER, PERSON.address)
    await market.refused("report", 2)
    shown = [put(ROBOT, party) for party in (PERSON.address, ROBOT.address)]
    another = put(ROBOT, PERSON.address, STRANGER.address)
    assert await market.next() in shown
    assert await market.next() == another


async def test_the_progress_of_a_playback_is_neither_shown_nor_refused(market: Market) -> None:
    market.channel.put(str(ProgressKey(ROBOT.address, CONTRACT)), b'{"position":1,"total":2}')
    market.channel.put(EVENT, JOB.encode())
    assert await market.next() == JobEvent(ROBOT.address, "incoming", JOB)
    assert market.watch.counters().refused == {}


async def test_an_agents_events_are_shown_with_the_record_of_the_contract(market: Market) -> None:
    market.channel.put(EVENT, JOB.encode())
    assert await market.next() == JobEvent(ROBOT.address, "incoming", JOB)
    ended = msgspec.structs.replace(JOB, result=RECORDING, is_success=True, is_finalized=True)
    market.channel.put(str(EventKey(ROBOT.address, CONTRACT, "finalized")), ended.encode())
    assert await market.next() == JobEvent(ROBOT.address, "finalized", ended)


@pytest.mark.parametrize(
    "changes",
    [
        {"promisor": STRANGER.address},
        {"address": LIGHTHOUSE},
        {"model": "\x1b[2J"},
        {"promisee": "nobody"},
        {"result": "no file"},
    ],
    ids=repr,
)
async def test_an_impossible_event_is_refused(market: Market, changes: dict[str, str]) -> None:
    market.channel.put(EVENT, msgspec.structs.replace(JOB, **changes).encode())
    await market.refused("event")


async def test_an_event_of_an_agent_of_another_lighthouse_is_not_shown(market: Market) -> None:
    elsewhere = msgspec.structs.replace(JOB, promisor=STRANGER.address)
    market.channel.put(str(EventKey(STRANGER.address, CONTRACT, "ready")), elsewhere.encode())
    await market.refused("event")
    market.channel.put(EVENT, JOB.encode())
    assert (await market.next()).agent == ROBOT.address


async def test_an_agent_that_starts_later_is_shown(market: Market) -> None:
    market.channel.announce("agent", STRANGER.address)
    await until_found(lambda: market.channel.present(agent=STRANGER.address), what="the new agent")
    theirs = msgspec.structs.replace(JOB, promisor=STRANGER.address)
    market.channel.put(str(EventKey(STRANGER.address, CONTRACT, "ready")), theirs.encode())
    assert (await market.next()).agent == STRANGER.address


async def test_with_a_model_only_its_events_are_shown(router: EmbeddedRouter) -> None:
    async with watched(router, MODEL) as market:
        other, wanted = demand(model=OTHER_MODEL), demand()
        market.channel.publish(other)
        market.reject(message_hash(other).hex())
        market.channel.publish(wanted)
        assert (await market.next()).message == wanted
        market.reject(message_hash(wanted).hex())
        assert (await market.next()).order == message_hash(wanted).hex()
        market.channel.put(EVENT, msgspec.structs.replace(JOB, model=OTHER_MODEL).encode())
        market.channel.put(EVENT, JOB.encode())
        assert (await market.next()).liability == JOB


async def test_with_a_model_a_result_is_shown_once_its_contract_is_known(router: EmbeddedRouter) -> None:
    async with watched(router, MODEL) as market:
        early = result(liability=CONTRACT)
        market.channel.publish(early)
        await until(lambda: market.watch.counters().received == 1, what="the Result")
        market.channel.put(EVENT, JOB.encode())
        assert isinstance(await market.next(), JobEvent)
        market.channel.publish(early)  # as the agent does until its effect is seen
        assert (await market.next()).message == early
