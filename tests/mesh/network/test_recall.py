"""Recalling open orders, which whoever remembers tells once each; and who is present."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh.network import Channel, Endpoints, Network, Statistics, message_key
from schemas import Demand, PresenceKey, SignedMessage, encode, message_hash
from tests.mesh.network.channels import KEY, ORDER, contents, listening, opened, take
from tests.support.orders import MARKET, PERSON, ROBOT, demand
from tests.support.waiting import at_most, until, until_answered

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh


@asynccontextmanager
async def remembering(session: zenoh.Session, *messages: SignedMessage) -> AsyncIterator[None]:
    """Somebody who answers with these messages whatever is asked on the lighthouse's keys."""

    def answer(query: zenoh.Query) -> None:
        with query:
            for message in messages:
                query.reply(message_key(MARKET, message), encode(message))

    with session.declare_queryable(f"aira/{MARKET}/**", answer, complete=True):
        yield


async def test_recall_brings_the_open_orders_once_each_together_with_live_ones(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    remembered, both, live = demand(), demand(), demand()
    async with (
        listening(here, there) as (demands, theirs),
        remembering(there, remembered, both),
        remembering(there, remembered),
    ):
        await until_answered(here, demands._selector)
        theirs.publish(both)
        assert contents(await take(demands, 1)) == [both]
        await demands.recall()
        theirs.publish(live)

        assert {one.hash for one in await take(demands, 2)} == {message_hash(remembered), message_hash(live)}
        assert demands.statistics() == Statistics(received=5, accepted=3, invalid={}, duplicate=2, dropped=0)


async def test_recall_does_not_wait_for_a_consumer_that_is_not_there_yet(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    many = [demand() for _ in range(6000)]
    async with listening(here, there) as (demands, _), remembering(there, *many):
        await until_answered(here, demands._selector)

        async with asyncio.timeout(20):
            await demands.recall()

        assert {one.hash for one in await take(demands, len(many))} == {message_hash(message) for message in many}


async def test_recall_hears_the_memory_on_its_own_session(here: zenoh.Session, there: zenoh.Session) -> None:
    many = [demand() for _ in range(1000)]
    async with listening(here, there) as (demands, _), remembering(here, *many):
        await demands.recall()

        assert {one.hash for one in await take(demands, len(many))} == {message_hash(message) for message in many}


async def test_no_answer_to_a_recall_is_lost(here: zenoh.Session, there: zenoh.Session) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            for _ in range(10_000):
                query.reply(KEY, b"-")

    async with listening(here, there) as (demands, _):
        with there.declare_queryable(f"aira/{MARKET}/**", answer, complete=True):
            await until_answered(here, demands._selector)
            await demands.recall()

        assert demands.statistics().invalid == {"not-json": 10_000}


async def test_recall_refuses_what_is_wrong_like_any_other_message(here: zenoh.Session, there: zenoh.Session) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(KEY, b"rubbish")
            query.reply(KEY, encode(ORDER))

    async with listening(here, there) as (demands, _):
        with there.declare_queryable(f"aira/{MARKET}/**", answer, complete=True):
            await until_answered(here, demands._selector)
            await demands.recall()

            assert contents(await take(demands, 1)) == [ORDER]
            assert demands.statistics().invalid == {"not-json": 1}


async def test_recall_where_nobody_remembers_returns_at_once(here: zenoh.Session) -> None:
    async with opened(here) as channel, channel.subscribe(Demand) as demands:
        with at_most(2):
            await demands.recall()


@pytest.mark.parametrize("how", ["cancelled", "left"])
async def test_a_recall_that_nobody_answers_ends_with_its_caller(
    here: zenoh.Session, there: zenoh.Session, how: str
) -> None:
    asked: list[zenoh.Query] = []

    async def recall_in_vain() -> None:
        async with opened(here) as channel, channel.subscribe(Demand) as demands:
            recalling = asyncio.create_task(demands.recall())
            await until(lambda: asked)
            if how == "cancelled":
                recalling.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await recalling
        await asyncio.gather(recalling, return_exceptions=True)

    with there.declare_queryable(f"aira/{MARKET}/**", asked.append, complete=True):
        await until_answered(here, f"aira/{MARKET}/demand/*/*")
        with at_most(2):  # an event loop of its own ends when all its threads have ended
            await asyncio.to_thread(asyncio.run, recall_in_vain())
        asked.clear()


async def test_presence_is_seen_while_the_channel_is_open(here: zenoh.Session, there: zenoh.Session) -> None:
    async with opened(here) as watching:
        async with opened(there) as theirs:
            theirs.announce("provider", ROBOT.address)
            theirs.announce("agent", PERSON.address)
            expected = [
                PresenceKey(MARKET, "agent", PERSON.address),
                PresenceKey(MARKET, "provider", ROBOT.address),
            ]
            await until_present(watching, expected)

        await until_present(watching, [])


async def test_presence_ends_with_the_session_of_one_who_did_not_take_leave(router: Any, here: zenoh.Session) -> None:
    async with opened(here) as watching:
        async with Network(Endpoints(connect=(router.endpoint,))) as network:
            theirs = await Channel(network.session, MARKET).__aenter__()
            theirs.announce("agent", PERSON.address)
            await until_present(watching, [PresenceKey(MARKET, "agent", PERSON.address)])

        await until_present(watching, [])
        await theirs.__aexit__(None, None, None)


async def test_presence_tokens_outside_the_keyspace_are_left_out(here: zenoh.Session, there: zenoh.Session) -> None:
    with (
        there.liveliness().declare_token(f"aira/{MARKET}/@agent/agent/nobody"),
        there.liveliness().declare_token(f"aira/{MARKET}/@agent/Bad Role/{PERSON.address.lower()}"),
    ):
        async with opened(here) as watching, opened(there) as theirs:
            theirs.announce("agent", PERSON.address)
            await until_present(watching, [PresenceKey(MARKET, "agent", PERSON.address)])


async def until_present(channel: Channel, expected: list[PresenceKey]) -> None:
    async with asyncio.timeout(10):
        while await channel.present() != expected:
            await asyncio.sleep(0.01)
