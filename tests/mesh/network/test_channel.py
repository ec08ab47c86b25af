"""The channel between two agents on a real router: what arrives, what is refused, what is remembered."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
import zenoh

from mesh.errors import ClosedError, InputError, InvalidKey, RemoteError
from mesh.network import Channel, Endpoints, Network, Statistics, free_endpoint, message_key, pump, subscription
from schemas import Demand, Offer, PresenceKey, Result, SignedMessage, Verified, encode, message_hash
from tests.support.orders import (
    LIGHTHOUSE,
    MARKET,
    MODEL,
    OTHER_MODEL,
    PERSON,
    ROBOT,
    STRANGER,
    demand,
    offer,
    result,
    terms,
)
from tests.support.waiting import at_most, until, until_answered, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.network import Subscription

NAME = "token.robonomics.eth"


@asynccontextmanager
async def opened(session: zenoh.Session, **options: Any) -> AsyncIterator[Channel]:
    async with Channel(session, MARKET, **({"address": LIGHTHOUSE} | options)) as channel:
        yield channel


@asynccontextmanager
async def listening(
    here: zenoh.Session, there: zenoh.Session, kind: type[Any] = Demand, **options: Any
) -> AsyncIterator[tuple[Subscription[Any], Channel]]:
    """A subscription `here` and the channel `there` of one who is heard by it."""
    selection = {name: options.pop(name) for name in ("model", "liability") if name in options}
    async with opened(here, **options) as ours, opened(there) as theirs, ours.subscribe(kind, **selection) as messages:
        await until_heard(there, messages._selector)
        yield messages, theirs


async def take(messages: Subscription[Any], count: int) -> list[Verified[Any]]:
    async with asyncio.timeout(10):
        return [await anext(messages) for _ in range(count)]


def contents(verified: list[Verified[Any]]) -> list[SignedMessage]:
    return [one.message for one in verified]


@pytest.mark.parametrize("kind_of_router", ["router", "zenohd"])
async def test_each_kind_of_message_arrives_verified(kind_of_router: str, request: pytest.FixtureRequest) -> None:
    endpoints = Endpoints(connect=(request.getfixturevalue(kind_of_router).endpoint,))
    async with Network(endpoints) as mine, Network(endpoints) as yours:
        here, there = mine.session, yours.session
        async with (
            listening(here, there, Demand) as (demands, theirs),
            listening(here, there, Offer) as (offers, _),
            listening(here, there, Result) as (results, _),
        ):
            messages: list[SignedMessage] = [demand(), offer(), result()]
            keys = [theirs.publish(message) for message in messages]

            for message, key, arriving, signer in zip(
                messages, keys, (demands, offers, results), (PERSON, ROBOT, ROBOT), strict=True
            ):
                assert await take(arriving, 1) == [Verified(message, message_hash(message), signer.address)]
                assert key == message_key(MARKET, message)


async def test_a_burst_arrives_whole() -> None:
    endpoint = free_endpoint()
    burst = [demand() for _ in range(1000)]
    async with (
        Network(Endpoints(mode="router", listen=(endpoint,))),
        Network(Endpoints(connect=(endpoint,))) as mine,
        Network(Endpoints(connect=(endpoint,))) as yours,
        listening(mine.session, yours.session) as (demands, theirs),
    ):
        for message in burst:
            theirs.publish(message)

        assert contents(await take(demands, len(burst))) == burst


async def test_an_agent_hears_itself_too(here: zenoh.Session) -> None:
    async with opened(here) as channel, channel.subscribe(Demand) as demands:
        channel.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]


async def test_the_lighthouse_may_be_written_in_any_case(here: zenoh.Session, there: zenoh.Session) -> None:
    async with (
        Channel(here, MARKET.upper()) as ours,
        listening(here, there) as (demands, _),
    ):
        ours.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]


async def test_another_lighthouses_messages_are_not_heard(here: zenoh.Session, there: zenoh.Session) -> None:
    async with (
        listening(here, there) as (demands, theirs),
        Channel(there, "other.lighthouse.3.robonomics.eth") as other,
    ):
        other.publish(demand())
        theirs.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]
        assert demands.statistics().received == 1


@pytest.mark.parametrize(("kind", "make"), [(Demand, demand), (Offer, offer)])
async def test_orders_of_other_models_are_left_out_at_the_source(
    here: zenoh.Session, there: zenoh.Session, kind: type[Any], make: Any
) -> None:
    async with listening(here, there, kind, model=MODEL) as (orders, theirs):
        for _ in range(50):
            theirs.publish(make(model=OTHER_MODEL))
        theirs.publish(message := make(model=MODEL))

        assert contents(await take(orders, 1)) == [message]
        assert orders.statistics() == Statistics(received=1, invalid={}, duplicate=0, dropped=0)


async def test_results_of_other_liabilities_are_left_out_at_the_source(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    async with listening(here, there, Result, liability=ROBOT.address) as (results, theirs):
        theirs.publish(result(liability=PERSON.address))
        theirs.publish(message := result(liability=ROBOT.address))

        assert contents(await take(results, 1)) == [message]
        assert results.statistics().received == 1


async def test_a_selection_that_the_keys_do_not_have_is_refused(here: zenoh.Session) -> None:
    async with opened(here) as channel:
        with pytest.raises(InvalidKey):
            channel.subscribe(Result, model=MODEL)
        with pytest.raises(InputError):
            channel.subscribe(Demand, liability=LIGHTHOUSE)
        with pytest.raises(InputError):
            channel.subscribe(Result, liability="**")
        with pytest.raises(InputError):
            channel.subscribe(Demand, model="**")


def misplaced(message: SignedMessage) -> str:
    return message_key(MARKET, message).replace(message_hash(message).hex(), "00" * 32)


def altered(message: SignedMessage) -> bytes:
    return json.dumps(json.loads(encode(message)) | {"cost": 1}).encode()


ORDER = demand()
KEY = message_key(MARKET, ORDER)
FORGED = Demand(**terms(), validator_fee=0, signature="ff" * 65)
ELSEWHERE = demand(lighthouse=STRANGER.address)
LATE = demand(deadline=7)
REFUSED = {
    "other model's key": ("key", KEY.replace(MODEL, OTHER_MODEL), encode(ORDER)),
    "wrong hash in the key": ("key", misplaced(ORDER), encode(ORDER)),
    "altered content": ("key", KEY, altered(ORDER)),
    "wildcard for the model": ("key", KEY.replace(MODEL, "*"), encode(ORDER)),
    "wildcard for everything": ("key", "aira/**", encode(ORDER)),
    "other lighthouse in the order": ("lighthouse", message_key(MARKET, ELSEWHERE), encode(ELSEWHERE)),
    "deadline that has passed": ("deadline", message_key(MARKET, LATE), encode(LATE)),
    "no JSON": ("not-json", KEY, b"\x00\xff"),
    "bad signature": ("signature", message_key(MARKET, FORGED), encode(FORGED)),
    "message of another kind": ("kind", KEY, encode(offer())),
}


async def test_each_refusal_is_counted_under_its_reason_and_hides_nothing_that_is_right(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    async with listening(here, there, head=lambda: 7) as (demands, theirs):
        expected: dict[str, int] = {}
        for reason, key, payload in REFUSED.values():
            there.put(key, payload)
            expected[reason] = expected.get(reason, 0) + 1
        theirs.publish(ORDER)

        assert contents(await take(demands, 1)) == [ORDER]
        assert demands.statistics() == Statistics(received=len(REFUSED) + 1, invalid=expected, duplicate=0, dropped=0)


async def test_a_message_that_is_sent_again_arrives_once(here: zenoh.Session, there: zenoh.Session) -> None:
    async with listening(here, there) as (demands, theirs):
        first, last = demand(), demand()
        for message in (first, first, first, last):
            theirs.publish(message)

        assert contents(await take(demands, 2)) == [first, last]
        assert demands.statistics().duplicate == 2


async def test_equal_terms_signed_by_two_people_arrive_both(here: zenoh.Session, there: zenoh.Session) -> None:
    same = terms()
    async with listening(here, there) as (demands, theirs):
        for signer in (PERSON, STRANGER):
            theirs.publish(signer.sign(Demand(**same, validator_fee=0)))

        assert [one.signer for one in await take(demands, 2)] == [PERSON.address, STRANGER.address]


async def test_a_message_that_was_forgotten_arrives_again(here: zenoh.Session, there: zenoh.Session) -> None:
    async with listening(here, there) as (demands, theirs):
        theirs.publish(message := demand())
        (arrived,) = await take(demands, 1)

        demands.forget(arrived)
        theirs.publish(message)

        assert await take(demands, 1) == [arrived]


async def test_a_slow_consumer_misses_the_oldest_and_each_one_is_counted(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    sent = [demand() for _ in range(pump.CAPACITY + 2000)]
    async with listening(here, there) as (demands, _):
        for message in sent:
            there.put(message_key(MARKET, message), encode(message), congestion_control=zenoh.CongestionControl.BLOCK)
        await until(lambda: demands.statistics().received == len(sent))

        taken = [one.hash for one in await take(demands, len(sent) - demands.statistics().dropped)]

        hashes = [message_hash(message) for message in sent]
        assert demands.statistics().dropped > 0
        assert taken[-pump.CAPACITY :] == hashes[-pump.CAPACITY :]
        assert taken[: -pump.CAPACITY] == hashes[: len(taken) - pump.CAPACITY]


def with_name(message: Demand, name: str = NAME) -> bytes:
    return json.dumps(json.loads(encode(message)) | {"token": name}).encode()


async def test_names_are_looked_up_and_unknown_ones_counted(here: zenoh.Session, there: zenoh.Session) -> None:
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


async def test_a_look_up_that_takes_long_holds_up_nobody_else(here: zenoh.Session, there: zenoh.Session) -> None:
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


async def test_only_so_many_messages_wait_for_their_names(
    here: zenoh.Session, there: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subscription, "LOOKING_UP", 2)

    async def resolver(name: str) -> str:
        await asyncio.Event().wait()
        raise AssertionError

    async with listening(here, there, resolver=resolver) as (demands, theirs):
        for _ in range(10):
            there.put(KEY, with_name(ORDER))
        theirs.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]
        assert demands.statistics().invalid["name"] >= 7


async def test_what_breaks_the_resolver_comes_out_of_the_iterator(here: zenoh.Session, there: zenoh.Session) -> None:
    async def resolver(name: str) -> str:
        raise ZeroDivisionError

    async with listening(here, there, resolver=resolver) as (demands, _):
        there.put(KEY, with_name(ORDER))

        with pytest.raises(ZeroDivisionError):
            await take(demands, 1)


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
        assert demands.statistics() == Statistics(received=5, invalid={}, duplicate=2, dropped=0)


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


async def test_leaving_a_subscription_ends_its_iteration(here: zenoh.Session, there: zenoh.Session) -> None:
    async with listening(here, there) as (demands, theirs):
        taken: list[Verified[Demand]] = []

        async def consume() -> None:
            async for one in demands:
                taken.append(one)

        consuming = asyncio.create_task(consume())
        theirs.publish(demand())
        await until(lambda: taken)

    async with asyncio.timeout(2):
        await consuming
    assert len(taken) == 1


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


async def test_an_unsigned_message_is_not_published(here: zenoh.Session) -> None:
    async with opened(here) as channel:
        with pytest.raises(InputError, match="unsigned") as error:
            channel.publish(Demand(**terms(), validator_fee=0))
    assert "sign it first" in error.value.hint


async def test_nothing_is_put_on_a_key_with_a_wildcard(here: zenoh.Session) -> None:
    async with opened(here) as channel:
        with pytest.raises(InvalidKey, match="wildcard"):
            channel.put(f"aira/{MARKET}/demand/*/x", b"")


@pytest.mark.parametrize("name", ["", "a b.eth", "a/b.eth", "*", "**", "a$*.eth", "@agent", "line\n.eth"])
async def test_a_lighthouse_that_no_key_may_hold_is_refused(here: zenoh.Session, name: str) -> None:
    with pytest.raises(InvalidKey):
        Channel(here, name)


async def test_a_channel_is_used_inside_async_with(here: zenoh.Session) -> None:
    channel = Channel(here, MARKET)
    for _ in range(2):
        for use in (
            lambda: channel.publish(demand()),
            lambda: channel.put("aira/x", b""),
            lambda: channel.subscribe(Demand),
            lambda: channel.announce("agent", PERSON.address),
        ):
            with pytest.raises(ClosedError, match="not open"):
                use()
        with pytest.raises(ClosedError):
            await channel.present()
        async with channel:
            with pytest.raises(ClosedError, match="open already"):
                await channel.__aenter__()


async def test_a_subscription_is_used_inside_async_with(here: zenoh.Session) -> None:
    async with opened(here) as channel:
        demands = channel.subscribe(Demand)
        with pytest.raises(ClosedError):
            await anext(demands)
        with pytest.raises(ClosedError):
            await demands.recall()
