"""Recalling open orders from the providers, and the presence of agents on a channel."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from mesh.errors import ClosedError
from mesh.network import Channel, Endpoints, Network, ValidationStatistics, message_key
from schemas import Demand, PresenceKey, SignedMessage, encode, message_hash
from tests.mesh.network.channels import KEY, ORDER, contents, listening, opened, take
from tests.support.orders import MARKET, PERSON, ROBOT, STRANGER, demand
from tests.support.waiting import at_most, until, until_answered

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh


@asynccontextmanager
async def answering(session: zenoh.Session, *messages: SignedMessage) -> AsyncIterator[None]:
    """Reply with these messages to every query on the lighthouse's keys."""

    def answer(query: zenoh.Query) -> None:
        with query:
            for message in messages:
                query.reply(message_key(MARKET, message), encode(message))

    with session.declare_queryable(f"aira/{MARKET}/**", answer, complete=True):
        yield


async def test_recall_yields_each_open_order_once_together_with_live_ones(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    remembered, both, live = demand(), demand(), demand()
    async with (
        listening(here, there) as (demands, theirs),
        answering(there, remembered, both),
        answering(there, remembered),
    ):
        await until_answered(here, demands.selector)
        theirs.publish(both)
        assert contents(await take(demands, 1)) == [both]
        await demands.recall()
        theirs.publish(live)

        assert {one.hash for one in await take(demands, 2)} == {message_hash(remembered), message_hash(live)}
        assert demands.statistics() == ValidationStatistics(received=5, accepted=3, invalid={}, duplicate=2, dropped=0)


async def test_recall_does_not_wait_for_a_consumer(here: zenoh.Session, there: zenoh.Session) -> None:
    many = [demand() for _ in range(6000)]
    async with listening(here, there) as (demands, _), answering(there, *many):
        await until_answered(here, demands.selector)

        async with asyncio.timeout(20):
            await demands.recall()

        assert {one.hash for one in await take(demands, len(many))} == {message_hash(message) for message in many}


async def test_recall_reaches_an_order_book_on_its_own_session(here: zenoh.Session, there: zenoh.Session) -> None:
    many = [demand() for _ in range(1000)]
    async with listening(here, there) as (demands, _), answering(here, *many):
        await demands.recall()

        assert {one.hash for one in await take(demands, len(many))} == {message_hash(message) for message in many}


async def test_no_reply_to_a_recall_is_lost(here: zenoh.Session, there: zenoh.Session) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            for _ in range(10_000):
                query.reply(KEY, b"-")

    async with listening(here, there) as (demands, _):
        with there.declare_queryable(f"aira/{MARKET}/**", answer, complete=True):
            await until_answered(here, demands.selector)
            await demands.recall()

        assert demands.statistics().invalid == {"not-json": 10_000}


async def test_recalled_messages_are_validated(here: zenoh.Session, there: zenoh.Session) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(KEY, b"rubbish")
            query.reply(KEY, encode(ORDER))

    async with listening(here, there) as (demands, _):
        with there.declare_queryable(f"aira/{MARKET}/**", answer, complete=True):
            await until_answered(here, demands.selector)
            await demands.recall()

            assert contents(await take(demands, 1)) == [ORDER]
            assert demands.statistics().invalid == {"not-json": 1}


async def test_recall_without_a_provider_returns_at_once(here: zenoh.Session) -> None:
    async with opened(here) as channel, channel.subscribe(Demand) as demands:
        with at_most(2):
            await demands.recall()


@pytest.mark.parametrize("how", ["cancelled", "left"])
async def test_an_unanswered_recall_ends_with_its_caller(here: zenoh.Session, there: zenoh.Session, how: str) -> None:
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


async def test_presence_ends_with_the_session_of_an_unclosed_channel(router: Any, here: zenoh.Session) -> None:
    async with opened(here) as watching:
        async with Network(Endpoints(connect=(router.endpoint,))) as network:
            theirs = await Channel(network.session, MARKET).__aenter__()
            theirs.announce("agent", PERSON.address)
            await until_present(watching, [PresenceKey(MARKET, "agent", PERSON.address)])

        await until_present(watching, [])
        await theirs.__aexit__(None, None, None)


async def test_presence_tokens_outside_the_keyspace_are_ignored(here: zenoh.Session, there: zenoh.Session) -> None:
    with (
        there.liveliness().declare_token(f"aira/{MARKET}/@agent/agent/nobody"),
        there.liveliness().declare_token(f"aira/{MARKET}/@agent/Bad Role/{PERSON.address.lower()}"),
    ):
        async with opened(here) as watching, opened(there) as theirs:
            theirs.announce("agent", PERSON.address)
            await until_present(watching, [PresenceKey(MARKET, "agent", PERSON.address)])


async def test_a_presence_watch_reports_present_and_later_agents_of_its_role(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    events: list[tuple[str, str]] = []
    async with opened(here) as watching, opened(there) as first:
        first.announce("provider", ROBOT.address)
        await until_present(watching, [PresenceKey(MARKET, "provider", ROBOT.address)])
        watching.watch_presence(
            lambda key: events.append(("appeared", key.agent)),
            gone=lambda key: events.append(("gone", key.agent)),
            role="provider",
        )
        await until(lambda: events == [("appeared", ROBOT.address.lower())])

        async with opened(there) as second:
            second.announce("agent", STRANGER.address)
            second.announce("provider", PERSON.address)
            await until(lambda: events[1:] == [("appeared", PERSON.address.lower())])
        await until(lambda: events[2:] == [("gone", PERSON.address.lower())])


async def test_a_presence_watch_ends_with_its_channel(here: zenoh.Session, there: zenoh.Session) -> None:
    seen: list[PresenceKey] = []
    other: list[PresenceKey] = []
    async with opened(there) as theirs, opened(here) as still_open:
        async with opened(here) as watching:
            watching.watch_presence(seen.append)
        still_open.watch_presence(other.append)
        theirs.announce("agent", PERSON.address)
        await until(lambda: other)

    assert seen == []
    with pytest.raises(ClosedError):
        watching.watch_presence(seen.append)


async def until_present(channel: Channel, expected: list[PresenceKey]) -> None:
    async with asyncio.timeout(10):
        while await channel.present() != expected:
            await asyncio.sleep(0.01)
