"""Subscriptions: ENS names in orders, and recalling open orders from the providers."""

from __future__ import annotations

import asyncio
import json
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.base.flood import Drops
from mesh.errors import RemoteError
from mesh.network import ValidationStatistics, message_key
from mesh.network.channel import LOOKUP_LIMITS, RECALL_LIMITS
from schemas import Demand, SignedMessage, encode, message_hash
from tests.support.network.channels import KEY, ORDER, contents, listening, opened, take
from tests.support.orders import MARKET, STRANGER, demand
from tests.support.waiting import at_most, until, until_answered

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh


NAME = "token.robonomics.eth"


def with_name(message: Demand, name: str = NAME) -> bytes:
    return json.dumps(json.loads(encode(message)) | {"token": name}).encode()


async def test_names_are_resolved_and_unknown_ones_counted(here: zenoh.Session, there: zenoh.Session) -> None:
    async def resolver(name: str) -> str:
        if name != NAME:
            raise RemoteError(f"nobody knows {name}")
        return STRANGER.address

    async with listening(here, there, resolver=resolver) as (demands, _):
        message, nameless = demand(token=STRANGER.address), demand()
        there.put(message_key(MARKET, nameless), with_name(nameless, "nobody.eth"))
        there.put(message_key(MARKET, message), with_name(message, NAME.upper()))

        assert contents(await take(demands, 1)) == [message]
        assert demands.statistics().invalid == {"name": 1}


async def test_without_a_resolver_messages_with_names_are_counted(here: zenoh.Session, there: zenoh.Session) -> None:
    async with listening(here, there) as (demands, theirs):
        there.put(KEY, with_name(ORDER))
        theirs.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]
        assert demands.statistics().invalid == {"name": 1}


async def test_a_slow_resolution_does_not_delay_other_messages(here: zenoh.Session, there: zenoh.Session) -> None:
    known = asyncio.Event()

    async def resolver(name: str) -> str:
        await known.wait()
        return STRANGER.address

    async with listening(here, there, resolver=resolver) as (demands, theirs):
        message = demand(token=STRANGER.address)
        there.put(message_key(MARKET, message), with_name(message))
        theirs.publish(other := demand())
        assert contents(await take(demands, 1)) == [other]

        known.set()
        assert contents(await take(demands, 1)) == [message]


async def test_a_limited_number_of_messages_waits_for_names(here: zenoh.Session, there: zenoh.Session) -> None:
    async def resolver(name: str) -> str:
        await asyncio.Event().wait()
        raise AssertionError

    async with listening(here, there, resolver=resolver) as (demands, theirs):
        for _ in range(LOOKUP_LIMITS.waiting):
            there.put(KEY, with_name(demand()))
        theirs.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]
        of_signer = LOOKUP_LIMITS.waiting // 2
        assert demands.statistics().invalid["name"] >= of_signer - 1, "half of the places are for one signer"


async def test_an_unexpected_resolver_error_ends_the_iteration(here: zenoh.Session, there: zenoh.Session) -> None:
    async def resolver(name: str) -> str:
        raise ZeroDivisionError

    async with listening(here, there, resolver=resolver) as (demands, _):
        there.put(KEY, with_name(ORDER))

        with pytest.raises(ZeroDivisionError):
            await take(demands, 1)


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

        async with asyncio.timeout(60):
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


async def test_a_recall_takes_a_limited_number_of_messages(here: zenoh.Session, there: zenoh.Session) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            for _ in range(RECALL_LIMITS.orders // 8 + 1):
                query.reply(KEY, b"-")

    drops = Drops()
    async with listening(here, there, drops=drops) as (demands, _), AsyncExitStack() as stack:
        for _ in range(8):
            stack.enter_context(there.declare_queryable(f"aira/{MARKET}/**", answer, complete=True))
        await until_answered(here, demands.selector)
        await demands.recall()

        assert demands.statistics().invalid == {"not-json": RECALL_LIMITS.orders}
        assert drops.totals() == {"recall": 8}


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
        await until_answered(here, f"aira/{MARKET}/demand/*")
        with at_most(2):  # an event loop of its own ends when all its threads have ended
            await asyncio.to_thread(asyncio.run, recall_in_vain())
        asked.clear()
